export declare const IDENTITY_QUAT: number[];
/**
 * Returns the rows of the rotation from a frame's local axes to the axes of the world.
 * @param {{rotation?: number[]}} frame a frame, or anything else with its rotation; absent, the axes are the same
 */
export declare const frameAxes: ({ rotation }: {
    rotation?: number[];
}) => number[][];
/**
 * Rotates a vector by a matrix, given by its rows.
 * @param {number[][]} rows
 * @param {number[]} vector
 */
export declare const rotateBy: (rows: number[][], vector: number[]) => number[];
/**
 * Rotates a vector by the inverse of a rotation matrix, given by its rows.
 * @param {number[][]} rows
 * @param {number[]} vector
 */
export declare const rotateBack: ([a, b, c]: number[][], vector: number[]) => number[];
/**
 * Returns the columns of a matrix, given by its rows.
 * @param {number[][]} rows
 */
export declare const transpose: (rows: number[][]) => number[][];
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
