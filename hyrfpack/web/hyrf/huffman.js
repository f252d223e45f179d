// Huffman streams (docs/format.md 2.5).

import { readUint64 } from "./container.js";
import { needSound } from "./errors.js";

const HUFFMAN_HEADER = 26;
const LONGEST_HUFFMAN = 57; // bits of a code
const MOST_PEEK = 12; // bits looked up at once

/**
 * A prefix code: symbols by rising code (-1 for the end mark), lengths, and the codes as fractions of 64 bits.
 * @typedef {{symbols: Int32Array, lengths: Uint8Array, high: Uint32Array, low: Uint32Array}} HuffmanCode
 */

/**
 * @param {Uint8Array} data no more and no fewer bytes than the stream
 * @param {number} count symbols that there must be
 * @returns {Uint16Array}
 * @throws {DamagedData}
 */
export const decodeHuffman = (data, count) => {
  needSound(data.length >= HUFFMAN_HEADER, "a Huffman stream ends within its header");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const packedBytes = readUint64(view, 8), leaves = view.getUint32(16, true), endMark = view.getUint32(20, true);
  const width = data[24], wide = data[25];
  const isKnown = (width === 1 || width === 2) && (wide === 2 || wide === 4) && leaves <= 256 ** width + 1;
  needSound(isKnown && endMark <= Math.max(leaves - 1, 0), "the header of a Huffman stream cannot be");
  needSound(readUint64(view, 0) === count, `a Huffman stream codes another number of symbols than ${count}`);
  const isPossible = count <= 8 * packedBytes && count > 0 === packedBytes > 0 && (leaves > 0 || count === 0);
  needSound(isPossible, "a Huffman stream codes more symbols than its bytes can");
  const chunkLength = Math.max(1024, 2 * Math.ceil(count / 2048)), chunks = Math.ceil(count / chunkLength);
  const symbolsAt = HUFFMAN_HEADER + leaves, sizesAt = symbolsAt + Math.max(leaves - 1, 0) * width;
  const packedAt = sizesAt + chunks * wide;
  needSound(packedAt + packedBytes === data.length, "a Huffman stream has more or fewer bytes than it announces");

  const symbols = new Int32Array(leaves);
  for (let leaf = 0, at = symbolsAt; leaf < leaves; leaf++) {
    symbols[leaf] = leaf === endMark ? -1 : width === 1 ? data[at] : view.getUint16(at, true);
    if (leaf !== endMark) at += width;
  }
  const code = huffmanCode(symbols, data.subarray(HUFFMAN_HEADER, symbolsAt));
  const sizes = Float64Array.from({ length: chunks }, (_, chunk) =>
    wide === 2 ? view.getUint16(sizesAt + 2 * chunk, true) : view.getUint32(sizesAt + 4 * chunk, true),
  );
  const bits = sizes.reduce((sum, size) => sum + size, 0);
  needSound(Math.ceil(bits / 8) === packedBytes, "the chunks of a Huffman stream do not add up to its bytes");
  return decodeChunks(data.subarray(packedAt), count, chunkLength, sizes, code);
};

/**
 * @param {Int32Array} symbols
 * @param {Uint8Array} lengths
 * @returns {HuffmanCode}
 */
const huffmanCode = (symbols, lengths) => {
  const leaves = symbols.length;
  needSound(new Set(symbols).size === leaves, "a symbol has two Huffman codes");
  const areKnown = lengths.every((length) => length >= 1 && length <= LONGEST_HUFFMAN);
  needSound(areKnown, "a Huffman code has too few or too many bits");
  const high = new Uint32Array(leaves), low = new Uint32Array(leaves);
  let sumHigh = 0, sumLow = 0;
  for (let leaf = 0; leaf < leaves; leaf++) {
    const length = lengths[leaf];
    high[leaf] = sumHigh;
    low[leaf] = sumLow;
    const unitHigh = 2 ** (32 - length), unitLow = 2 ** (64 - length);
    const isAligned = length <= 32 ? sumLow === 0 && sumHigh % unitHigh === 0 : sumLow % unitLow === 0;
    needSound(isAligned && sumHigh < 2 ** 32, "the leaves of a Huffman code are not in order");
    if (length <= 32) {
      sumHigh += unitHigh;
    } else {
      sumLow += unitLow;
      if (sumLow === 2 ** 32) [sumHigh, sumLow] = [sumHigh + 1, 0];
    }
  }
  needSound(leaves === 0 || (sumHigh === 2 ** 32 && sumLow === 0), "a Huffman code is not complete");
  return { symbols, lengths, high, low };
};

/**
 * The last leaf whose code is not above these 64 bits.
 * @param {HuffmanCode} code
 * @param {number} high
 * @param {number} low
 */
const leafAt = (code, high, low) => {
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
 * @param {Uint8Array} packed
 * @param {number} count
 * @param {number} chunkLength
 * @param {Float64Array} sizes of the chunks in bits
 * @param {HuffmanCode} code
 */
const decodeChunks = (packed, count, chunkLength, sizes, code) => {
  const { symbols, lengths } = code;
  const decoded = new Uint16Array(count);
  if (count === 0) return decoded;
  // By the next bits: the leaf that they begin, or -1 where its code is longer.
  const peek = Math.min(MOST_PEEK, lengths.reduce((longest, length) => Math.max(longest, length), 0));
  const table = Int32Array.from({ length: 2 ** peek }, (_, bits) => {
    const leaf = leafAt(code, bits * 2 ** (32 - peek), 0);
    return lengths[leaf] <= peek ? leaf : -1;
  });
  /**
   * 32 bits from a place on, zeros after the end.
   * @param {number} at in bits
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
      let leaf = table[next >>> (32 - peek)];
      if (leaf < 0) leaf = leafAt(code, next, bitsAt(at + 32));
      needSound(symbols[leaf] >= 0, "the end mark of a Huffman stream comes too early");
      decoded[i] = symbols[leaf];
      at += lengths[leaf];
      needSound(at <= end, "a chunk of a Huffman stream ends elsewhere than its size says");
    }
    needSound(at === end, "a chunk of a Huffman stream ends elsewhere than its size says");
  }
  return decoded;
};
