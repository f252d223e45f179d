// The exposure map of a model (section EXPO, codec 9), which predicts the log gains of any viewpoint.

import { assertValid } from "./errors.js";

/**
 * An exposure map. `box`: minimum and maximum coordinates of the training cameras (6 numbers, local units); `lengths`:
 * the kernel's length scales for positions (local units) and for directions (unit vectors); `mean`: log gains far from
 * all centers (3 numbers); `limits`: minimum and maximum log gains (6 numbers). Each center has a position in local
 * units, a viewing direction of any length, and the 3 log gains that the kernel weights.
 * @typedef {{
 *   box: Float32Array, lengths: Float32Array, mean: Float32Array, limits: Float32Array,
 *   centers: {position: number[], direction: number[], weight: number[]}[],
 * }} ExposureMap
 */

const EXPOSURE_HEADER_BYTES = 84;
const EXPOSURE_HEADER_FLOATS = 20;
const BYTES_PER_CENTER = 12;
const MAX_CENTERS = 64;
const MAX_LOG_GAIN = 8;
const MAX_POSITION_CODE = 255, MAX_DIRECTION_CODE = 127;
const AXES = [0, 1, 2];

/**
 * Decodes an exposure map (codec 9).
 * @param {Uint8Array} data the bytes of the section
 * @param {number} rawLength the section's decoded length in bytes, from the table of contents
 * @returns {ExposureMap}
 * @throws {DamagedData} a length or a number is invalid
 */
export const decodeExposure = (data, rawLength) => {
  const count = data[0], { length } = data;
  const isWhole = length === EXPOSURE_HEADER_BYTES + BYTES_PER_CENTER * count && length === rawLength;
  assertValid(isWhole && count <= MAX_CENTERS, `its ${length} bytes are no exposure map`);
  assertValid(!(data[1] | data[2] | data[3]), "its reserved bytes are not zero");
  const view = new DataView(data.buffer, data.byteOffset, length);
  const numbers = Float32Array.from({ length: EXPOSURE_HEADER_FLOATS }, (_, k) => view.getFloat32(4 + 4 * k, true));
  assertValid(numbers.every(Number.isFinite), "it holds numbers that are not finite");
  const lengths = numbers.subarray(0, 2), box = numbers.subarray(2, 8), mean = numbers.subarray(8, 11);
  const limits = numbers.subarray(11, 17), steps = numbers.subarray(17);
  const isLimited = limits.every((value) => Math.abs(value) <= MAX_LOG_GAIN);
  const isOrdered = AXES.every((axis) => box[axis] <= box[3 + axis] && limits[axis] <= limits[3 + axis]);
  assertValid(isLimited && isOrdered && lengths.every((value) => value > 0), "its numbers are out of range");
  const centers = Array.from({ length: count }, (_, center) => {
    const at = EXPOSURE_HEADER_BYTES + BYTES_PER_CENTER * center;
    return {
      position: AXES.map((axis) => box[axis] + (data[at + axis] / MAX_POSITION_CODE) * (box[3 + axis] - box[axis])),
      direction: AXES.map((axis) => view.getInt8(at + 3 + axis) / MAX_DIRECTION_CODE),
      weight: AXES.map((axis) => view.getInt16(at + 6 + 2 * axis, true) * steps[axis]),
    };
  });
  return { box, lengths, mean, limits, centers };
};

/**
 * Computes the log gains of a viewpoint, in float64:
 *
 *     clip(mean + sum over centers of weight / (1 + |x' - position|^2 / lengths[0]^2
 *                                                 + |f - direction|^2 / lengths[1]^2))
 *
 * where x' is the point of `box` nearest to the viewpoint and f is the viewing direction. A channel y of the picture is
 * displayed as g y / (1 + (g - 1) y) with g = exp(log gain).
 * @param {ExposureMap} exposure
 * @param {ArrayLike<number>} position 3 numbers, local units
 * @param {ArrayLike<number>} direction 3 numbers, unit length
 * @returns {number[]} 3 numbers, of red, green and blue, within `limits`
 */
export const logGains = ({ box, lengths, mean, limits, centers }, position, direction) => {
  const logs = Array.from(mean);
  for (const center of centers) {
    let divisor = 1;
    for (const axis of AXES) {
      const offset = clampToBounds(position[axis], box, axis) - center.position[axis];
      divisor += (offset / lengths[0]) ** 2 + ((direction[axis] - center.direction[axis]) / lengths[1]) ** 2;
    }
    for (const axis of AXES) logs[axis] += center.weight[axis] / divisor;
  }
  return logs.map((value, axis) => clampToBounds(value, limits, axis));
};

/**
 * Clamps a value to the bounds of an axis.
 * @param {number} value
 * @param {Float32Array} bounds 6 numbers: the lower bounds of three axes, then the upper bounds
 * @param {number} axis
 */
const clampToBounds = (value, bounds, axis) => Math.min(Math.max(value, bounds[axis]), bounds[3 + axis]);
