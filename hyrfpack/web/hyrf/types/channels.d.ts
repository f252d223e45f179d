export type LatticePoints = import("./lattice.js").LatticePoints;
/**
 * Decodes a section of 1 or 3 channels.
 * @param {Uint8Array} data the bytes of the section
 * @param {LatticePoints} points the positions of the same Gaussians
 * @param {number} columns 1, or 3 for channels that are coordinates in an orthonormal basis
 * @returns {Float32Array} (N x columns), row by row
 * @throws {DamagedData} a length, a header or a number is invalid
 */
export declare const decodeChannels: (data: Uint8Array, points: LatticePoints, columns: number) => Float32Array;
