// Decodes numbers in groups that share a quantisation step (codecs 8 and 11, docs/reference/format.md 3.5 and 3.6). The
// groups of codec 8 are not stored, because they follow from the configuration and the positions.

import { assertValid } from "./errors.js";
import { FEATURES_PER_ROW, HASH_FACTOR_Y, HASH_FACTOR_Z, decoderLayout, gridLevels, tableRows } from "./grids.js";
import { decodeIntegers } from "./integers.js";
import { CENTER_BITS_PER_AXIS } from "./lattice.js";
import { FIXED_POINT_ONE, STEP_BY_CODE } from "./steps.js";

/**
 * @typedef {import("./grids.js").Grid} Grid
 * @typedef {import("./grids.js").DecoderConfig} DecoderConfig
 * @typedef {import("./grids.js").FieldName} FieldName
 * @typedef {import("./lattice.js").LatticePoints} LatticePoints
 *
 * Groups of numbers: `index` has the group of each row, `count` is the number of groups, `width` the number of numbers
 * in a row.
 * @typedef {{index: Uint16Array, count: number, width: number}} NumberGroups
 */

const GROUP_MODEL_COUNT = 8;
const MAX_ABS_SYMBOL = 2 ** 24;
const USAGE_CLASSES_PER_LEVEL = 16;
const MAX_COUNTED_POINTS = 65536; // in larger layers only every n-th point is counted, to bound the time

/**
 * Returns the groups of a decoder's numbers. Each layer has a group for the weights of each output, and then a group
 * for all biases.
 * @param {DecoderConfig} config
 * @param {FieldName} field
 * @returns {NumberGroups}
 */
export const decoderGroups = (config, field) => {
  const layers = decoderLayout(config, field);
  const index = new Uint16Array(layers[2].bias + layers[2].outputs);
  let count = 0;
  for (const { inputs, outputs, matrix, bias } of layers) {
    for (let output = 0; output < outputs; output++) {
      index.fill(count++, matrix + output * inputs, matrix + (output + 1) * inputs);
    }
    index.fill(count++, bias, bias + outputs);
  }
  return { index, count, width: 1 };
};

/**
 * Returns the groups of a table's rows. Rows are grouped by their level and by the number of times that points read
 * them.
 * @param {Grid} grid
 * @param {LatticePoints} points the positions of the first layer's Gaussians
 * @returns {NumberGroups}
 */
export const tableGroups = (grid, points) => {
  const index = new Uint16Array(tableRows(grid));
  const levels = gridLevels(grid);
  const uses = new Uint32Array(Math.max(...levels.map(({ rows }) => rows)));
  levels.forEach((level, k) => {
    uses.fill(0, 0, level.rows);
    countUses(level, points, uses);
    for (let row = 0; row < level.rows; row++) {
      const digits = 32 - Math.clz32(uses[row]);
      index[level.first + row] = USAGE_CLASSES_PER_LEVEL * k + ((digits + 1) >> 1);
    }
  });
  return { index, count: USAGE_CLASSES_PER_LEVEL * levels.length, width: FEATURES_PER_ROW };
};

/**
 * Counts how many corners of the points' cells read each row of a level.
 * @param {import("./grids.js").GridLevel} level
 * @param {LatticePoints} points
 * @param {Uint32Array} uses the count of each row, which is incremented
 */
const countUses = ({ resolution, rows, dense }, { centers, count }, uses) => {
  const stride = 3 * Math.max(1, Math.ceil(count / MAX_COUNTED_POINTS));
  const cells = resolution - 1, unit = 2 ** CENTER_BITS_PER_AXIS;
  const factorY = dense ? resolution : HASH_FACTOR_Y, factorZ = dense ? resolution * resolution : HASH_FACTOR_Z;
  for (let i = 0; i < 3 * count; i += stride) {
    const x = Math.floor((centers[i] * cells) / unit);
    const y = Math.imul(Math.floor((centers[i + 1] * cells) / unit), factorY);
    const z = Math.imul(Math.floor((centers[i + 2] * cells) / unit), factorZ);
    for (let corner = 0; corner < 8; corner++) {
      const a = x + (corner & 1), b = y + (corner & 2 ? factorY : 0), c = z + (corner & 4 ? factorZ : 0);
      uses[dense ? a + b + c : (a ^ b ^ c) & (rows - 1)]++;
    }
  }
};

