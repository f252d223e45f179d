// Checks the numbers that the readers of splat formats decode, and converts them to splats for the player.

import { HyrfFormatError, groupedDigits } from "../../hyrf/errors.js";
import { HIGHER_HARMONICS_BY_DEGREE, chooseHarmonicsRange } from "../../hyrf/harmonics.js";

const MAX_FRAME_SAMPLES = 1 << 16;
const FRAME_QUANTILE = 0.9; // the share of the splats within one unit of the centre along each axis
const MAX_RANGE_SAMPLES = 1 << 12;

/**
 * The decoded numbers of a file, which are not checked yet.
 * @typedef {{
 *   count: number,
 *   degree: number,
 *   antialiased: boolean,
 *   positions: Float64Array,
 *   scales: Float32Array,
 *   quats: Float32Array,
 *   opacities: Float32Array,
 *   colors: Float32Array,
 *   range?: number,
 * }} DecodedSplats in world units. `quats` are wxyz of any length. `range` is the file's range of harmonics, if known.
 */

/**
 * Checks decoded numbers, normalises rotations, and converts lengths to a frame in which most splats lie within one
 * unit of the centre.
 * @param {DecodedSplats} numbers its arrays are reused for the splats
 * @param {(i: number, at: number) => number} [harmonic] returns number `at` of the 3 K higher harmonics of splat i
 * @returns {import("../../hyrf/harmonics.js").Splats}
 * @throws {HyrfFormatError} a number is not finite in float32
 */
export function normalizeSplats({ positions: worldPositions, range: storedRange, ...numbers }, harmonic) {
  const { count, degree, scales, quats, opacities, colors } = numbers;
  requireFiniteNumbers("position", worldPositions, 3);
  for (const [what, values, each] of [["scale", scales, 3], ["rotation", quats, 4], ["opacity", opacities, 1]]) {
    requireFiniteNumbers(what, values, each);
  }
  requireFiniteNumbers("colour", colors, 3);
  for (let i = 0; i < count; i++) normalizeQuat(quats, 4 * i);
  const { center, unit } = estimateFrame(worldPositions, count);
  const positions = new Float32Array(3 * count);
  for (let k = 0; k < positions.length; k++) positions[k] = (worldPositions[k] - center[k % 3]) / unit;
  for (let k = 0; k < scales.length; k++) scales[k] /= unit;
  requireFiniteNumbers("position", positions, 3);
  requireFiniteNumbers("scale", scales, 3);
  const each = 3 * HIGHER_HARMONICS_BY_DEGREE[degree];
  const range = storedRange ?? estimateHarmonicsRange(count, each, harmonic);
  const harmonics = new Uint8Array(each * count);
  for (let i = 0, to = 0; i < count; i++) {
    for (let at = 0; at < each; at++) {
      const value = harmonic(i, at);
      if (!Number.isFinite(value)) rejectNumber("colour", i, count);
      harmonics[to++] = Math.max(0, Math.min(255, Math.round(128 + (128 / range) * value)));
    }
  }
  return { ...numbers, center, unit, positions, harmonics, range };
}

/**
 * Throws the error for a file that cannot be shown.
 * @param {string} what the reason
 * @returns {never}
 */
export function rejectSplats(what) {
  throw new HyrfFormatError(`The file cannot be shown: ${what}.`);
}

// Throws an error for the first number that is not finite. `each` is the number of values per Gaussian.
function requireFiniteNumbers(what, values, each) {
  for (let k = 0; k < values.length; k++) {
    if (!Number.isFinite(values[k])) rejectNumber(what, Math.floor(k / each), values.length / each);
  }
}

// Throws the error for a value of Gaussian i that is not finite.
function rejectNumber(what, i, count) {
  rejectSplats(
    `the ${what} of Gaussian ${groupedDigits(i)} of ${groupedDigits(count)} is not a finite number; it is damaged, ` +
      "or its training failed; export it again",
  );
}

// Normalises a quaternion to unit length and w >= 0. A zero quaternion becomes the identity.
function normalizeQuat(quats, at) {
  const w = quats[at], x = quats[at + 1], y = quats[at + 2], z = quats[at + 3];
  const length = Math.sqrt(w * w + x * x + y * y + z * z), factor = (w < 0 ? -1 : 1) / (length || 1);
  quats[at] = length ? w * factor : 1;
  quats[at + 1] = x * factor;
  quats[at + 2] = y * factor;
  quats[at + 3] = z * factor;
}

// Returns the median position, and the FRAME_QUANTILE of the distances from it along the axis with the largest one. A
// distance of 0 or infinity is replaced by 1.
function estimateFrame(worldPositions, count) {
  if (!count) return { center: [0, 0, 0], unit: 1 };
  const step = Math.ceil(count / MAX_FRAME_SAMPLES), sampled = Math.ceil(count / step);
  const center = [0, 1, 2].map((axis) => {
    return Float64Array.from({ length: sampled }, (_, k) => worldPositions[3 * k * step + axis]).sort()[sampled >> 1];
  });
  const reaches = Float64Array.from({ length: sampled }, (_, k) => {
    return Math.max(...center.map((middle, axis) => Math.abs(worldPositions[3 * k * step + axis] - middle)));
  }).sort();
  const reach = reaches[Math.floor(FRAME_QUANTILE * (sampled - 1))] || reaches[sampled - 1];
  return { center, unit: reach > 0 && reach < Infinity ? reach : 1 };
}

// Chooses the range of harmonics from a sample of splats.
function estimateHarmonicsRange(count, each, harmonic) {
  const step = Math.ceil(count / MAX_RANGE_SAMPLES) || 1, sizes = [];
  for (let i = 0; i < count; i += step) {
    for (let at = 0; at < each; at++) sizes.push(Math.abs(harmonic(i, at)));
  }
  return chooseHarmonicsRange(sizes.filter(Number.isFinite));
}
