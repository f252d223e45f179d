// Where a part of a merged scene lies: p' = scale rows p + shift, from the part's local units to those of the scene.

import { frameAxes, rotateBack, rotateBy } from "./rotation.js";
import { add, mul, sub } from "./vectors.js";

/**
 * Where a part lies: `rows` are those of the rotation from the part's local axes to those of the scene.
 * @typedef {{rows: number[][], scale: number, shift: number[]}} Place
 *
 * @typedef {import("./frustum.js").View & {eye?: number[]}} View
 */

/** The place of the scene itself. @type {Place} */
export const IDENTITY_PLACE = { rows: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], scale: 1, shift: [0, 0, 0] };

/**
 * Returns the place of a part in the local units of the scene.
 * @param {import("./metadata.js").Frame} own the frame of the part
 * @param {import("./metadata.js").Frame} scene the frame of the scene
 * @returns {Place}
 */
export function placeOf(own, scene) {
  if (own === scene) return IDENTITY_PLACE;
  const ownAxes = frameAxes(own), sceneAxes = frameAxes(scene);
  // Column k of the rotation is where the part's axis k points.
  const columns = IDENTITY_PLACE.rows.map((axis) => rotateBack(sceneAxes, rotateBy(ownAxes, axis)));
  const rows = [0, 1, 2].map((k) => columns.map((column) => column[k]));
  const shift = rotateBack(sceneAxes, mul(sub(own.center, scene.center), 1 / scene.scale));
  return { rows, scale: own.scale / scene.scale, shift };
}

/**
 * Returns a view of the scene in the axes and units of a part.
 * @template {View} SceneView
 * @param {SceneView} view
 * @param {Place} place
 * @returns {SceneView}
 */
export function viewFromPlace(view, { rows, scale, shift }) {
  const translation = mul(add(rotateBy(view.rows, shift), view.translation), 1 / scale);
  const moved = { ...view, rows: view.rows.map((row) => rotateBack(rows, row)), translation };
  return view.eye ? { ...moved, eye: rotateBack(rows, mul(sub(view.eye, shift), 1 / scale)) } : moved;
}

/**
 * Returns positions (3 N) of a part in the scene's units: the same array if the part is the scene.
 * @param {Float32Array} positions
 * @param {Place} place
 */
export function movePositions(positions, place) {
  if (place === IDENTITY_PLACE) return positions;
  const { rows, scale, shift } = place, moved = new Float32Array(positions.length);
  for (let p = 0; p < positions.length; p += 3) {
    const x = positions[p], y = positions[p + 1], z = positions[p + 2];
    for (let k = 0; k < 3; k++) moved[p + k] = (rows[k][0] * x + rows[k][1] * y + rows[k][2] * z) * scale + shift[k];
  }
  return moved;
}
