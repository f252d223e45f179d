// Splats by depth, farthest first.

const RADIX = 1 << 16;

export class DepthSort {
  // Of splats at positions (3 N). Orders fill whole rows of a texture of this width.
  constructor(positions, width) {
    this.positions = positions;
    this.count = positions.length / 3;
    this.capacity = width * Math.ceil(this.count / width);
    this.depths = new Float32Array(this.count);
    this.bits = new Uint32Array(this.depths.buffer);
    [this.indices, this.others] = [new Uint32Array(this.count), new Uint32Array(this.count)];
    this.counts = new Uint32Array(RADIX);
  }

  // {order, drawn}: indices of which the first `drawn` count. A radix sort of the float32 depths in two passes of 16
  // bits. `row`: the camera's third, and its translation. Splats behind the near plane, or outside of the sides (see
  // frustum.js), are left out. At equal depth the later one comes first, as the rasteriser has it. `order` is written
  // to where it fits.
  sort(row, sides, near, order) {
    const { positions, depths, bits, indices, others, counts } = this;
    const [a, b, c, d] = row;
    let drawn = 0;
    counts.fill(0);
    for (let i = this.count - 1; i >= 0; i--) {
      const x = positions[3 * i], y = positions[3 * i + 1], z = positions[3 * i + 2];
      const depth = a * x + b * y + c * z + d;
      if (!(depth > near)) continue;
      let inside = true;
      for (let s = 0; s < 16 && inside; s += 4) {
        inside = sides[s] * x + sides[s + 1] * y + sides[s + 2] * z + sides[s + 3] > 0;
      }
      if (!inside) continue;
      depths[i] = depth;
      indices[drawn++] = i;
      counts[~bits[i] & 0xffff]++;
    }
    scatter(indices, others, drawn, counts, (i) => ~bits[i] & 0xffff);
    counts.fill(0);
    for (let k = 0; k < drawn; k++) counts[~bits[others[k]] >>> 16]++;
    const sorted = order?.length === this.capacity ? order : new Uint32Array(this.capacity);
    scatter(others, sorted, drawn, counts, (i) => ~bits[i] >>> 16);
    return { order: sorted, drawn };
  }
}

function scatter(from, to, length, counts, key) {
  let start = 0;
  for (let k = 0; k < counts.length; k++) {
    const here = counts[k];
    counts[k] = start;
    start += here;
  }
  for (let k = 0; k < length; k++) to[counts[key(from[k])]++] = from[k];
}
