// Decodes channels of numbers, one per Gaussian (codec 7, docs/reference/format.md 3.4). Each number is predicted from
// numbers of the same channel that were decoded before it.

import { assertValid } from "./errors.js";
import { decodeIntegers } from "./integers.js";
import { FIXED_POINT_ONE, STEP_BY_CODE } from "./steps.js";

/** @typedef {import("./lattice.js").LatticePoints} LatticePoints */

const BASIS_BYTES = 36;
const MAX_ABS_BASIS_ENTRY = 1 + 2 ** -10;
const CHANNEL_HEADER_BYTES = 10;
const MAX_ABS_MEAN = 4096;
const MAX_PREDICTION_WEIGHT = 16;
const MAX_DIFFERENCE_UNITS = 2 ** 39; // a unit is 1 / FIXED_POINT_ONE
const MAX_DIFFERENCE_STEPS = 2 ** 30;

/**
 * Decodes a section of 1 or 3 channels.
 * @param {Uint8Array} data the bytes of the section
 * @param {LatticePoints} points the positions of the same Gaussians
 * @param {number} columns 1, or 3 for channels that are coordinates in an orthonormal basis
 * @returns {Float32Array} (N x columns), row by row
 * @throws {DamagedData} a length, a header or a number is invalid
 */
export const decodeChannels = (data, points, columns) => {
  const { count } = points;
  let rest = data;
  const basis = [1];
  if (columns === 3) {
    assertValid(data.length >= BASIS_BYTES, "it ends within its basis");
    const view = new DataView(data.buffer, data.byteOffset, BASIS_BYTES);
    for (let i = 0; i < 9; i++) basis[i] = view.getFloat32(4 * i, true);
    assertValid(basis.every((number) => Math.abs(number) <= MAX_ABS_BASIS_ENTRY), "its basis is not orthonormal");
    rest = data.subarray(BASIS_BYTES);
  }
  const channels = [];
  for (let column = 0; column < columns; column++) {
    const { numbers, size } = decodeChannel(rest, points);
    channels.push(numbers);
    rest = rest.subarray(size);
  }
  assertValid(rest.length === 0, `${rest.length} bytes follow its last channel`);
  if (columns === 1) return new Float32Array(channels[0]);
  const joined = new Float32Array(3 * count);
  const [first, second, third] = channels;
  for (let color = 0; color < 3; color++) {
    const [a, b, c] = basis.slice(3 * color, 3 * color + 3);
    for (let i = 0; i < count; i++) joined[3 * i + color] = first[i] * a + second[i] * b + third[i] * c;
  }
  return joined;
};

/**
 * Decodes the channel at the start of `data`.
 * @param {Uint8Array} data the rest of the section
 * @param {LatticePoints} points
 * @returns {{numbers: Float64Array, size: number}} the N numbers, and the length of the channel in bytes
 */
const decodeChannel = (data, { classes, count }) => {
  assertValid(data.length >= CHANNEL_HEADER_BYTES, "it ends within the header of a channel");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const mean = view.getFloat32(0, true), weight = data[4], classCount = data[9];
  const start = CHANNEL_HEADER_BYTES + classCount, size = start + view.getUint32(5, true);
  const isInRange = Math.abs(mean) <= MAX_ABS_MEAN && weight <= MAX_PREDICTION_WEIGHT;
  assertValid(isInRange, "the header of a channel has invalid values");
  assertValid(size <= data.length, "it ends within a channel");
  let largestClass = 0;
  for (let i = 0; i < count; i++) if (classes[i] > largestClass) largestClass = classes[i];
  assertValid(classCount > largestClass, "a class of points has no step size");

  const differences = decodeIntegers(data.subarray(start, size), count, classes, true);
  const steps = Float64Array.from(data.subarray(CHANNEL_HEADER_BYTES, start), (code) => STEP_BY_CODE[code]);
  const limits = steps.map((step) => Math.min(Math.floor(MAX_DIFFERENCE_UNITS / step), MAX_DIFFERENCE_STEPS));
  const values = new Float64Array(count);
  for (let i = 0; i < count; i++) {
    const pointClass = classes[i];
    assertValid(Math.abs(differences[i]) <= limits[pointClass], "a channel holds a difference that is too large");
    values[i] = differences[i] * steps[pointClass];
  }
  if (weight > 0) addPredictions(values, weight);
  for (let i = 0; i < count; i++) values[i] = values[i] / FIXED_POINT_ONE + mean;
  return { numbers: values, size };
};

/**
 * Adds to each difference the prediction from its two neighbours, in place. The distance to the neighbours is a power
 * of two that is halved in each pass.
 * @param {Float64Array} values the differences, replaced by the values: integers of magnitude below 2^45
 * @param {number} weight 1 to 16; the prediction is weight / 16 times the mean of both neighbours
 */
const addPredictions = (values, weight) => {
  const count = values.length;
  let distance = 1;
  while (2 * distance < count) distance *= 2;
  for (; distance >= 1; distance /= 2) {
    for (let i = distance; i < count; i += 2 * distance) {
      const before = values[i - distance], after = i + distance < count ? values[i + distance] : before;
      values[i] += Math.floor((weight * (before + after)) / 32);
    }
  }
};
