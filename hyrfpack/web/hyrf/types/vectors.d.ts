/**
 * @param {number[]} a
 * @param {number[]} b
 */
export declare const add: (a: number[], b: number[]) => number[];
/**
 * @param {number[]} a
 * @param {number[]} b
 */
export declare const sub: (a: number[], b: number[]) => number[];
/**
 * @param {number[]} a
 * @param {number} s
 */
export declare const mul: (a: number[], s: number) => number[];
/**
 * @param {number[]} a
 * @param {number[]} b
 */
export declare const dot: (a: number[], b: number[]) => number;
/**
 * @param {number[]} a
 * @param {number[]} b
 */
export declare const cross: (a: number[], b: number[]) => number[];
/**
 * Returns the vector of unit length with the direction of `a`. Zero stays zero.
 * @param {number[]} a
 */
export declare const unit: (a: number[]) => number[];
/**
 * Rotates a vector about a unit axis by an angle in radians (Rodrigues' formula).
 * @param {number[]} vector
 * @param {number[]} axis
 * @param {number} angle
 */
export declare function rotate(vector: number[], axis: number[], angle: number): number[];
