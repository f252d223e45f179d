// Reads packed unsigned integers of different bit widths. Each value starts at the lowest free bit of the stream.

import { assertValid } from "./errors.js";

/** The maximum number of bits that one call of `BitReader.take` may read. */
export const MAX_BITS_PER_READ = 24;

/** Reads unsigned values from packed bits, from the first to the last. */
export class BitReader {
  /**
   * @param {Uint8Array} data the packed bytes, without any before or after them
   * @param {number} bits the sum of the bit widths of all values
   * @throws {DamagedData} the number of bytes does not fit `bits`, or the unused bits at the end are not zero
   */
  constructor(data, bits) {
    assertValid(data.length === Math.ceil(bits / 8), `it has ${data.length} bytes where ${bits} bits are announced`);
    assertValid(bits % 8 === 0 || data[data.length - 1] >> bits % 8 === 0, "bits after its last value are not zero");
    this.data = data;
    this.offset = 0;
    this.pending = 0; // bits that were read from `data` but not returned yet
    this.count = 0; // the number of pending bits
  }

  /**
   * Reads the next value.
   * @param {number} bits its width, 0 to MAX_BITS_PER_READ. The widths of all calls add up to at most the `bits` of the
   *   constructor.
   * @returns {number} 0 to 2^bits - 1
   */
  take(bits) {
    while (this.count < bits) {
      this.pending |= this.data[this.offset++] << this.count;
      this.count += 8;
    }
    const value = this.pending & ((1 << bits) - 1);
    this.pending >>>= bits;
    this.count -= bits;
    return value;
  }
}
