/**
 * Converts an IEEE 754 binary16 to a number.
 * @param {number} bits 16 bits
 */
export declare const halfToNumber: (bits: number) => number;
/**
 * Decodes float32 numbers (codec 1).
 * @param {Uint8Array} data
 * @param {number} count
 */
export declare const decodeFloat32: (data: Uint8Array, count: number) => Float32Array<ArrayBuffer>;
/**
 * Decodes float16 numbers (codec 2).
 * @param {Uint8Array} data
 * @param {number} count
 */
export declare const decodeFloat16: (data: Uint8Array, count: number) => Float32Array<ArrayBuffer>;
/**
 * Decodes a residual vector quantiser (codec 3). Each row is the sum of one codeword of each stage.
 * @param {Uint8Array} data
 * @param {number} rows
 * @param {number} columns
 */
export declare const decodeVectors: (data: Uint8Array, rows: number, columns: number) => Float32Array<ArrayBuffer>;
/**
 * Decodes a uniform quantiser (codec 4), whose levels are evenly spaced from a stored minimum to a stored maximum.
 * @param {Uint8Array} data
 * @param {number} count
 */
export declare const decodeMinMax: (data: Uint8Array, count: number) => Float32Array<ArrayBuffer>;
