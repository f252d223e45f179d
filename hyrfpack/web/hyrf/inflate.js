// Decompresses zlib streams of known decompressed length (RFC 1950 and 1951).

import { DamagedData, assertValid } from "./errors.js";

const BLOCK_STORED = 0;
const BLOCK_FIXED = 1;
const BLOCK_DYNAMIC = 2;
const MAX_DEFLATE_CODE_BITS = 15;
const LENGTH_CODE_ORDER = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
// The value of a length code or distance code is a base value plus the value of its extra bits (RFC 1951, 3.2.5).
const LENGTH_EXTRA_BITS = Array.from({ length: 29 }, (_, code) => (code < 8 || code === 28 ? 0 : (code >> 2) - 1));
const DISTANCE_EXTRA_BITS = Array.from({ length: 30 }, (_, code) => (code < 4 ? 0 : (code >> 1) - 1));
const LENGTH_BASES = [3], DISTANCE_BASES = [1];
for (let code = 1; code < 28; code++) LENGTH_BASES[code] = LENGTH_BASES[code - 1] + 2 ** LENGTH_EXTRA_BITS[code - 1];
for (let code = 1; code < 30; code++) {
  DISTANCE_BASES[code] = DISTANCE_BASES[code - 1] + 2 ** DISTANCE_EXTRA_BITS[code - 1];
}
LENGTH_BASES[28] = 258;

/**
 * A prefix code: the number of codes of each length, and the symbols in the order of their codes.
 * @typedef {{counts: Uint16Array, symbols: Uint16Array}} DeflateCode
 */

/**
 * Builds the canonical prefix code of given lengths.
 * @param {ArrayLike<number>} lengths the length of each symbol's code in bits, 0 for unused symbols
 * @param {boolean} mayBeSingle whether a code with no symbol, or with one symbol of one bit, is accepted
 * @returns {DeflateCode}
 */
const buildDeflateCode = (lengths, mayBeSingle) => {
  const counts = new Uint16Array(MAX_DEFLATE_CODE_BITS + 1), starts = new Uint16Array(MAX_DEFLATE_CODE_BITS + 2);
  for (let i = 0; i < lengths.length; i++) counts[lengths[i]]++;
  const used = lengths.length - counts[0];
  counts[0] = 0;
  let unassigned = 1; // codes of the present length that no shorter code begins
  for (let length = 1; length <= MAX_DEFLATE_CODE_BITS; length++) {
    unassigned = 2 * unassigned - counts[length];
    assertValid(unassigned >= 0, "a deflate code has too many symbols");
    starts[length + 1] = starts[length] + counts[length];
  }
  const isSingle = used === 0 || (used === 1 && counts[1] === 1);
  assertValid(unassigned === 0 || (mayBeSingle && isSingle), "a deflate code has gaps");
  const symbols = new Uint16Array(used);
  for (let i = 0; i < lengths.length; i++) if (lengths[i]) symbols[starts[lengths[i]]++] = i;
  return { counts, symbols };
};

/** The codes of literals and of distances in blocks of fixed codes. */
const FIXED_CODES = [
  buildDeflateCode(Uint8Array.from({ length: 288 }, (_, i) => (i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8)), false),
  buildDeflateCode(new Uint8Array(32).fill(5), false),
];

/**
 * Computes the Adler-32 checksum of bytes.
 * @param {Uint8Array} bytes
 */
const adler32 = (bytes) => {
  let low = 1, high = 0;
  for (const byte of bytes) {
    low = (low + byte) % 65521;
    high = (high + low) % 65521;
  }
  return ((high << 16) | low) >>> 0;
};

/**
 * Decompresses a zlib stream.
 * @param {Uint8Array} data the whole stream, without any bytes after it
 * @param {number} length the exact number of decompressed bytes, which bounds the memory
 * @returns {Uint8Array}
 * @throws {DamagedData} the stream is damaged, or has another length
 */
