/**
 * Computes the CRC-32 of bytes.
 * @param {Uint8Array} bytes
 * @returns {number} 0 to 2^32 - 1
 */
export declare const crc32: (bytes: Uint8Array) => number;
