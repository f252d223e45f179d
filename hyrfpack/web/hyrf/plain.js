// Decodes plain float32 and float16 numbers and the two quantisers of the profile `paper` (codecs 1 to 4,
// docs/reference/format.md 2.2).

import { readUint64 } from "./container.js";
import { assertValid } from "./errors.js";
import { decodeHuffman } from "./huffman.js";

const MAX_STAGES = 16;
const VECTORS_HEADER_BYTES = 4;
const MIN_MAX_HEADER_BYTES = 9;

/**
 * Converts an IEEE 754 binary16 to a number.
 * @param {number} bits 16 bits
 */
export const halfToNumber = (bits) => {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return exponent ? sign * 2 ** (exponent - 15) * (1 + fraction / 1024) : sign * 2 ** -24 * fraction;
};

/**
 * Checks that `data` has the length of `count` numbers.
 * @param {Uint8Array} data
 * @param {number} count
 * @param {number} width the bytes per number
 */
const assertLength = (data, count, width) =>
  assertValid(data.length === count * width, `it has ${data.length} bytes, and ${count} numbers take ${count * width}`);

/**
 * Decodes float32 numbers (codec 1).
 * @param {Uint8Array} data
 * @param {number} count
 */
export const decodeFloat32 = (data, count) => {
  assertLength(data, count, 4);
  const view = new DataView(data.buffer, data.byteOffset, data.length), numbers = new Float32Array(count);
  for (let i = 0; i < count; i++) numbers[i] = view.getFloat32(4 * i, true);
  return numbers;
};

/**
 * Decodes float16 numbers (codec 2).
 * @param {Uint8Array} data
 * @param {number} count
 */
export const decodeFloat16 = (data, count) => {
  assertLength(data, count, 2);
  const numbers = new Float32Array(count);
  for (let i = 0; i < count; i++) numbers[i] = halfToNumber(data[2 * i] | (data[2 * i + 1] << 8));
  return numbers;
};

/**
 * Decodes a residual vector quantiser (codec 3). Each row is the sum of one codeword of each stage.
 * @param {Uint8Array} data
 * @param {number} rows
 * @param {number} columns
 */
export const decodeVectors = (data, rows, columns) => {
  assertValid(data.length >= VECTORS_HEADER_BYTES, "it ends within its header");
  const stages = data[0], codewords = data[2] | (data[3] << 8);
  const codebooksEnd = VECTORS_HEADER_BYTES + 2 * stages * codewords * columns;
  const areSizesValid = stages >= 1 && stages <= MAX_STAGES && data[1] === columns && codewords >= 1;
  assertValid(areSizesValid && codebooksEnd <= data.length, "the sizes of its codebooks are invalid");
  const codebooks = decodeFloat16(data.subarray(VECTORS_HEADER_BYTES, codebooksEnd), stages * codewords * columns);
  assertValid(codebooks.every(Number.isFinite), "its codebooks hold numbers that are not finite");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const numbers = new Float32Array(rows * columns);
  let place = codebooksEnd;
  for (let stage = 0; stage < stages; stage++) {
    assertValid(place + 8 <= data.length, "it ends before its last stage");
    const start = place + 8;
    place = start + readUint64(view, place);
    assertValid(place <= data.length, "it ends before its last stage");
    const indices = decodeHuffman(data.subarray(start, place), rows);
    const codebook = codebooks.subarray(stage * codewords * columns, (stage + 1) * codewords * columns);
    for (let row = 0, at = 0; row < rows; row++) {
      assertValid(indices[row] < codewords, "it refers to a codeword that is not there");
      for (let word = indices[row] * columns, end = word + columns; word < end; ) numbers[at++] += codebook[word++];
    }
  }
  assertValid(place === data.length, `${data.length - place} bytes follow its last stage`);
  return numbers;
};

/**
 * Decodes a uniform quantiser (codec 4), whose levels are evenly spaced from a stored minimum to a stored maximum.
 * @param {Uint8Array} data
 * @param {number} count
 */
export const decodeMinMax = (data, count) => {
  assertValid(data.length >= MIN_MAX_HEADER_BYTES, "it ends within its header");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const minimum = view.getFloat32(0, true), maximum = view.getFloat32(4, true), bits = data[8];
  const isRange = minimum > -Infinity && minimum <= maximum && maximum < Infinity;
  assertValid(isRange && bits >= 1 && bits <= 16, "its range is invalid");
  const codes = decodeHuffman(data.subarray(MIN_MAX_HEADER_BYTES), count), lastCode = 2 ** bits - 1;
  const numbers = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    assertValid(codes[i] <= lastCode, "a code has too many bits");
    numbers[i] = ((lastCode - codes[i]) * minimum + codes[i] * maximum) / lastCode;
  }
  return numbers;
};
