/** Rows of Gaussians, and for each the viewpoint from which it was last coloured. */
export declare class RowStates {
    balls: Float32Array<ArrayBufferLike>;
    count: number;
    eyes: Float64Array<ArrayBuffer>;
    /** @param {Float32Array} balls a ball around each row, from `rowBalls` */
    constructor(balls: Float32Array);
    /**
     * Lists the rows whose colours are out of date.
     * @param {number[]} sides from `frustumPlanes`
     * @param {number[]} eye the present viewpoint, in the units of the balls
     * @param {number} angle in radians
     * @returns {{visible: number, rows: number[]}} `visible` is the number of rows within the planes `sides`. `rows` are
     *   those among them whose viewing direction has turned by more than `angle` since they were coloured, largest turns
     *   first; rows that have no colours yet come first of all.
     */
    stale(sides: number[], eye: number[], angle: number): {
        visible: number;
        rows: number[];
    };
    /**
     * Replaces the Gaussians of a row. They have no colours yet.
     * @param {number} row
     * @param {Float32Array} ball around them, from `rowBalls`
     */
    replace(row: number, ball: Float32Array): void;
    /** Returns the rows that have no colours yet. */
    fresh(): number[];
    /**
     * Records that a row was coloured.
     * @param {number} row
     * @param {number[]} eye the viewpoint of the colours
     */
    colored(row: number, eye: number[]): void;
}
/**
 * Returns a ball around the positions of each row.
 * @param {Float32Array} positions 3 numbers per Gaussian
 * @param {number} width the number of Gaussians of a row; the last row may have fewer
 * @returns {Float32Array} x, y, z, radius of each row, at least one
 */
export declare function rowBalls(positions: Float32Array, width: number): Float32Array;
