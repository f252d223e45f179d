/**
 * Returns the quaternion of a rotation matrix, given by its rows.
 * @param {number[][]} rows
 */
export declare function quatOf([[a, b, c], [d, e, f], [g, h, i]]: number[][]): number[];
/**
 * Returns the rows of a quaternion's rotation matrix.
 * @param {ArrayLike<number>} quat of unit length
 */
export declare function rowsOf({ 0: w, 1: x, 2: y, 3: z }: ArrayLike<number>): number[][];
/** @param {number[]} quat */
export declare function normalizedQuat(quat: number[]): number[];
/**
 * Interpolates between two rotations along the shorter arc.
 * @param {number[]} from
 * @param {number[]} to
 * @param {number} part in [0, 1]
 */
export declare function slerp(from: number[], to: number[], part: number): number[];
