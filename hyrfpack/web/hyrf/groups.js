// Codec 8 (docs/format.md 3.5): numbers in groups that share a step. Who decodes knows which number is in which group.

import { needSound } from "./errors.js";
import { HASH_Y, HASH_Z, ROW_FEATURES, decoderLayout, gridLevels, tableRows } from "./grids.js";
import { decodeIntegers } from "./integers.js";
import { CENTER_BITS } from "./lattice.js";
import { FIXED_ONE, STEP_OF_CODE } from "./steps.js";

/**
 * @typedef {import("./grids.js").Grid} Grid
 * @typedef {import("./grids.js").DecoderConfig} DecoderConfig
 * @typedef {import("./grids.js").FieldName} FieldName
 * @typedef {import("./lattice.js").LatticePoints} LatticePoints
 *
 * The group of each row of numbers, how many groups there may be, and how many numbers a row has.
 * @typedef {{index: Uint16Array, count: number, width: number}} NumberGroups
 */

const GROUP_MODELS = 8;
const LARGEST_SYMBOL = 2 ** 24;
const USE_CLASSES = 16;
const MOST_COUNTED = 65536; // points whose reading of the tables counts

/**
 * The numbers of a decoder: a group for each output of a layer, then one for the biases.
 * @param {DecoderConfig} config
 * @param {FieldName} which
 * @returns {NumberGroups}
 */
export const decoderGroups = (config, which) => {
  const layers = decoderLayout(config, which);
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
 * The rows of a table by level, and by how often points read them.
 * @param {Grid} grid
 * @param {LatticePoints} points of the first layer
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
      index[level.first + row] = USE_CLASSES * k + ((digits + 1) >> 1);
    }
  });
  return { index, count: USE_CLASSES * levels.length, width: ROW_FEATURES };
};

/**
 * Count how many corners of the points' cells read each row of a level.
 * @param {import("./grids.js").GridLevel} level
 * @param {LatticePoints} points
 * @param {Uint32Array} uses of each row, added to
 */
const countUses = ({ resolution, rows, dense }, { centers, count }, uses) => {
  const stride = 3 * Math.max(1, Math.ceil(count / MOST_COUNTED));
  const cells = resolution - 1, unit = 2 ** CENTER_BITS;
  const factorY = dense ? resolution : HASH_Y, factorZ = dense ? resolution * resolution : HASH_Z;
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
 * @param {Uint8Array} data
 * @param {NumberGroups} groups
 * @returns {Float32Array}
 * @throws {DamagedData}
 */
export const decodeGroups = (data, { index, count, width }) => {
  needSound(data.length >= 8, "it ends within its header");
  const view = new DataView(data.buffer, data.byteOffset, 8);
  const modelsAt = 8 + view.getUint32(0, true), symbolsAt = modelsAt + view.getUint32(4, true);
  needSound(symbolsAt <= data.length, "the lengths of its parts do not fit its bytes");
  const codes = decodeIntegers(data.subarray(8, modelsAt), count, null, false);
  needSound(codes.every((code) => code <= 255), "a step size is out of range");
  const used = codes.reduce((sum, code) => sum + (code ? 1 : 0), 0);
  const chosen = decodeIntegers(data.subarray(modelsAt, symbolsAt), used, null, false);
  needSound(chosen.every((model) => model < GROUP_MODELS), "a model is out of range");
  let place = 0;
  const models = codes.map((code) => (code ? chosen[place++] : 0));

  let stored = 0;
  for (let row = 0; row < index.length; row++) if (codes[index[row]]) stored++;
  const contexts = new Uint8Array(stored * width);
  place = 0;
  for (let row = 0; row < index.length; row++) {
    if (!codes[index[row]]) continue;
    for (let column = 0; column < width; column++) contexts[place++] = models[index[row]];
  }
  const symbols = decodeIntegers(data.subarray(symbolsAt), contexts.length, contexts, true);

  const numbers = new Float32Array(index.length * width);
  const steps = Float64Array.from(codes, (code) => STEP_OF_CODE[code] / FIXED_ONE);
  place = 0;
  for (let row = 0; row < index.length; row++) {
    if (!codes[index[row]]) continue;
    for (let column = 0; column < width; column++) {
      const symbol = symbols[place++];
      needSound(symbol >= -LARGEST_SYMBOL && symbol <= LARGEST_SYMBOL, "a number is out of range");
      numbers[row * width + column] = symbol * steps[index[row]];
    }
  }
  return numbers;
};
