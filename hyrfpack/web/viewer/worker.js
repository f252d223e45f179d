// Unpacks the splats and sorts them by depth, away from the page's own thread.
//
// In:   {start: {count, degree, width}}      what is to come; the width of the textures
//       {bytes}                              gzipped SPZ version 3, piece by piece; {end} after the last
//       {sort: {ticket, row, sides, near, order}}
// Out:  {done}                               part unpacked, 0 to 1
//       {splats: {places, looks, harmonics, antialiased, height}}
//       {order: {ticket, order, drawn}}
//       {error}                              why it cannot be unpacked
"use strict";

const MAGIC = 0x5053474e;
const HEADER = 16;
const OTHER_HARMONICS = [0, 3, 8, 15];

let expected = null;
let writer = null;
let positions = null;

onmessage = ({ data }) => {
  if (data.start) {
    expected = data.start;
    const gzip = new DecompressionStream("gzip");
    writer = gzip.writable.getWriter();
    read(gzip.readable.getReader()).catch(({ message }) => postMessage({ error: message }));
  } else if (data.bytes) {
    writer.write(data.bytes).catch(() => {}); // the reader reports it
  } else if (data.end) {
    writer.close().catch(() => {});
  } else if (data.sort) {
    sort(data.sort);
  }
};

async function read(reader) {
  const { count, degree } = expected;
  const bytes = new Uint8Array(HEADER + count * (20 + 3 * OTHER_HARMONICS[degree]));
  let length = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    if (length + value.length > bytes.length) throw new Error("it is longer than it should be");
    bytes.set(value, length);
    length += value.length;
    postMessage({ done: length / bytes.length });
  }
  if (length < bytes.length) throw new Error("it is shorter than it should be");
  const header = new DataView(bytes.buffer);
  const told = [0, 4, 8].map((place) => header.getUint32(place, true));
  if (told[0] !== MAGIC || told[1] !== 3 || told[2] !== count || header.getUint8(12) !== degree) {
    throw new Error("it does not begin as it should");
  }
  unpack(bytes, header.getUint8(13), (header.getUint8(14) & 1) === 1);
}

// SPZ holds attribute after attribute; the textures hold splat after splat. Numbers stay as they are packed, but
// positions, which become floats.
function unpack(bytes, fractionalBits, antialiased) {
  const { count, degree, width } = expected;
  const height = Math.max(1, Math.ceil(count / width));
  const capacity = width * height;
  const step = 2 ** -fractionalBits;
  const others = 3 * OTHER_HARMONICS[degree];
  const [alphas, colors, scales, quats, rest] = [9, 10, 13, 16, 20].map((before) => HEADER + before * count);

  positions = new Float32Array(3 * count);
  for (let i = 0, at = HEADER; i < 3 * count; i++, at += 3) {
    positions[i] = (((bytes[at] << 8) | (bytes[at + 1] << 16) | (bytes[at + 2] << 24)) >> 8) * step;
  }
  const floats = new Uint32Array(positions.buffer);
  const places = new Uint32Array(4 * capacity);
  const looks = new Uint32Array(2 * capacity);
  for (let i = 0; i < count; i++) {
    const q = quats + 4 * i, s = scales + 3 * i, c = colors + 3 * i;
    places[4 * i] = floats[3 * i];
    places[4 * i + 1] = floats[3 * i + 1];
    places[4 * i + 2] = floats[3 * i + 2];
    places[4 * i + 3] = bytes[q] | (bytes[q + 1] << 8) | (bytes[q + 2] << 16) | (bytes[q + 3] << 24);
    looks[2 * i] = bytes[s] | (bytes[s + 1] << 8) | (bytes[s + 2] << 16) | (bytes[alphas + i] << 24);
    looks[2 * i + 1] = bytes[c] | (bytes[c + 1] << 8) | (bytes[c + 2] << 16);
  }
  const harmonics = new Uint8Array(16 * capacity * degree); // a layer holds 16 bytes of each splat
  for (let i = 0, at = rest; degree && i < count; i++) {
    for (let b = 0; b < others; b++) harmonics[16 * ((b >> 4) * capacity + i) + (b & 15)] = bytes[at++];
  }
  const splats = { places, looks, harmonics: new Uint32Array(harmonics.buffer), antialiased, height };
  postMessage({ splats }, [places.buffer, looks.buffer, harmonics.buffer]);
}

let depths = new Float32Array(0);
let indices, others;
const counts = new Uint32Array(1 << 16);

// Farthest first: a radix sort of the float32 depths in two passes of 16 bits. Splats behind the near plane, or far
// outside the picture's sides (planes through the eye, normals inwards), are left out. At equal depth the later one
// comes first, as the rasteriser has it.
function sort({ ticket, row, sides, near, order }) {
  const count = positions.length / 3;
  if (depths.length !== count) {
    depths = new Float32Array(count);
    [indices, others] = [new Uint32Array(count), new Uint32Array(count)];
  }
  const bits = new Uint32Array(depths.buffer);
  const [a, b, c, d] = row;
  let drawn = 0;
  counts.fill(0);
  for (let i = count - 1; i >= 0; i--) {
    const x = positions[3 * i], y = positions[3 * i + 1], z = positions[3 * i + 2];
    const depth = a * x + b * y + c * z + d;
    if (!(depth > near)) continue;
    let inside = true;
    for (let s = 0; s < 16 && inside; s += 4) inside = sides[s] * x + sides[s + 1] * y + sides[s + 2] * z + sides[s + 3] > 0;
    if (!inside) continue;
    depths[i] = depth;
    indices[drawn++] = i;
    counts[~bits[i] & 0xffff]++;
  }
  scatter(indices, others, drawn, (i) => ~bits[i] & 0xffff);
  counts.fill(0);
  for (let k = 0; k < drawn; k++) counts[~bits[others[k]] >>> 16]++;
  const sorted = order ?? new Uint32Array(expected.width * Math.ceil(count / expected.width)); // whole rows of a texture
  scatter(others, sorted, drawn, (i) => ~bits[i] >>> 16);
  postMessage({ order: { ticket, order: sorted, drawn } }, [sorted.buffer]);
}

function scatter(from, to, length, key) {
  let start = 0;
  for (let k = 0; k < counts.length; k++) {
    const here = counts[k];
    counts[k] = start;
    start += here;
  }
  for (let k = 0; k < length; k++) to[counts[key(from[k])]++] = from[k];
}
