/** The maximum number of bits that one call of `BitReader.take` may read. */
export declare const MAX_BITS_PER_READ = 24;
/** Reads unsigned values from packed bits, from the first to the last. */
export declare class BitReader {
    data: Uint8Array<ArrayBufferLike>;
    offset: number;
    pending: number;
    count: number;
    /**
     * @param {Uint8Array} data the packed bytes, without any before or after them
     * @param {number} bits the sum of the bit widths of all values
     * @throws {DamagedData} the number of bytes does not fit `bits`, or the unused bits at the end are not zero
     */
    constructor(data: Uint8Array, bits: number);
    /**
     * Reads the next value.
     * @param {number} bits its width, 0 to MAX_BITS_PER_READ. The widths of all calls add up to at most the `bits` of the
     *   constructor.
     * @returns {number} 0 to 2^bits - 1
     */
    take(bits: number): number;
}
