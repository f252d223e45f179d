// Decodes residuals, which correct what the fields predict for single Gaussians (codec 13, docs/reference/format.md
// 3.7), and applies them (2.13).

import { evaluateBasis } from "./basis.js";
import { assertValid } from "./errors.js";
import { decodeIntegers } from "./integers.js";
import { FIXED_POINT_ONE, STEP_BY_CODE } from "./steps.js";

/** @typedef {import("./lattice.js").LatticePoints} LatticePoints */

/** The number of shape residuals of a Gaussian: two of its scale logits, three of its rotation. */
export const SHAPE_RESIDUALS = 5;

const HEADER_BYTES = 5;
const BASIS_BYTES = 36;
const MAX_ABS_BASIS_ENTRY = 1 + 2 ** -10;
const MAX_CLASSES = 16;
const MAX_ABS_SYMBOL = 2 ** 24;

/**
 * Returns the number of residuals of a Gaussian in the sections of shapes and of colours.
 * @param {number} degree of the harmonics
 */
export const residualColumns = (degree) => [SHAPE_RESIDUALS, 3 * (degree + 1) ** 2];

/**
 * Decodes a section of residuals.
 * @param {Uint8Array} data the bytes of the section
 * @param {LatticePoints} points the positions of the same Gaussians
 * @param {number} columns
 * @param {boolean} isColor whether they correct colours
 * @returns {Float32Array} (N x columns), row by row
 * @throws {DamagedData} a length, a header or a number is invalid
 */
export const decodeResiduals = (data, { classes, count }, columns, isColor) => {
  let place = 0;
  /**
   * Takes the next bytes.
   * @param {number} length
   */
  const take = (length) => {
    assertValid(place + length <= data.length, "it ends too early");
    place += length;
    return data.subarray(place - length, place);
  };
  /**
   * Takes the next bytes as a view of numbers.
   * @param {number} length
   */
  const takeView = (length) => {
    const bytes = take(length);
    return new DataView(bytes.buffer, bytes.byteOffset, length);
  };
  const header = takeView(HEADER_BYTES), classCount = header.getUint8(0);
  const areClassesValid = classCount >= 1 && classCount <= MAX_CLASSES && classes.every((each) => each < classCount);
  assertValid(areClassesValid, "a class of points has no step size");
  const flags = decodeIntegers(take(header.getUint32(1, true)), count, classes, false);
  assertValid(flags.every((flag) => flag <= 1), "a flag is neither 0 nor 1");
  const basis = [];
  if (isColor) {
    const view = takeView(BASIS_BYTES);
    for (let i = 0; i < 9; i++) basis.push(view.getFloat32(4 * i, true));
    assertValid(basis.every((number) => Math.abs(number) <= MAX_ABS_BASIS_ENTRY), "its basis is not orthonormal");
  }
  const rows = []; // Gaussians that have residuals
  for (let i = 0; i < count; i++) if (flags[i]) rows.push(i);
  const values = new Float64Array(count * columns);
  for (let first = 0, band = 0; first < columns; band++) {
    const width = isColor ? 3 * (2 * band + 1) : 2 + band, components = isColor ? 3 : width;
    const codes = take(classCount), contexts = new Uint8Array(rows.length * width);
    for (let k = 0, at = 0; k < rows.length; k++) {
      for (let j = 0; j < width; j++) contexts[at++] = classes[rows[k]] + classCount * (j % components);
    }
    const symbols = decodeIntegers(take(takeView(4).getUint32(0, true)), contexts.length, contexts, true);
    for (let k = 0, at = 0; k < rows.length; k++) {
      const step = STEP_BY_CODE[codes[classes[rows[k]]]];
      for (let j = 0; j < width; j++, at++) {
        assertValid(Math.abs(symbols[at]) <= MAX_ABS_SYMBOL, "a residual has too many steps");
        values[rows[k] * columns + first + j] = (symbols[at] * step) / FIXED_POINT_ONE;
      }
    }
    first += width;
  }
  assertValid(place === data.length, `${data.length - place} bytes follow its last band`);
  if (!isColor) return new Float32Array(values);
  const numbers = new Float32Array(count * columns);
  for (const row of rows) {
    for (let at = row * columns; at < (row + 1) * columns; at += 3) {
      for (let k = 0; k < 9; k += 3) {
        numbers[at + k / 3] = values[at] * basis[k] + values[at + 1] * basis[k + 1] + values[at + 2] * basis[k + 2];
      }
    }
  }
  return numbers;
};

/**
 * Corrects the outputs of the geometry field for a Gaussian: opacity, three scales, rotation wxyz.
 * @param {Float64Array} outputs
 * @param {number} at the index of the first output
 * @param {Float32Array} residuals
 * @param {number} from the index of the Gaussian's first residual
 */
export const addShapeResiduals = (outputs, at, residuals, from) => {
  const a = residuals[from], b = residuals[from + 1];
  const x = residuals[from + 2], y = residuals[from + 3], z = residuals[from + 4];
  const w = outputs[at + 4] + 1, i = outputs[at + 5], j = outputs[at + 6], k = outputs[at + 7];
  outputs[at + 1] += a;
  outputs[at + 2] += b;
  outputs[at + 3] -= a + b;
  outputs[at + 4] -= i * x + j * y + k * z;
  outputs[at + 5] += w * x + j * z - k * y;
  outputs[at + 6] += w * y + k * x - i * z;
  outputs[at + 7] += w * z + i * y - j * x;
};

/** Corrects colours by the residuals of a model. */
export class ColorResiduals {
  /**
   * @param {Float32Array} residuals
   * @param {number} degree of the harmonics
   */
  constructor(residuals, degree) {
    this.residuals = residuals;
    this.degree = degree;
    this.basis = new Float64Array((degree + 1) ** 2);
  }

  /**
   * Returns a channel of a colour with its residuals along the direction of the last call of `turn`.
   * @param {number} color
   * @param {number} gaussian the index of the Gaussian
   * @param {number} channel 0 to 2
   */
  corrected(color, gaussian, channel) {
    const { residuals, basis } = this, from = 3 * basis.length * gaussian + channel;
    let sum = color;
    for (let k = 0; k < basis.length; k++) sum += basis[k] * residuals[from + 3 * k];
    return Math.max(0, sum);
  }

  /**
   * Evaluates the harmonics of a direction, for the next calls of `corrected`.
   * @param {Float32Array} directions
   * @param {number} at the index of the direction's x
   */
  turn(directions, at) {
    evaluateBasis(this.degree, directions[at], directions[at + 1], directions[at + 2], this.basis);
  }
}
