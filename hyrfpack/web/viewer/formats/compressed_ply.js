// Compressed PLY of PlayCanvas and SuperSplat: 16 bytes a Gaussian, plus its higher harmonics. Element `chunk`: for
// each 256 Gaussians the floats min_ and max_ of x, y, z, of scale_x, scale_y, scale_z (logarithms), and, in newer
// files, of r, g, b (else 0 and 1). Element `vertex`: four uint32, of which the first and the last two lie, as
// fractions, between the chunk's bounds:
//
//     packed_position   x 11 bits, y 10, z 11, from the highest bit
//     packed_rotation   2 bits: which of w, x, y, z is largest; 10 bits each for the others, sqrt(2) (v / 1023 - 1/2)
//     packed_scale      as the position
//     packed_color      r, g, b, and the opacity, 8 bits each; r, g, b are 0.5 + Y00 k
//
// Element `sh`, if any: uchar f_rest_0.., channel after channel; v is (v + 1/2) / 32 - 4, but 0 and 255 are -4 and 4.

import { groupedDigits } from "../../hyrf/errors.js";
import { checkedSplats, refuseSplats } from "./checked.js";
import { readPlyRows } from "./ply_elements.js";
import { writeQuat } from "./smallest_three.js";

const CHUNK = 256;
const CHUNK_PLACE = ["x", "y", "z"], CHUNK_SCALE = ["scale_x", "scale_y", "scale_z"], CHUNK_COLOR = ["r", "g", "b"];
const PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
const SH_COUNTS = [0, 9, 24, 45]; // by degree

/**
 * Whether a PLY file is of this kind.
 * @param {import("./ply_elements.js").PlyHeader} header
 */
export const isCompressedPly = (header) => header.elements.get("vertex")?.properties.has("packed_position") ?? false;

/**
 * @param {Uint8Array} bytes
 * @param {import("./ply_elements.js").PlyHeader} header
 * @returns {import("../../hyrf/harmonics.js").Splats}
 */
export function decodeCompressedPly(bytes, header) {
  const has = (element, name, kind) => header.elements.get(element)?.properties.get(name) === kind;
  const need = (element, names, kind) => {
    const missing = names.find((name) => !has(element, name, kind));
    if (missing === undefined) return;
    const what = `its element '${element}' has no property ${missing} of the right type`;
    refuseSplats(`${what}, so this is not a compressed PLY file of Gaussians`);
  };
  const bounds = (names) => ["min", "max"].map((end) => names.map((name) => `${end}_${name}`));
  const colored = header.elements.get("chunk")?.properties.has("min_r") ?? false;
  const bounded = [CHUNK_PLACE, CHUNK_SCALE, ...(colored ? [CHUNK_COLOR] : [])];
  need("vertex", PACKED, "Uint32");
  for (const names of bounded) need("chunk", bounds(names).flat(), "Float32");
  const higher = header.elements.get("sh")?.properties.size ?? 0, degree = SH_COUNTS.indexOf(higher);
  if (degree < 0) refuseSplats(`${higher} properties of its element 'sh' fit no degree; 9, 24 or 45 do`);
  const rest = Array.from({ length: higher }, (_, k) => `f_rest_${k}`);
  need("sh", rest, "Uint8");
  if (header.order === "ascii") refuseSplats("a compressed PLY file in text cannot be read; export it as a binary one");

  const rows = readPlyRows(bytes, header, ["vertex", "chunk", ...(higher ? ["sh"] : [])]);
  const vertex = rows.get("vertex"), chunk = rows.get("chunk"), { count } = vertex;
  if (chunk.count !== Math.ceil(count / CHUNK) || (higher && rows.get("sh").count !== count)) {
    const found = `${groupedDigits(chunk.count)} chunks do not fit ${groupedDigits(count)} Gaussians, ${CHUNK} each`;
    refuseSplats(`${found}; it is damaged`);
  }
  const [place, turn, size, tint] = PACKED.map((name) => vertex.column(name));
  const positions = new Float64Array(3 * count), scales = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count), opacities = new Float32Array(count), colors = new Float32Array(3 * count);
  const [places, sizes, tints] = [CHUNK_PLACE, CHUNK_SCALE, CHUNK_COLOR].map((names) => {
    return bounded.includes(names) ? bounds(names).map((ends) => ends.map((name) => chunk.column(name))) : null;
  });
  const between = ([low, high], axis, of, part) => low[axis](of) * (1 - part) + high[axis](of) * part;
  for (let i = 0; i < count; i++) {
    const of = Math.floor(i / CHUNK), word = turn(i), color = tint(i);
    for (let axis = 0; axis < 3; axis++) {
      positions[3 * i + axis] = between(places, axis, of, part11(place(i), axis));
      scales[3 * i + axis] = Math.exp(between(sizes, axis, of, part11(size(i), axis)));
      const part = ((color >>> (24 - 8 * axis)) & 255) / 255;
      colors[3 * i + axis] = tints ? between(tints, axis, of, part) : part;
    }
    opacities[i] = (color & 255) / 255;
    writeQuat(word >>> 30, part10(word >>> 20), part10(word >>> 10), part10(word), quats, 4 * i);
  }
  const columns = rest.map((_, at) => rows.get("sh").column(rest[(at % 3) * (higher / 3) + Math.floor(at / 3)]));
  const harmonic = (i, at) => {
    const byte = columns[at](i);
    return byte === 0 ? -4 : byte === 255 ? 4 : (byte + 0.5) / 32 - 4;
  };
  return checkedSplats({ count, degree, antialiased: false, positions, scales, quats, opacities, colors }, harmonic);
}

// The fraction that 11, 10 or 11 bits of a word stand for.
function part11(word, axis) {
  if (axis === 0) return (word >>> 21) / 2047;
  return axis === 1 ? ((word >>> 11) & 1023) / 1023 : (word & 2047) / 2047;
}

// A component of a rotation.
const part10 = (code) => ((code & 1023) / 1023 - 0.5) * Math.SQRT2;
