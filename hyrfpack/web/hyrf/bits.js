// Bits of varying number, packed one after another: the lowest bit of a value first, into the lowest free bit.

import { needSound } from "./errors.js";

/** Most bits that are read at once. */
export const MOST_BITS_AT_ONCE = 24;

export class BitReader {
  /**
   * @param {Uint8Array} data the packed bytes, no more and no fewer
   * @param {number} bits of all values together
   * @throws {DamagedData} there are more or fewer bytes than that takes, or the bits left over are not zero
   */
  constructor(data, bits) {
    needSound(data.length === Math.ceil(bits / 8), `it has ${data.length} bytes where ${bits} bits are announced`);
    needSound(bits % 8 === 0 || data[data.length - 1] >> bits % 8 === 0, "bits after its last value are not zero");
    this.data = data;
    this.place = 0;
    this.held = 0; // bits that were read and not taken
    this.count = 0; // how many
  }

  /**
   * The next value.
   * @param {number} bits at most MOST_BITS_AT_ONCE; together with those before no more than there are
   */
  take(bits) {
    while (this.count < bits) {
      this.held |= this.data[this.place++] << this.count;
      this.count += 8;
    }
    const value = this.held & ((1 << bits) - 1);
    this.held >>>= bits;
    this.count -= bits;
    return value;
  }
}
