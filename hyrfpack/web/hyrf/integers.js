// Streams of integers (docs/format.md 3.1): a token for the size of each, and its lower bits as they are.

import { BitReader, MOST_BITS_AT_ONCE } from "./bits.js";
import { needSound } from "./errors.js";
import { decodeTokens } from "./rans.js";

const TOKEN_COUNT = 126;
const FIRST_WIDE_TOKEN = 78; // stands for 2^32 and more

// Of each token: the bits of its integers that follow it, and the highest bits that it stands for.
const EXTRA_BITS = new Uint8Array(TOKEN_COUNT);
const LEADING_BITS = new Uint8Array(TOKEN_COUNT);
for (let token = 0; token < TOKEN_COUNT; token++) {
  if (token < 16) {
    LEADING_BITS[token] = token;
  } else if (token < 28) {
    EXTRA_BITS[token] = (token >> 2) - 2;
    LEADING_BITS[token] = 4 + (token & 3);
  } else {
    EXTRA_BITS[token] = ((token - 14) >> 1) - 1;
    LEADING_BITS[token] = 2 + (token & 1);
  }
}

/** @param {Uint8Array} tokens */
const extraBitsOf = (tokens) => {
  let bits = 0;
  for (let i = 0; i < tokens.length; i++) bits += EXTRA_BITS[tokens[i]];
  return bits;
};

/**
 * Integers of 32 bits; where a section may hold them, larger ones are damage.
 * @param {Uint8Array} data no more and no fewer bytes than they take
 * @param {number} count
 * @param {Uint8Array | null} contexts of each integer; null if there is one context
 * @param {boolean} isSigned
 * @returns {Int32Array}
 * @throws {DamagedData}
 */
export const decodeIntegers = (data, count, contexts, isSigned) => {
  const { tokens, end } = decodeTokens(data, count, contexts);
  const reader = new BitReader(data.subarray(end), extraBitsOf(tokens));
  const values = new Int32Array(count);
  for (let i = 0; i < count; i++) {
    const token = tokens[i], bits = EXTRA_BITS[token];
    let value = LEADING_BITS[token];
    if (bits > MOST_BITS_AT_ONCE) {
      needSound(token < FIRST_WIDE_TOKEN, "an integer is out of range");
      const low = reader.take(MOST_BITS_AT_ONCE);
      value = (value << bits) | (reader.take(bits - MOST_BITS_AT_ONCE) << MOST_BITS_AT_ONCE) | low;
    } else if (bits > 0) {
      value = (value << bits) | reader.take(bits);
    }
    if (isSigned) value = (value >>> 1) ^ -(value & 1);
    else needSound(value >= 0, "an integer is out of range");
    values[i] = value;
  }
  return values;
};

/** Bits of the lower half of a wide integer. */
export const HALF_BITS = 27;

/**
 * Integers below 2^56 in halves: high 2^27 + low.
 * @param {Uint8Array} data no more and no fewer bytes than they take
 * @param {number} count
 * @returns {{high: Int32Array, low: Int32Array}}
 * @throws {DamagedData}
 */
export const decodeWideIntegers = (data, count) => {
  const { tokens, end } = decodeTokens(data, count, null);
  const reader = new BitReader(data.subarray(end), extraBitsOf(tokens));
  const high = new Int32Array(count), low = new Int32Array(count);
  const half = HALF_BITS - MOST_BITS_AT_ONCE;
  for (let i = 0; i < count; i++) {
    const bits = EXTRA_BITS[tokens[i]], leading = LEADING_BITS[tokens[i]];
    if (bits < MOST_BITS_AT_ONCE) {
      low[i] = (leading << bits) | reader.take(bits);
      continue;
    }
    const lowest = reader.take(MOST_BITS_AT_ONCE), left = bits - MOST_BITS_AT_ONCE;
    let rest = leading << left; // the bits above, at most 32
    rest |= reader.take(Math.min(left, MOST_BITS_AT_ONCE));
    if (left > MOST_BITS_AT_ONCE) rest |= reader.take(left - MOST_BITS_AT_ONCE) << MOST_BITS_AT_ONCE;
    low[i] = ((rest & ((1 << half) - 1)) << MOST_BITS_AT_ONCE) | lowest;
    high[i] = rest >>> half;
  }
  return { high, low };
};