export const inflateZlib = (data, length) => {
  const out = new Uint8Array(length);
  let offset = 2, pending = 0, bits = 0, written = 0;

  assertValid(data.length > 2 && (data[0] & 15) === 8 && data[0] >> 4 <= 7, "it is not a zlib stream");
  assertValid((data[0] * 256 + data[1]) % 31 === 0 && !(data[1] & 32), "it is not a zlib stream");

  /**
   * Reads the next bits, the lowest first.
   * @param {number} count at most 16
   */
  const takeBits = (count) => {
    while (bits < count) {
      assertValid(offset < data.length, "a deflate stream is cut short");
      pending |= data[offset++] << bits;
      bits += 8;
    }
    const value = pending & ((1 << count) - 1);
    pending >>>= count;
    bits -= count;
    return value;
  };

  /**
   * Reads the next symbol.
   * @param {DeflateCode} code
   */
  const takeSymbol = ({ counts, symbols }) => {
    for (let length = 1, code = 0, first = 0, index = 0; length <= MAX_DEFLATE_CODE_BITS; length++) {
      code |= takeBits(1);
      const count = counts[length];
      if (code - count < first) return symbols[index + code - first];
      index += count;
      first = (first + count) << 1;
      code <<= 1;
    }
    throw new DamagedData("a deflate code is not assigned");
  };

  /** @param {number} byte */
  const putByte = (byte) => {
    assertValid(written < length, "it unpacks to too many bytes");
    out[written++] = byte;
  };

  /** Copies a block that is not compressed. */
  const copyStored = () => {
    pending = bits = 0; // a stored block begins at the next whole byte
    const count = takeBits(16), inverse = takeBits(16);
    assertValid((count ^ inverse) === 0xffff && offset + count <= data.length, "a stored block is damaged");
    assertValid(written + count <= length, "it unpacks to too many bytes");
    out.set(data.subarray(offset, offset + count), written);
    offset += count;
    written += count;
  };

  /**
   * Reads the codes of literals and of distances of a block with codes of its own.
   * @returns {DeflateCode[]}
   */
  const readDynamicCodes = () => {
    const literals = 257 + takeBits(5), distances = 1 + takeBits(5), ordered = 4 + takeBits(4);
    assertValid(literals <= 286 && distances <= 30, "a deflate block has too many symbols");
    const lengthLengths = new Uint8Array(19);
    for (let i = 0; i < ordered; i++) lengthLengths[LENGTH_CODE_ORDER[i]] = takeBits(3);
    const lengthCode = buildDeflateCode(lengthLengths, false);
    const lengths = new Uint8Array(literals + distances);
    for (let i = 0; i < lengths.length; ) {
      const symbol = takeSymbol(lengthCode);
      if (symbol < 16) {
        lengths[i++] = symbol;
        continue;
      }
      assertValid(symbol > 16 || i > 0, "a deflate block repeats a length that is not there");
      const repeated = symbol === 16 ? lengths[i - 1] : 0;
      const count = symbol === 16 ? 3 + takeBits(2) : symbol === 17 ? 3 + takeBits(3) : 11 + takeBits(7);
      assertValid(i + count <= lengths.length, "a deflate block has too many lengths");
      lengths.fill(repeated, i, i + count);
      i += count;
    }
    assertValid(lengths[256] > 0, "a deflate block has no end");
    return [buildDeflateCode(lengths.subarray(0, literals), true), buildDeflateCode(lengths.subarray(literals), true)];
  };

  /**
   * Decompresses a block.
   * @param {DeflateCode[]} codes those of literals and of distances
   */
  const inflateBlock = ([literalCode, distanceCode]) => {
    for (;;) {
      const symbol = takeSymbol(literalCode);
      if (symbol < 256) {
        putByte(symbol);
        continue;
      }
      if (symbol === 256) return;
      const lengthIndex = symbol - 257;
      assertValid(lengthIndex < 29, "a deflate code is not assigned");
      const count = LENGTH_BASES[lengthIndex] + takeBits(LENGTH_EXTRA_BITS[lengthIndex]);
      const distanceIndex = takeSymbol(distanceCode);
      assertValid(distanceIndex < 30, "a deflate code is not assigned");
      const distance = DISTANCE_BASES[distanceIndex] + takeBits(DISTANCE_EXTRA_BITS[distanceIndex]);
      assertValid(distance <= written, "a back-reference points before the start");
      for (let i = 0; i < count; i++) putByte(out[written - distance]);
    }
  };

  for (let isLast = false; !isLast; ) {
    isLast = takeBits(1) === 1;
    const kind = takeBits(2);
    assertValid(kind <= BLOCK_DYNAMIC, "a deflate block has an unknown kind");
    if (kind === BLOCK_STORED) copyStored();
    else inflateBlock(kind === BLOCK_FIXED ? FIXED_CODES : readDynamicCodes());
  }
  assertValid(written === length && offset + 4 === data.length, `it does not unpack to ${length} bytes`);
  const checksum = new DataView(data.buffer, data.byteOffset).getUint32(offset);
  assertValid(checksum === adler32(out), "the checksum of what it unpacks to is wrong");
  return out;
};
