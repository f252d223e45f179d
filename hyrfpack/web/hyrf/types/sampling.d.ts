export type Metadata = import("./metadata.js").Metadata;
/** @typedef {import("./metadata.js").Metadata} Metadata */
/**
 * Computes the pixel size of the photos at positions: q = min over the cameras of the file that see the position of
 * z / f, with f = max(fx, fy) and the depth z in local units. Where no camera sees it, q is the minimum over all
 * cameras of distance / f. It is divided by the rate of all photos relative to theirs.
 *
 * @param {Float32Array} positions 3 n, in local units
 * @param {Metadata} metadata the checked metadata of the model
 * @returns {Float32Array} n sizes of a pixel in local units; 0 if the file has no valid cameras,
 *   or if these give no sensible size
 */
export declare function pixelSizes(positions: Float32Array, metadata: Metadata): Float32Array;
/**
 * Returns the spacing of the nodes at which training evaluated the background, at the middle of a photo: the pixels
 * between them, divided by the longest focal length of the file's cameras.
 * @param {Metadata} metadata the checked metadata of the model
 * @returns {number} the tangent of an angle; 0 if the file has no valid cameras
 */
export declare function backgroundSpacing(metadata: Metadata): number;
/**
 * Returns the pixels between the nodes at which a view evaluates the background, as far apart as in training or nearer.
 * @param {number} spacing from `backgroundSpacing`
 * @param {{fx: number, fy: number}} view at its full resolution
 * @returns {number} an integer, 1 or more
 */
export declare function backgroundStride(spacing: number, { fx, fy }: {
    fx: number;
    fy: number;
}): number;
