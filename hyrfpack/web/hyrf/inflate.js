// Inflate (RFC 1950 and 1951): a zlib stream of which the unpacked length is known.

import { needSound } from "./errors.js";

const BLOCK_FIXED = 1, BLOCK_DYNAMIC = 2;
const LONGEST_CODE = 15;
const LENGTH_CODE_ORDER = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
// The least length, and the least distance, of each code, and how many bits tell how much more it is.
const LENGTH_BITS = Array.from({ length: 29 }, (_, code) => (code < 8 || code === 28 ? 0 : (code >> 2) - 1));
const DISTANCE_BITS = Array.from({ length: 30 }, (_, code) => (code < 4 ? 0 : (code >> 1) - 1));
const LENGTH_BASES = [3], DISTANCE_BASES = [1];
for (let code = 1; code < 28; code++) LENGTH_BASES[code] = LENGTH_BASES[code - 1] + 2 ** LENGTH_BITS[code - 1];
for (let code = 1; code < 30; code++) DISTANCE_BASES[code] = DISTANCE_BASES[code - 1] + 2 ** DISTANCE_BITS[code - 1];
LENGTH_BASES[28] = 258;

/**
 * A prefix code: how many codes there are of each length, and the symbols by rising code.
 * @typedef {{counts: Uint16Array, symbols: Uint16Array}} DeflateCode
 */

/**
 * @param {ArrayLike<number>} lengths of each symbol's code in bits, 0 for none
 * @param {boolean} mayBeSingle whether one code of one bit will do
 * @returns {DeflateCode}
 */
const deflateCode = (lengths, mayBeSingle) => {
  const counts = new Uint16Array(LONGEST_CODE + 1), places = new Uint16Array(LONGEST_CODE + 2);
  for (let i = 0; i < lengths.length; i++) counts[lengths[i]]++;
  const used = lengths.length - counts[0];
  counts[0] = 0;
  let left = 1;
  for (let length = 1; length <= LONGEST_CODE; length++) {
    left = 2 * left - counts[length];
    needSound(left >= 0, "a deflate code has too many symbols");
    places[length + 1] = places[length] + counts[length];
  }
  needSound(left === 0 || (mayBeSingle && (used === 0 || (used === 1 && counts[1] === 1))), "a deflate code has gaps");
  const symbols = new Uint16Array(used);
  for (let i = 0; i < lengths.length; i++) if (lengths[i]) symbols[places[lengths[i]]++] = i;
  return { counts, symbols };
};

/** @param {Uint8Array} bytes */
const adler32 = (bytes) => {
  let low = 1, high = 0;
  for (const byte of bytes) {
    low = (low + byte) % 65521;
    high = (high + low) % 65521;
  }
  return ((high << 16) | low) >>> 0;
};

/**
 * What a zlib stream unpacks to: exactly `length` bytes, and the stream ends where the data ends.
 * @param {Uint8Array} data
 * @param {number} length never more is made
 * @returns {Uint8Array}
 * @throws {DamagedData} it does not
 */
