// Where a part of a merged scene lies: p' = scale rows p + shift, from the part's local units to the page's.

import { dot, mul, sub } from "../hyrf/vectors.js";
import { rowsOf } from "../hyrf/rotation.js";

const column = (rows, k) => rows.map((row) => row[k]);
const product = (a, b) => a.map((row) => [0, 1, 2].map((k) => dot(row, column(b, k))));
const transposed = (rows) => [0, 1, 2].map((k) => column(rows, k));

// Returns the place of a part with the frame `own` in the local units of the scene's frame.
export function placeOf(own, scene) {
  if (own === scene) return { rows: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], scale: 1, shift: [0, 0, 0] };
  const [axes, back] = [rowsOf(own.rotation ?? [1, 0, 0, 0]), transposed(rowsOf(scene.rotation ?? [1, 0, 0, 0]))];
  const away = mul(sub(own.center, scene.center), 1 / scene.scale);
  return { rows: product(back, axes), scale: own.scale / scene.scale, shift: back.map((row) => dot(row, away)) };
}

// Returns a view of the page in the axes and units of a part.
export function viewFromPlace(view, { rows, scale, shift }) {
  const away = mul(sub(view.eye, shift), 1 / scale);
  return {
    ...view,
    rows: product(view.rows, rows),
    translation: view.rows.map((row, k) => (dot(row, shift) + view.translation[k]) / scale),
    eye: transposed(rows).map((row) => dot(row, away)),
  };
}

// Moves positions (3 N) of a part to the page's units.
export function movePositions(positions, { rows, scale, shift }) {
  const moved = new Float32Array(positions.length);
  for (let p = 0; p < positions.length; p += 3) {
    const point = [positions[p], positions[p + 1], positions[p + 2]];
    for (let axis = 0; axis < 3; axis++) moved[p + axis] = scale * dot(rows[axis], point) + shift[axis];
  }
  return moved;
}
