export type Manifest = import("./manifest.js").Manifest;
export type Camera = import("./viewpoint.js").Camera;
export type LevelSelection = {
    levels: number[];
    gaussians: number;
    bytes: number;
    predictedMse: number;
    maxGap: number;
};
/**
 * Chooses a level for each chunk, with the least predicted error of a view within a budget: a greedy knapsack.
 * @param {Manifest} manifest
 * @param {Camera} camera the view, in world units
 * @param {{gaussians?: number, bytes?: number, isAvailable?: (chunk: number, level: number) => boolean}} [options]
 *   `gaussians`: the most Gaussians, or `bytes`: the most bytes of files, with the shared files. Levels that are not
 *   available are not chosen.
 * @returns {LevelSelection}
 * @throws {TypeError} both limits are given
 */
export declare const selectLevels: (manifest: Manifest, camera: Camera, { gaussians, bytes, isAvailable }?: {
    gaussians?: number;
    bytes?: number;
    isAvailable?: (chunk: number, level: number) => boolean;
}) => LevelSelection;
/**
 * Chooses one level of each item with a low total error and a total cost of at most `limit`.
 * @param {number[][]} costs by item and level
 * @param {number[][]} errors by item and level
 * @param {number} limit
 * @param {(item: number, level: number) => boolean} isAvailable
 * @returns {{levels: number[], maxGap: number}} see LevelSelection
 */
export declare const chooseLevels: (costs: number[][], errors: number[][], limit: number, isAvailable: (item: number, level: number) => boolean) => {
    levels: number[];
    maxGap: number;
};
/**
 * Predicts the mean squared error that each level of each chunk adds to a view, and last that of leaving it out.
 * @param {Manifest} manifest
 * @param {Camera} camera
 * @returns {number[][]} by chunk and level, with one more than there are levels
 */
export declare const predictErrors: ({ chunks, error_radii }: Manifest, camera: Camera) => number[][];
