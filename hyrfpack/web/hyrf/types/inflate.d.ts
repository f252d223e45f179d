export type DeflateCode = {
    counts: Uint16Array;
    symbols: Uint16Array;
};
/**
 * Decompresses a zlib stream.
 * @param {Uint8Array} data the whole stream, without any bytes after it
 * @param {number} length the exact number of decompressed bytes, which bounds the memory
 * @returns {Uint8Array}
 * @throws {DamagedData} the stream is damaged, or has another length
 */
export declare const inflateZlib: (data: Uint8Array, length: number) => Uint8Array;
