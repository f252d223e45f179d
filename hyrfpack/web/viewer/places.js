// Where a part of a merged scene lies: p' = scale rows p + shift, from the part's local units to the page's.

import { frameAxes, rotateBack, rotateBy } from "../hyrf/rotation.js";
import { add, mul, sub } from "../hyrf/vectors.js";

const IDENTITY_PLACE = { rows: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], scale: 1, shift: [0, 0, 0] };

// Returns the place of a part with the frame `own`, in the local units of the scene's frame.
export function placeOf(own, scene) {
  if (own === scene) return IDENTITY_PLACE;
  const ownAxes = frameAxes(own), sceneAxes = frameAxes(scene);
  // Column k of the rotation is where the part's axis k points.
  const columns = IDENTITY_PLACE.rows.map((axis) => rotateBack(sceneAxes, rotateBy(ownAxes, axis)));
  const rows = [0, 1, 2].map((k) => columns.map((column) => column[k]));
  const shift = rotateBack(sceneAxes, mul(sub(own.center, scene.center), 1 / scene.scale));
  return { rows, scale: own.scale / scene.scale, shift };
}

// Returns a view of the page in the axes and units of a part.
export function viewFromPlace(view, { rows, scale, shift }) {
  const translation = mul(add(rotateBy(view.rows, shift), view.translation), 1 / scale);
  const eye = rotateBack(rows, mul(sub(view.eye, shift), 1 / scale));
  return { ...view, rows: view.rows.map((row) => rotateBack(rows, row)), translation, eye };
}

// Moves positions (3 N) of a part to the page's units.
export function movePositions(positions, { rows, scale, shift }) {
  const moved = new Float32Array(positions.length);
  for (let p = 0; p < positions.length; p += 3) {
    moved.set(add(mul(rotateBy(rows, [positions[p], positions[p + 1], positions[p + 2]]), scale), shift), p);
  }
  return moved;
}
