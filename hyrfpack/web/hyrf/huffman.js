// Decodes Huffman streams (docs/reference/format.md 2.5).

import { readUint64 } from "./container.js";
import { assertValid } from "./errors.js";

const HUFFMAN_HEADER_BYTES = 26;
const MAX_HUFFMAN_CODE_BITS = 57;
const MAX_LOOKUP_BITS = 12; // longer codes are found by binary search

/**
 * A prefix code: its symbols in the order of their codes (-1 for the end mark), the codes' lengths in bits, and the
 * codes as fractions of 2^64, in two halves.
 * @typedef {{symbols: Int32Array, lengths: Uint8Array, high: Uint32Array, low: Uint32Array}} HuffmanCode
 */

/**
 * Decodes a Huffman stream.
 * @param {Uint8Array} data exactly the bytes of the stream
 * @param {number} count the expected number of symbols
 * @returns {Uint16Array} the symbols
 * @throws {DamagedData} the stream is damaged, or has another number of symbols
 */
export const decodeHuffman = (data, count) => {
  assertValid(data.length >= HUFFMAN_HEADER_BYTES, "a Huffman stream has another length");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const packedBytes = readUint64(view, 8), leaves = view.getUint32(16, true), endMark = view.getUint32(20, true);
  const symbolBytes = data[24], sizeBytes = data[25];
  const areWidthsValid = (symbolBytes === 1 || symbolBytes === 2) && (sizeBytes === 2 || sizeBytes === 4);
  const areCountsValid = areWidthsValid && leaves <= 256 ** symbolBytes + 1;
  const isEndMarkValid = endMark <= Math.max(leaves - 1, 0);
  assertValid(areCountsValid && isEndMarkValid, "the header of a Huffman stream has invalid values");
  assertValid(readUint64(view, 0) === count, `a Huffman stream has another number of symbols than ${count}`);
  const isPossible = count <= 8 * packedBytes && count > 0 === packedBytes > 0 && (leaves > 0 || count === 0);
  assertValid(isPossible, "a Huffman stream has too many symbols");
  const chunkLength = Math.max(1024, 2 * Math.ceil(count / 2048)), chunks = Math.ceil(count / chunkLength);
  const symbolsAt = HUFFMAN_HEADER_BYTES + leaves, sizesAt = symbolsAt + Math.max(leaves - 1, 0) * symbolBytes;
  const packedAt = sizesAt + chunks * sizeBytes;
  assertValid(packedAt + packedBytes === data.length, "a Huffman stream has another length");

  const symbols = new Int32Array(leaves);
  for (let leaf = 0, at = symbolsAt; leaf < leaves; leaf++) {
    symbols[leaf] = leaf === endMark ? -1 : symbolBytes === 1 ? data[at] : view.getUint16(at, true);
    if (leaf !== endMark) at += symbolBytes;
  }
  const code = buildHuffmanCode(symbols, data.subarray(HUFFMAN_HEADER_BYTES, symbolsAt));
  const sizes = Float64Array.from({ length: chunks }, (_, chunk) =>
    sizeBytes === 2 ? view.getUint16(sizesAt + 2 * chunk, true) : view.getUint32(sizesAt + 4 * chunk, true),
  );
  const bits = sizes.reduce((sum, size) => sum + size, 0);
  assertValid(Math.ceil(bits / 8) === packedBytes, "a Huffman stream has another length");
  return decodeChunks(data.subarray(packedAt), count, chunkLength, sizes, code);
};

/**
 * Builds the prefix code of given code lengths, and checks that it is complete.
 * @param {Int32Array} symbols in the order of their codes
 * @param {Uint8Array} lengths the length of each symbol's code in bits
 * @returns {HuffmanCode}
 * @throws {DamagedData} the lengths give no complete prefix code
 */
