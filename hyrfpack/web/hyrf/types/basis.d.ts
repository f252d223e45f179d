/** The harmonic of degree 0, which is constant: 1 / (2 sqrt(pi)). */
export declare const SH_BAND_0 = 0.28209479177387814;
/**
 * Evaluates the real spherical harmonics of a direction with the Condon-Shortley phase, the convention of splat files.
 * @param {number} degree the largest degree, 0 to 3
 * @param {number} x
 * @param {number} y
 * @param {number} z
 * @param {Float64Array} basis receives (degree + 1)^2 numbers
 * @param {number} [at] the index of the first of them
 */
export declare function evaluateBasis(degree: number, x: number, y: number, z: number, basis: Float64Array, at?: number): void;
