// Moves the metadata of a file: its frame, cameras, viewpoint and stored placement, as hyrfpack/edit/transform.py.

import { frameAxes, IDENTITY_QUAT, quatOf, rotateBy, transpose } from "../../hyrf/rotation.js";
import { dot, mul } from "../../hyrf/vectors.js";
import { defaultViewpoint } from "../../hyrf/viewpoint.js";

const MIN_TURN_RADIANS = 1e-12; // a frame that is turned by less is not turned
const CAMERA_KEYS = ["cameras", "coarse_cameras"];
const INTRINSIC_COUNT = 6; // a stored camera has these numbers before its pose

// Returns metadata after a placement, p' = factor rows p. `statesUp` is whether the placement's up replaces that of the
// file.
export function moveMetadata(metadata, placement, statesUp) {
  const { config, provenance } = metadata, moved = { ...provenance };
  for (const key of CAMERA_KEYS) {
    if (moved[key]) moved[key] = moved[key].map((numbers) => moveCamera(numbers, placement).map(roundNumber));
  }
  if (statesUp) moved.viewpoint ??= storedForm(defaultViewpoint(config.frame));
  if (moved.viewpoint) moved.viewpoint = moveViewpoint(moved.viewpoint, placement, statesUp);
  if (isMove(placement)) moved.placement = followPlacement(moved.placement, placement);
  return { ...metadata, config: { ...config, frame: moveFrame(config.frame, placement) }, provenance: moved };
}

// Returns whether a placement moves anything.
const isMove = ({ factor, rows }) => factor !== 1 || rows.join() !== "1,0,0,0,1,0,0,0,1";

// Returns the stored placement after a further move.
function followPlacement(stored = { factor: 1, rotation: IDENTITY_QUAT, offset: [0, 0, 0] }, { factor, rows }) {
  return {
    factor: roundNumber(factor * stored.factor), rotation: turnBy(rows, stored).map(roundNumber),
    offset: mul(rotateBy(rows, stored.offset), factor).map(roundNumber),
  };
}

// Returns the quaternion of a rotation followed by that of `rows`.
const turnBy = (rows, { rotation }) =>
  quatOf(transpose(transpose(frameAxes({ rotation })).map((axis) => rotateBy(rows, axis))));

// Returns the frame of a moved model; like that of a file, it has a rotation only if it is turned.
function moveFrame(frame, { factor, rows }) {
  const { rotation, ...rest } = frame, quat = turnBy(rows, frame);
  const isTurned = 2 * Math.hypot(...quat.slice(1)) >= MIN_TURN_RADIANS;
  const moved = { ...rest, center: mul(rotateBy(rows, frame.center), factor), scale: factor * frame.scale };
  return isTurned ? { ...moved, rotation: quat } : moved;
}

// Moves 18 numbers: those of the lens, and the rows of the pose.
function moveCamera(numbers, placement) {
  const pose = [0, 1, 2].map((r) => numbers.slice(INTRINSIC_COUNT + 4 * r, INTRINSIC_COUNT + 4 * r + 4));
  return [...numbers.slice(0, INTRINSIC_COUNT), ...pose.flatMap((row) => moveRow(row, placement))];
}

const moveRow = (row, { factor, rows }) => [...rows.map((axis) => dot(axis, row)), factor * row[3]];

// Returns a viewpoint in the form that files store.
const storedForm = ({ target, up, arc, camera: { fx, fy, cx, cy, ...camera } }) =>
  ({ ...camera, center: target, up, arc, intrinsics: [fx, fy, cx, cy] });

function moveViewpoint(viewpoint, placement, statesUp) {
  const { factor, rows, up } = placement, [a, b, c] = viewpoint.camera_from_world;
  return {
    ...viewpoint, center: mul(rotateBy(rows, viewpoint.center), factor),
    up: statesUp ? up : rotateBy(rows, viewpoint.up),
    camera_from_world: [...[a, b, c].map((row) => moveRow(row, placement)), [0, 0, 0, 1]],
  };
}

// Rounds as round_number in hyrfpack/cameras/files.py.
const roundNumber = (value) => Number(Math.abs(value) < 1000 ? value.toPrecision(9) : value.toFixed(6)) + 0;