const buildHuffmanCode = (symbols, lengths) => {
  const leaves = symbols.length;
  assertValid(new Set(symbols).size === leaves, "a symbol has two Huffman codes");
  const areInRange = lengths.every((length) => length >= 1 && length <= MAX_HUFFMAN_CODE_BITS);
  assertValid(areInRange, "a Huffman code has too few or too many bits");
  const high = new Uint32Array(leaves), low = new Uint32Array(leaves);
  let sumHigh = 0, sumLow = 0;
  for (let leaf = 0; leaf < leaves; leaf++) {
    const length = lengths[leaf];
    high[leaf] = sumHigh;
    low[leaf] = sumLow;
    const unitHigh = 2 ** (32 - length), unitLow = 2 ** (64 - length);
    const isAligned = length <= 32 ? sumLow === 0 && sumHigh % unitHigh === 0 : sumLow % unitLow === 0;
    assertValid(isAligned && sumHigh < 2 ** 32, "the leaves of a Huffman code are not in order");
    if (length <= 32) {
      sumHigh += unitHigh;
    } else {
      sumLow += unitLow;
      if (sumLow === 2 ** 32) [sumHigh, sumLow] = [sumHigh + 1, 0];
    }
  }
  assertValid(leaves === 0 || (sumHigh === 2 ** 32 && sumLow === 0), "a Huffman code is not complete");
  return { symbols, lengths, high, low };
};

/**
 * Returns the index of the last symbol whose code is at most a number of 64 bits.
 * @param {HuffmanCode} code
 * @param {number} high the upper 32 bits
 * @param {number} low the lower 32 bits
 */
const findLeaf = (code, high, low) => {
  let from = 0, to = code.symbols.length - 1;
  while (from < to) {
    const middle = (from + to + 1) >> 1;
    const isAbove = code.high[middle] > high || (code.high[middle] === high && code.low[middle] > low);
    if (isAbove) to = middle - 1;
    else from = middle;
  }
  return from;
};

/**
 * Decodes the chunks of a stream.
 * @param {Uint8Array} packed
 * @param {number} count
 * @param {number} chunkLength the number of symbols in a chunk; the last one may have fewer
 * @param {Float64Array} sizes the length of each chunk in bits
 * @param {HuffmanCode} code
 */
const decodeChunks = (packed, count, chunkLength, sizes, code) => {
  const { symbols, lengths } = code;
  const decoded = new Uint16Array(count);
  if (count === 0) return decoded;
  // The table maps the next bits to the index of the symbol whose code starts them, or to -1 if that code is longer.
  const lookupBits = Math.min(MAX_LOOKUP_BITS, lengths.reduce((longest, length) => Math.max(longest, length), 0));
  const table = Int32Array.from({ length: 2 ** lookupBits }, (_, bits) => {
    const leaf = findLeaf(code, bits * 2 ** (32 - lookupBits), 0);
    return lengths[leaf] <= lookupBits ? leaf : -1;
  });
  /**
   * Returns the 32 bits that start at an offset. Bits after the end are 0.
   * @param {number} at the offset in bits
   */
  const bitsAt = (at) => {
    const byte = Math.floor(at / 8), shift = at % 8;
    const word = (packed[byte] << 24) | (packed[byte + 1] << 16) | (packed[byte + 2] << 8) | packed[byte + 3];
    return ((word << shift) | (packed[byte + 4] >> (8 - shift))) >>> 0;
  };
  let at = 0, end = 0;
  for (let chunk = 0; chunk < sizes.length; chunk++) {
    end += sizes[chunk];
    const stop = Math.min((chunk + 1) * chunkLength, count);
    for (let i = chunk * chunkLength; i < stop; i++) {
      const next = bitsAt(at);
      let leaf = table[next >>> (32 - lookupBits)];
      if (leaf < 0) leaf = findLeaf(code, next, bitsAt(at + 32));
      assertValid(symbols[leaf] >= 0, "a chunk of a Huffman stream is damaged");
      decoded[i] = symbols[leaf];
      at += lengths[leaf];
      assertValid(at <= end, "a chunk of a Huffman stream is damaged");
    }
    assertValid(at === end, "a chunk of a Huffman stream is damaged");
  }
  return decoded;
};
