/**
 * Decodes integers that fit Int32Array.
 * @param {Uint8Array} data exactly the bytes of the integers
 * @param {number} count
 * @param {Uint8Array | null} contexts the context of each integer; null if there is one context
 * @param {boolean} isSigned whether the lowest bit of each stored integer is its sign
 * @returns {Int32Array}
 * @throws {DamagedData} the stream is damaged, or an integer is too large
 */
export declare const decodeIntegers: (data: Uint8Array, count: number, contexts: Uint8Array | null, isSigned: boolean) => Int32Array;
/** The number of bits in the lower half of a wide integer. */
export declare const LOW_HALF_BITS = 27;
/**
 * Decodes integers below 2^56 as two halves: high 2^27 + low.
 * @param {Uint8Array} data exactly the bytes of the integers
 * @param {number} count
 * @returns {{high: Int32Array, low: Int32Array}}
 * @throws {DamagedData} the stream is damaged
 */
export declare const decodeWideIntegers: (data: Uint8Array, count: number) => {
    high: Int32Array;
    low: Int32Array;
};
