export declare const NEAR_PLANE_LOCAL = 0.01;
export declare const CULL_MARGIN_RATIO = 0.3;
export type View = {
    rows: number[][];
    translation: number[];
    fx: number;
    fy: number;
    cx: number;
    cy: number;
    width: number;
    height: number;
};
/**
 * A pinhole view. `rows` are the three rows of the rotation from the world (or the model's local axes) to the camera, x
 * right, y down, z forward; a point p is at rows p + translation. Focal lengths and the principal point are in pixels.
 * @typedef {{rows: number[][], translation: number[], fx: number, fy: number, cx: number, cy: number, width: number,
 *   height: number}} View
 */
/**
 * Returns the four planes through the eye and the sides of a view's picture: 4 numbers each, with unit normals that
 * point inwards.
 * @param {View} view
 * @param {number} margin the picture is enlarged on each side by this many halves of its size
 * @returns {number[]} 16 numbers
 */
export declare function frustumPlanes({ rows, translation, fx, fy, cx, cy, width, height }: View, margin: number): number[];
/**
 * Returns whether no plane has the whole ball on its outer side.
 * @param {number[]} sides from `frustumPlanes`
 * @param {number} x
 * @param {number} y
 * @param {number} z
 * @param {number} radius
 */
export declare function intersectsFrustum(sides: number[], x: number, y: number, z: number, radius: number): boolean;
