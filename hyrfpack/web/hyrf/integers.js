// Decodes streams of integers (docs/reference/format.md 3.1). Each integer is stored as a token, for its leading bits
// and its magnitude, and extra bits, for its lower bits.

import { BitReader, MAX_BITS_PER_READ } from "./bits.js";
import { assertValid } from "./errors.js";
import { decodeTokens } from "./rans.js";

const TOKEN_COUNT = 126;
const FIRST_WIDE_TOKEN = 78; // the first token of integers that do not fit 32 bits

// For each token: the number of extra bits, and the leading bits of its integers.
const TOKEN_EXTRA_BITS = new Uint8Array(TOKEN_COUNT);
const TOKEN_LEADING_BITS = new Uint8Array(TOKEN_COUNT);
for (let token = 0; token < TOKEN_COUNT; token++) {
  if (token < 16) {
    TOKEN_LEADING_BITS[token] = token;
  } else if (token < 28) {
    TOKEN_EXTRA_BITS[token] = (token >> 2) - 2;
    TOKEN_LEADING_BITS[token] = 4 + (token & 3);
  } else {
    TOKEN_EXTRA_BITS[token] = ((token - 14) >> 1) - 1;
    TOKEN_LEADING_BITS[token] = 2 + (token & 1);
  }
}

/**
 * Returns the total number of extra bits of tokens.
 * @param {Uint8Array} tokens
 */
const sumExtraBits = (tokens) => {
  let bits = 0;
  for (let i = 0; i < tokens.length; i++) bits += TOKEN_EXTRA_BITS[tokens[i]];
  return bits;
};

/**
 * Decodes integers that fit Int32Array.
 * @param {Uint8Array} data exactly the bytes of the integers
 * @param {number} count
 * @param {Uint8Array | null} contexts the context of each integer; null if there is one context
 * @param {boolean} isSigned whether the lowest bit of each stored integer is its sign
 * @returns {Int32Array}
 * @throws {DamagedData} the stream is damaged, or an integer is too large
 */
export const decodeIntegers = (data, count, contexts, isSigned) => {
  const { tokens, end } = decodeTokens(data, count, contexts);
  const reader = new BitReader(data.subarray(end), sumExtraBits(tokens));
  const values = new Int32Array(count);
  for (let i = 0; i < count; i++) {
    const token = tokens[i], bits = TOKEN_EXTRA_BITS[token];
    let value = TOKEN_LEADING_BITS[token];
    if (bits > MAX_BITS_PER_READ) {
      assertValid(token < FIRST_WIDE_TOKEN, "an integer is out of range");
      const low = reader.take(MAX_BITS_PER_READ);
      value = (value << bits) | (reader.take(bits - MAX_BITS_PER_READ) << MAX_BITS_PER_READ) | low;
    } else if (bits > 0) {
      value = (value << bits) | reader.take(bits);
    }
    if (isSigned) value = (value >>> 1) ^ -(value & 1);
    else assertValid(value >= 0, "an integer is out of range");
    values[i] = value;
  }
  return values;
};

/** The number of bits in the lower half of a wide integer. */
export const LOW_HALF_BITS = 27;

/**
 * Decodes integers below 2^56 as two halves: high 2^27 + low.
 * @param {Uint8Array} data exactly the bytes of the integers
 * @param {number} count
 * @returns {{high: Int32Array, low: Int32Array}}
 * @throws {DamagedData} the stream is damaged
 */
export const decodeWideIntegers = (data, count) => {
  const { tokens, end } = decodeTokens(data, count, null);
  const reader = new BitReader(data.subarray(end), sumExtraBits(tokens));
  const high = new Int32Array(count), low = new Int32Array(count);
  const restBitsOfLow = LOW_HALF_BITS - MAX_BITS_PER_READ;
  for (let i = 0; i < count; i++) {
    const bits = TOKEN_EXTRA_BITS[tokens[i]], leading = TOKEN_LEADING_BITS[tokens[i]];
    if (bits < MAX_BITS_PER_READ) {
      low[i] = (leading << bits) | reader.take(bits);
      continue;
    }
    const lowest = reader.take(MAX_BITS_PER_READ), restBits = bits - MAX_BITS_PER_READ;
    let rest = leading << restBits; // all bits but the lowest 24: at most 32 bits
    rest |= reader.take(Math.min(restBits, MAX_BITS_PER_READ));
    if (restBits > MAX_BITS_PER_READ) rest |= reader.take(restBits - MAX_BITS_PER_READ) << MAX_BITS_PER_READ;
    low[i] = ((rest & ((1 << restBitsOfLow) - 1)) << MAX_BITS_PER_READ) | lowest;
    high[i] = rest >>> restBitsOfLow;
  }
  return { high, low };
};
