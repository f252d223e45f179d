// Sorts splats by depth, farthest first.

const RADIX_BINS = 1 << 16;

/** Sorts the same splats again and again, in memory that is allocated once. */
export class DepthSort {
  /**
   * @param {Float32Array} positions those of the splats (3 N); those with NaN are omitted
   * @param {number} width orders fill whole rows of a texture that is `width` texels wide
   * @param {number[]} [units] for each row, a factor of the depth of the near plane; 1 by default
   */
  constructor(positions, width, units) {
    this.positions = positions;
    this.width = width;
    this.units = units;
    this.count = positions.length / 3;
    this.capacity = width * Math.ceil(this.count / width);
    this.depths = new Float32Array(this.count);
    this.bits = new Uint32Array(this.depths.buffer);
    this.indices = new Uint32Array(this.count);
    this.others = new Uint32Array(this.count);
    this.counts = new Uint32Array(RADIX_BINS);
  }

  /**
   * Sorts by a radix sort of the float32 depths in two passes of 16 bits. Splats nearer than the near plane or outside
   * the planes `sides` are omitted. At equal depth the splat with the larger index comes first, as in the rasteriser.
   * @param {number[]} row the third row of the camera's pose
   * @param {number[]} sides from `frustumPlanes`
   * @param {number} near the depth of the near plane, before the factors `units`
   * @param {Uint32Array | null} [order] an array to reuse, if its length fits
   * @param {Uint8Array | null} [kept] 0 for each splat to omit
   * @returns {{order: Uint32Array, drawn: number}} indices of splats, of which the first `drawn` are valid
   */
  sort(row, sides, near, order, kept) {
    const { positions, width, units, depths, bits, indices, others, counts } = this;
    const [a, b, c, d] = row;
    let drawn = 0;
    counts.fill(0);
    for (let i = this.count - 1; i >= 0; i--) {
      const x = positions[3 * i], y = positions[3 * i + 1], z = positions[3 * i + 2];
      const depth = a * x + b * y + c * z + d;
      if (!(depth > (units ? near * units[(i / width) | 0] : near)) || kept?.[i] === 0) continue;
      let isInside = true;
      for (let s = 0; s < 16 && isInside; s += 4) {
        isInside = sides[s] * x + sides[s + 1] * y + sides[s + 2] * z + sides[s + 3] > 0;
      }
      if (!isInside) continue;
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

/**
 * Distributes indices by their keys in a stable order, which is one pass of the radix sort.
 * @param {Uint32Array} from
 * @param {Uint32Array} to
 * @param {number} length the number of indices
 * @param {Uint32Array} counts the number of indices with each key; overwritten
 * @param {(index: number) => number} key
 */
function scatter(from, to, length, counts, key) {
  let start = 0;
  for (let k = 0; k < counts.length; k++) {
    const binCount = counts[k];
    counts[k] = start;
    start += binCount;
  }
  for (let k = 0; k < length; k++) to[counts[key(from[k])]++] = from[k];
}
