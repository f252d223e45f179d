// Codec 7 (docs/format.md 3.4): numbers along the list of Gaussians, predicted from those that are decoded before.

import { needSound } from "./errors.js";
import { decodeIntegers } from "./integers.js";
import { FIXED_ONE, STEP_OF_CODE } from "./steps.js";

/** @typedef {import("./lattice.js").LatticePoints} LatticePoints */

const BASIS_BYTES = 36;
const LARGEST_BASIS = 1 + 2 ** -10;
const CHANNEL_HEADER = 10;
const LARGEST_MEAN = 4096;
const LARGEST_WEIGHT = 16;
const LARGEST_DIFFERENCE = 2 ** 39;
const MOST_STEPS_OF_DIFFERENCE = 2 ** 30;

/**
 * @param {Uint8Array} data
 * @param {LatticePoints} points
 * @param {number} columns 3, in a basis, or 1
 * @returns {Float32Array} (columns N), row by row
 * @throws {DamagedData}
 */
export const decodeChannels = (data, points, columns) => {
  const { count } = points;
  let rest = data;
  const basis = [1];
  if (columns === 3) {
    needSound(data.length >= BASIS_BYTES, "it ends within its basis");
    const view = new DataView(data.buffer, data.byteOffset, BASIS_BYTES);
    for (let i = 0; i < 9; i++) basis[i] = view.getFloat32(4 * i, true);
    needSound(basis.every((number) => Math.abs(number) <= LARGEST_BASIS), "its basis is not orthonormal");
    rest = data.subarray(BASIS_BYTES);
  }
  const channels = [];
  for (let column = 0; column < columns; column++) {
    const { numbers, size } = decodeChannel(rest, points);
    channels.push(numbers);
    rest = rest.subarray(size);
  }
  needSound(rest.length === 0, `${rest.length} bytes follow its last channel`);
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
 * @param {Uint8Array} data that begins with the channel
 * @param {LatticePoints} points
 * @returns {{numbers: Float64Array, size: number}} the numbers (N), and the bytes they took
 */
const decodeChannel = (data, { classes, count }) => {
  needSound(data.length >= CHANNEL_HEADER, "it ends within the header of a channel");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const mean = view.getFloat32(0, true), weight = data[4], kinds = data[9];
  const start = CHANNEL_HEADER + kinds, size = start + view.getUint32(5, true);
  needSound(Math.abs(mean) <= LARGEST_MEAN && weight <= LARGEST_WEIGHT, "the header of a channel cannot be");
  needSound(size <= data.length, "it ends within a channel");
  let largestClass = 0;
  for (let i = 0; i < count; i++) if (classes[i] > largestClass) largestClass = classes[i];
  needSound(kinds > largestClass, "a class of points has no step size");

  const differences = decodeIntegers(data.subarray(start, size), count, classes, true);
  const steps = Float64Array.from(data.subarray(CHANNEL_HEADER, start), (code) => STEP_OF_CODE[code]);
  const limits = steps.map((step) => Math.min(Math.floor(LARGEST_DIFFERENCE / step), MOST_STEPS_OF_DIFFERENCE));
  const values = new Float64Array(count);
  for (let i = 0; i < count; i++) {
    const kind = classes[i];
    needSound(Math.abs(differences[i]) <= limits[kind], "a channel holds a difference that is too large");
    values[i] = differences[i] * steps[kind];
  }
  if (weight > 0) predictAlong(values, weight);
  for (let i = 0; i < count; i++) values[i] = values[i] / FIXED_ONE + mean;
  return { numbers: values, size };
};

/**
 * Add to each value what its neighbours predict, coarse distances first.
 * @param {Float64Array} values integers below 2^45
 * @param {number} weight
 */
const predictAlong = (values, weight) => {
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