/**
 * Reads the groups of a table's rows, which codec 11 states before the numbers.
 * @param {Uint8Array} data
 * @param {Grid} grid
 * @returns {{groups: NumberGroups, rest: Uint8Array}} `rest` is for `decodeGroups`
 * @throws {DamagedData} a length or a group is invalid
 */
export const readTableGroups = (data, grid) => {
  assertValid(data.length >= 4, "it ends within its header");
  const end = 4 + new DataView(data.buffer, data.byteOffset, 4).getUint32(0, true);
  assertValid(end <= data.length, "its usage classes do not fit its bytes");
  const rowLevels = new Uint8Array(tableRows(grid)), levels = gridLevels(grid);
  levels.forEach(({ first, rows }, level) => rowLevels.fill(level, first, first + rows));
  const classes = decodeIntegers(data.subarray(4, end), rowLevels.length, rowLevels, false);
  assertValid(classes.every((usage) => usage < USAGE_CLASSES_PER_LEVEL), "a usage class is out of range");
  const index = Uint16Array.from(classes, (usage, row) => USAGE_CLASSES_PER_LEVEL * rowLevels[row] + usage);
  const groups = { index, count: USAGE_CLASSES_PER_LEVEL * levels.length, width: FEATURES_PER_ROW };
  return { groups, rest: data.subarray(end) };
};

/**
 * Decodes numbers in groups.
 * @param {Uint8Array} data
 * @param {NumberGroups} groups
 * @returns {Float32Array} (rows x width), row by row; 0 where a group has no step
 * @throws {DamagedData} a length or a number is invalid
 */
export const decodeGroups = (data, { index, count, width }) => {
  assertValid(data.length >= 8, "it ends within its header");
  const view = new DataView(data.buffer, data.byteOffset, 8);
  const modelsAt = 8 + view.getUint32(0, true), symbolsAt = modelsAt + view.getUint32(4, true);
  assertValid(symbolsAt <= data.length, "the lengths of its parts do not fit its bytes");
  const codes = decodeIntegers(data.subarray(8, modelsAt), count, null, false);
  assertValid(codes.every((code) => code <= 255), "a step size is out of range");
  const storedGroups = codes.reduce((sum, code) => sum + (code ? 1 : 0), 0);
  const storedModels = decodeIntegers(data.subarray(modelsAt, symbolsAt), storedGroups, null, false);
  assertValid(storedModels.every((model) => model < GROUP_MODEL_COUNT), "a model is out of range");
  let place = 0;
  const models = codes.map((code) => (code ? storedModels[place++] : 0));

  let storedRows = 0;
  for (let row = 0; row < index.length; row++) if (codes[index[row]]) storedRows++;
  const contexts = new Uint8Array(storedRows * width);
  place = 0;
  for (let row = 0; row < index.length; row++) {
    if (!codes[index[row]]) continue;
    for (let column = 0; column < width; column++) contexts[place++] = models[index[row]];
  }
  const symbols = decodeIntegers(data.subarray(symbolsAt), contexts.length, contexts, true);

  const numbers = new Float32Array(index.length * width);
  const steps = Float64Array.from(codes, (code) => STEP_BY_CODE[code] / FIXED_POINT_ONE);
  place = 0;
  for (let row = 0; row < index.length; row++) {
    if (!codes[index[row]]) continue;
    for (let column = 0; column < width; column++) {
      const symbol = symbols[place++];
      assertValid(symbol >= -MAX_ABS_SYMBOL && symbol <= MAX_ABS_SYMBOL, "a number is out of range");
      numbers[row * width + column] = symbol * steps[index[row]];
    }
  }
  return numbers;
};
