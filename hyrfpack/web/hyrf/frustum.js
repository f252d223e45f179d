// Tests whether a sphere may be visible in a view.

import { add, mul } from "./vectors.js";

export const NEAR_PLANE_LOCAL = 0.01; // Gaussians nearer than this are not drawn; the default of hyrfpack.render_view
// Centres of Gaussians may project outside the picture, by this part of half its size; the default of
// hyrfpack.render_view.
export const CULL_MARGIN_RATIO = 0.3;

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
export function frustumPlanes({ rows, translation, fx, fy, cx, cy, width, height }, margin) {
  /** @type {(axis: number, sign: number, focal: number, reach: number) => number[]} */
  const side = (axis, sign, focal, reach) => {
    const length = Math.hypot(focal, reach);
    const [across, ahead] = [(sign * focal) / length, reach / length];
    return [...add(mul(rows[axis], across), mul(rows[2], ahead)), across * translation[axis] + ahead * translation[2]];
  };
  const [wide, high] = [(margin * width) / 2, (margin * height) / 2];
  return [
    side(0, 1, fx, cx + wide), side(0, -1, fx, width - cx + wide),
    side(1, 1, fy, cy + high), side(1, -1, fy, height - cy + high),
  ].flat();
}

/**
 * Returns whether no plane has the whole ball on its outer side.
 * @param {number[]} sides from `frustumPlanes`
 * @param {number} x
 * @param {number} y
 * @param {number} z
 * @param {number} radius
 */
export function intersectsFrustum(sides, x, y, z, radius) {
  for (let s = 0; s < 16; s += 4) {
    if (!(sides[s] * x + sides[s + 1] * y + sides[s + 2] * z + sides[s + 3] > -radius)) return false;
  }
  return true;
}
