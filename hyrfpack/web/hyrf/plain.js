// Codecs 1 to 4 (docs/format.md 2.2): numbers as they are, and the two quantisers of profile paper.

import { readUint64 } from "./container.js";
import { needSound } from "./errors.js";
import { decodeHuffman } from "./huffman.js";

const MOST_STAGES = 16;
const VECTORS_HEADER = 4;
const MIN_MAX_HEADER = 9;

/**
 * The number of a binary16.
 * @param {number} bits
 */
const halfToNumber = (bits) => {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return exponent ? sign * 2 ** (exponent - 15) * (1 + fraction / 1024) : sign * 2 ** -24 * fraction;
};

/**
 * @param {Uint8Array} data
 * @param {number} count
 * @param {number} width bytes of a number
 */
const needNumbers = (data, count, width) =>
  needSound(data.length === count * width, `it has ${data.length} bytes, and ${count} numbers take ${count * width}`);

/**
 * Codec 1.
 * @param {Uint8Array} data
 * @param {number} count
 */
export const decodeFloat32 = (data, count) => {
  needNumbers(data, count, 4);
  const view = new DataView(data.buffer, data.byteOffset, data.length), numbers = new Float32Array(count);
  for (let i = 0; i < count; i++) numbers[i] = view.getFloat32(4 * i, true);
  return numbers;
};

/**
 * Codec 2.
 * @param {Uint8Array} data
 * @param {number} count
 */
export const decodeFloat16 = (data, count) => {
  needNumbers(data, count, 2);
  const numbers = new Float32Array(count);
  for (let i = 0; i < count; i++) numbers[i] = halfToNumber(data[2 * i] | (data[2 * i + 1] << 8));
  return numbers;
};

/**
 * Codec 3: each row is the sum of a codeword of every stage.
 * @param {Uint8Array} data
 * @param {number} rows
 * @param {number} columns
 */
export const decodeVectors = (data, rows, columns) => {
  needSound(data.length >= VECTORS_HEADER, "it ends within its header");
  const stages = data[0], words = data[2] | (data[3] << 8), booksEnd = VECTORS_HEADER + 2 * stages * words * columns;
  const isKnown = stages >= 1 && stages <= MOST_STAGES && data[1] === columns && words >= 1;
  needSound(isKnown && booksEnd <= data.length, "the sizes of its codebooks cannot be");
  const books = decodeFloat16(data.subarray(VECTORS_HEADER, booksEnd), stages * words * columns);
  needSound(books.every(Number.isFinite), "its codebooks hold numbers that are not finite");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const numbers = new Float32Array(rows * columns);
  let place = booksEnd;
  for (let stage = 0; stage < stages; stage++) {
    needSound(place + 8 <= data.length, "it ends before its last stage");
    const start = place + 8;
    place = start + readUint64(view, place);
    needSound(place <= data.length, "it ends before its last stage");
    const indices = decodeHuffman(data.subarray(start, place), rows);
    const book = books.subarray(stage * words * columns, (stage + 1) * words * columns);
    for (let row = 0, at = 0; row < rows; row++) {
      needSound(indices[row] < words, "it refers to a codeword that is not there");
      for (let word = indices[row] * columns, end = word + columns; word < end; ) numbers[at++] += book[word++];
    }
  }
  needSound(place === data.length, `${data.length - place} bytes follow its last stage`);
  return numbers;
};

/**
 * Codec 4: even levels between a minimum and a maximum.
 * @param {Uint8Array} data
 * @param {number} count
 */
export const decodeMinMax = (data, count) => {
  needSound(data.length >= MIN_MAX_HEADER, "it ends within its header");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const minimum = view.getFloat32(0, true), maximum = view.getFloat32(4, true), bits = data[8];
  const isRange = minimum > -Infinity && minimum <= maximum && maximum < Infinity;
  needSound(isRange && bits >= 1 && bits <= 16, "its range cannot be");
  const codes = decodeHuffman(data.subarray(MIN_MAX_HEADER), count), last = 2 ** bits - 1;
  const numbers = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    needSound(codes[i] <= last, `a code has more than ${bits} bits`);
    numbers[i] = ((last - codes[i]) * minimum + codes[i] * maximum) / last;
  }
  return numbers;
};
