// The door through which numbers of a foreign file become splats for the player.

import { HyrfFormatError, groupedDigits } from "../../hyrf/errors.js";
import { HIGHER_HARMONICS_BY_DEGREE, chooseHarmonicsRange } from "../../hyrf/harmonics.js";

const FRAME_SAMPLE = 1 << 16; // splats that tell where the scene is and how large
const FRAME_PART = 0.9; // of them lie within a unit of its middle, along each axis
const RANGE_SAMPLE = 1 << 12; // splats that tell how large harmonics are

/**
 * Numbers of a file, of which nothing is known but how many there are.
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
 * }} Numbers world units; `quats` wxyz of any length. `range`, if the file has one, is that of its harmonics
 */

/**
 * Splats of decoded numbers. The page's frame is chosen so that most of them lie within a unit of its middle.
 * @param {Numbers} numbers its arrays become those of the splats
 * @param {(i: number, at: number) => number} [harmonic] the number `at`, of 3 K, of the further harmonics of splat i
 * @returns {import("../../hyrf/harmonics.js").Splats}
 * @throws {HyrfFormatError} one is not finite in float32
 */
export function checkedSplats({ positions: places, range: known, ...numbers }, harmonic) {
  const { count, degree, scales, quats, opacities, colors } = numbers;
  needFiniteNumbers("position", places, 3);
  for (const [what, values, each] of [["scale", scales, 3], ["rotation", quats, 4], ["opacity", opacities, 1]]) {
    needFiniteNumbers(what, values, each);
  }
  needFiniteNumbers("colour", colors, 3);
  for (let i = 0; i < count; i++) normalizeQuat(quats, 4 * i);
  const { center, unit } = frameOfPlaces(places, count);
  const positions = new Float32Array(3 * count);
  for (let k = 0; k < positions.length; k++) positions[k] = (places[k] - center[k % 3]) / unit;
  for (let k = 0; k < scales.length; k++) scales[k] /= unit;
  needFiniteNumbers("position", positions, 3);
  needFiniteNumbers("scale", scales, 3);
  const each = 3 * HIGHER_HARMONICS_BY_DEGREE[degree], range = known ?? rangeOfHarmonics(count, each, harmonic);
  const harmonics = new Uint8Array(each * count);
  for (let i = 0, to = 0; i < count; i++) {
    for (let at = 0; at < each; at++) {
      const value = harmonic(i, at);
      if (!Number.isFinite(value)) refuseNumber("colour", i, count);
      harmonics[to++] = Math.max(0, Math.min(255, Math.round(128 + (128 / range) * value)));
    }
  }
  return { ...numbers, center, unit, positions, harmonics, range };
}

/**
 * One sentence on a file that is not what it should be.
 * @param {string} what
 * @returns {never}
 */
export function refuseSplats(what) {
  throw new HyrfFormatError(`The file cannot be shown: ${what}.`);
}

function needFiniteNumbers(what, values, each) {
  for (let k = 0; k < values.length; k++) {
    if (!Number.isFinite(values[k])) refuseNumber(what, Math.floor(k / each), values.length / each);
  }
}

function refuseNumber(what, i, count) {
  refuseSplats(
    `the ${what} of Gaussian ${groupedDigits(i)} of ${groupedDigits(count)} is not a finite number; it is damaged, ` +
      "or its training failed; export it again",
  );
}

// To unit length and w >= 0; without length, to no rotation.
function normalizeQuat(quats, at) {
  const w = quats[at], x = quats[at + 1], y = quats[at + 2], z = quats[at + 3];
  const length = Math.sqrt(w * w + x * x + y * y + z * z), factor = (w < 0 ? -1 : 1) / (length || 1);
  quats[at] = length ? w * factor : 1;
  quats[at + 1] = x * factor;
  quats[at + 2] = y * factor;
  quats[at + 3] = z * factor;
}

// The middle of the places, and how far most of them lie from it along their farthest axis; 1 where they do not.
function frameOfPlaces(places, count) {
  if (!count) return { center: [0, 0, 0], unit: 1 };
  const step = Math.ceil(count / FRAME_SAMPLE), sampled = Math.ceil(count / step);
  const center = [0, 1, 2].map((axis) => {
    return Float64Array.from({ length: sampled }, (_, k) => places[3 * k * step + axis]).sort()[sampled >> 1];
  });
  const reaches = Float64Array.from({ length: sampled }, (_, k) => {
    return Math.max(...center.map((middle, axis) => Math.abs(places[3 * k * step + axis] - middle)));
  }).sort();
  const reach = reaches[Math.floor(FRAME_PART * (sampled - 1))] || reaches[sampled - 1];
  return { center, unit: reach > 0 && reach < Infinity ? reach : 1 };
}

function rangeOfHarmonics(count, each, harmonic) {
  const step = Math.ceil(count / RANGE_SAMPLE) || 1, sizes = [];
  for (let i = 0; i < count; i += step) {
    for (let at = 0; at < each; at++) sizes.push(Math.abs(harmonic(i, at)));
  }
  return chooseHarmonicsRange(sizes.filter(Number.isFinite));
}
