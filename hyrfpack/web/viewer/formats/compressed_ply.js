// Reads the compressed PLY of PlayCanvas and SuperSplat: 16 bytes per Gaussian, plus its higher harmonics. Element
// `chunk` has, for each 256 Gaussians, the floats min_ and max_ of x, y, z, of scale_x, scale_y, scale_z (logarithms)
// and, in newer files, of r, g, b (otherwise 0 and 1). Element `vertex` has four uint32; positions, scales and colours
// are fractions between the chunk's bounds:
//
//     packed_position   x 11 bits, y 10, z 11, from the highest bit
//     packed_rotation   2 bits: which of w, x, y, z is largest; 10 bits each for the others, sqrt(2) (v / 1023 - 1/2)
//     packed_scale      as packed_position
//     packed_color      r, g, b, and the opacity, 8 bits each; r, g, b are 0.5 + Y00 k
//
// Element `sh`, if any: uchar f_rest_0.., channel after channel; v is (v + 1/2) / 32 - 4, but 0 and 255 are -4 and 4.

import { groupedDigits } from "../../hyrf/errors.js";
import { normalizeSplats, rejectSplats } from "./normalize.js";
import { readPlyRows } from "./ply_elements.js";
import { writeQuat } from "./smallest_three.js";

const GAUSSIANS_PER_CHUNK = 256;
const CHUNK_POSITION_NAMES = ["x", "y", "z"];
const CHUNK_SCALE_NAMES = ["scale_x", "scale_y", "scale_z"];
const CHUNK_COLOR_NAMES = ["r", "g", "b"];
const PACKED_NAMES = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
const HIGHER_NUMBERS_BY_DEGREE = [0, 9, 24, 45];

/**
 * Returns whether a PLY file is a compressed one.
 * @param {import("./ply_elements.js").PlyHeader} header
 */
export const isCompressedPly = (header) => header.elements.get("vertex")?.properties.has("packed_position") ?? false;

/**
 * Reads the splats of a compressed PLY file.
 * @param {Uint8Array} bytes the whole file
 * @param {import("./ply_elements.js").PlyHeader} header
 * @returns {import("../../hyrf/harmonics.js").Splats}
 */
export function decodeCompressedPly(bytes, header) {
  const has = (element, name, kind) => header.elements.get(element)?.properties.get(name) === kind;
  const requireProperties = (element, names, kind) => {
    const missing = names.find((name) => !has(element, name, kind));
    if (missing === undefined) return;
    const what = `its element '${element}' has no property ${missing} of the right type`;
    rejectSplats(`${what}, so this is not a compressed PLY file of Gaussians`);
  };
  const bounds = (names) => ["min", "max"].map((end) => names.map((name) => `${end}_${name}`));
  const colored = header.elements.get("chunk")?.properties.has("min_r") ?? false;
  const bounded = [CHUNK_POSITION_NAMES, CHUNK_SCALE_NAMES, ...(colored ? [CHUNK_COLOR_NAMES] : [])];
  requireProperties("vertex", PACKED_NAMES, "Uint32");
  for (const names of bounded) requireProperties("chunk", bounds(names).flat(), "Float32");
  const higher = header.elements.get("sh")?.properties.size ?? 0, degree = HIGHER_NUMBERS_BY_DEGREE.indexOf(higher);
  if (degree < 0) rejectSplats(`${higher} properties of its element 'sh' fit no degree; 9, 24 or 45 do`);
  const rest = Array.from({ length: higher }, (_, k) => `f_rest_${k}`);
  requireProperties("sh", rest, "Uint8");
  if (header.order === "ascii") rejectSplats("a compressed PLY file in text cannot be read; export it as a binary one");

  const rows = readPlyRows(bytes, header, ["vertex", "chunk", ...(higher ? ["sh"] : [])]);
  const vertex = rows.get("vertex"), chunk = rows.get("chunk"), { count } = vertex;
  if (chunk.count !== Math.ceil(count / GAUSSIANS_PER_CHUNK) || (higher && rows.get("sh").count !== count)) {
    const found = `${groupedDigits(chunk.count)} chunks do not fit ${groupedDigits(count)} Gaussians, 256 each`;
    rejectSplats(`${found}; it is damaged`);
  }
  const [place, turn, size, tint] = PACKED_NAMES.map((name) => vertex.column(name));
  const positions = new Float64Array(3 * count), scales = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count), opacities = new Float32Array(count), colors = new Float32Array(3 * count);
  const [places, sizes, tints] = [CHUNK_POSITION_NAMES, CHUNK_SCALE_NAMES, CHUNK_COLOR_NAMES].map((names) => {
    return bounded.includes(names) ? bounds(names).map((ends) => ends.map((name) => chunk.column(name))) : null;
  });
  const interpolate = ([low, high], axis, chunkIndex, fraction) => {
    return low[axis](chunkIndex) * (1 - fraction) + high[axis](chunkIndex) * fraction;
  };
  for (let i = 0; i < count; i++) {
    const chunkIndex = Math.floor(i / GAUSSIANS_PER_CHUNK), word = turn(i), color = tint(i);
    for (let axis = 0; axis < 3; axis++) {
      positions[3 * i + axis] = interpolate(places, axis, chunkIndex, unpackComponent(place(i), axis));
      scales[3 * i + axis] = Math.exp(interpolate(sizes, axis, chunkIndex, unpackComponent(size(i), axis)));
      const fraction = ((color >>> (24 - 8 * axis)) & 255) / 255;
      colors[3 * i + axis] = tints ? interpolate(tints, axis, chunkIndex, fraction) : fraction;
    }
    opacities[i] = (color & 255) / 255;
    const a = unpackQuatComponent(word >>> 20), b = unpackQuatComponent(word >>> 10), c = unpackQuatComponent(word);
    writeQuat(word >>> 30, a, b, c, quats, 4 * i);
  }
  const columns = rest.map((_, at) => rows.get("sh").column(rest[(at % 3) * (higher / 3) + Math.floor(at / 3)]));
  const harmonic = (i, at) => {
    const byte = columns[at](i);
    return byte === 0 ? -4 : byte === 255 ? 4 : (byte + 0.5) / 32 - 4;
  };
  return normalizeSplats({ count, degree, antialiased: false, positions, scales, quats, opacities, colors }, harmonic);
}

// Returns a component of a position or scale, which has 11, 10 or 11 bits of the word, as a fraction in [0, 1].
function unpackComponent(word, axis) {
  if (axis === 0) return (word >>> 21) / 2047;
  return axis === 1 ? ((word >>> 11) & 1023) / 1023 : (word & 2047) / 2047;
}

// Returns a component of a rotation from the lowest 10 bits of a word.
const unpackQuatComponent = (code) => ((code & 1023) / 1023 - 0.5) * Math.SQRT2;
