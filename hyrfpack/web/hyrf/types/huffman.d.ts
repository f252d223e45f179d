export type HuffmanCode = {
    symbols: Int32Array;
    lengths: Uint8Array;
    high: Uint32Array;
    low: Uint32Array;
};
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
export declare const decodeHuffman: (data: Uint8Array, count: number) => Uint16Array;