export const inflateZlib = (data, length) => {
  const out = new Uint8Array(length);
  let place = 2, held = 0, bits = 0, made = 0;

  needSound(data.length > 2 && (data[0] & 15) === 8 && data[0] >> 4 <= 7, "it is not a zlib stream");
  needSound((data[0] * 256 + data[1]) % 31 === 0 && !(data[1] & 32), "it is not a zlib stream");

  /** @param {number} count at most 16 */
  const takeBits = (count) => {
    while (bits < count) {
      needSound(place < data.length, "its deflate stream ends too early");
      held |= data[place++] << bits;
      bits += 8;
    }
    const value = held & ((1 << count) - 1);
    held >>>= count;
    bits -= count;
    return value;
  };

  /** @param {DeflateCode} code */
  const takeSymbol = ({ counts, symbols }) => {
    for (let length = 1, code = 0, first = 0, index = 0; length <= LONGEST_CODE; length++) {
      code |= takeBits(1);
      const count = counts[length];
      if (code - count < first) return symbols[index + code - first];
      index += count;
      first = (first + count) << 1;
      code <<= 1;
    }
    needSound(false, "its deflate stream holds a code that means nothing");
    return 0;
  };

  /** @param {number} byte */
  const putByte = (byte) => {
    needSound(made < length, `it unpacks to more than ${length} bytes`);
    out[made++] = byte;
  };

  const copyStored = () => {
    held = bits = 0; // the rest of the byte
    const count = takeBits(16), inverse = takeBits(16);
    needSound((count ^ inverse) === 0xffff && place + count <= data.length, "a stored block is damaged");
    needSound(made + count <= length, `it unpacks to more than ${length} bytes`);
    out.set(data.subarray(place, place + count), made);
    place += count;
    made += count;
  };

  const fixedCodes = () => {
    const lengths = Uint8Array.from({ length: 288 }, (_, i) => (i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8));
    return [deflateCode(lengths, false), deflateCode(new Uint8Array(32).fill(5), false)];
  };

  const dynamicCodes = () => {
    const literals = 257 + takeBits(5), distances = 1 + takeBits(5), ordered = 4 + takeBits(4);
    needSound(literals <= 286 && distances <= 30, "a deflate block has too many symbols");
    const lengthLengths = new Uint8Array(19);
    for (let i = 0; i < ordered; i++) lengthLengths[LENGTH_CODE_ORDER[i]] = takeBits(3);
    const lengthCode = deflateCode(lengthLengths, false);
    const lengths = new Uint8Array(literals + distances);
    for (let i = 0; i < lengths.length; ) {
      const symbol = takeSymbol(lengthCode);
      if (symbol < 16) {
        lengths[i++] = symbol;
        continue;
      }
      needSound(symbol > 16 || i > 0, "a deflate block repeats a length that is not there");
      const repeated = symbol === 16 ? lengths[i - 1] : 0;
      const count = symbol === 16 ? 3 + takeBits(2) : symbol === 17 ? 3 + takeBits(3) : 11 + takeBits(7);
      needSound(i + count <= lengths.length, "a deflate block has too many lengths");
      lengths.fill(repeated, i, i + count);
      i += count;
    }
    needSound(lengths[256] > 0, "a deflate block has no end");
    return [deflateCode(lengths.subarray(0, literals), true), deflateCode(lengths.subarray(literals), true)];
  };

  /** @param {DeflateCode[]} codes */
  const copyCoded = ([literalCode, distanceCode]) => {
    for (;;) {
      const symbol = takeSymbol(literalCode);
      if (symbol < 256) {
        putByte(symbol);
        continue;
      }
      if (symbol === 256) return;
      const order = symbol - 257;
      needSound(order < 29, "its deflate stream holds a code that means nothing");
      const count = LENGTH_BASES[order] + takeBits(LENGTH_BITS[order]);
      const far = takeSymbol(distanceCode);
      needSound(far < 30, "its deflate stream holds a code that means nothing");
      const distance = DISTANCE_BASES[far] + takeBits(DISTANCE_BITS[far]);
      needSound(distance <= made, "its deflate stream refers to what was never there");
      for (let i = 0; i < count; i++) putByte(out[made - distance]);
    }
  };

  for (let last = false; !last; ) {
    last = takeBits(1) === 1;
    const kind = takeBits(2);
    needSound(kind <= BLOCK_DYNAMIC, "a deflate block is of an unknown kind");
    if (kind === 0) copyStored();
    else copyCoded(kind === BLOCK_FIXED ? fixedCodes() : dynamicCodes());
  }
  needSound(made === length && place + 4 === data.length, `it does not unpack to ${length} bytes`);
  const checksum = new DataView(data.buffer, data.byteOffset).getUint32(place);
  needSound(checksum === adler32(out), "the checksum of what it unpacks to is wrong");
  return out;
};
