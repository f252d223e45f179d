// Chooses the cameras from which a model is shown, from the provenance of its file. The provenance is not trusted:
// invalid entries are ignored.

import { frameAxes, rotateBack, rotateBy } from "./rotation.js";
import { add, cross, dot, mul, rotate, sub, unit } from "./vectors.js";

const MAX_SHOWN_CAMERAS = 12;
const MAX_FITTED_CAMERAS = 48;
const ORBIT_CAMERA_COUNT = 48; // every other one of them is shown
const CAMERAS_PER_RING = 24;
const RING_HEIGHT_RATIOS = [-0.2, 0, 0.2]; // in units of the distance from the target
const MAX_PICTURE_SIDE_PIXELS = 16384;
const MAX_ABS_COORDINATE = 1e37; // cameras around such a point are still finite in float32
const RIGID_TOLERANCE = 1e-3;
// Cameras have similar viewing directions if the mean of these unit vectors is at least MIN_MEAN_FORWARD_LENGTH long.
// Their pictures are rotated against each other if the mean of their down axes is shorter than MAX_MEAN_DOWN_LENGTH.
const MIN_MEAN_FORWARD_LENGTH = 0.9;
const MAX_MEAN_DOWN_LENGTH = 0.5;
const MIN_STATED_UP_AGREEMENT = Math.cos(Math.PI / 4); // a stored direction that agrees so far with theirs is kept

/**
 * A pinhole camera as files store it: OpenCV axes, pixels, world units.
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number,
 *   camera_from_world: number[][]}} Camera
 *
 * A view of a model: the point that it looks at, the up direction, a camera, and the range of angles about `up`, in
 * degrees from that camera, that the photos cover.
 * @typedef {{target: number[], up: number[], camera: Camera, arc: number[]}} Viewpoint
 */

/**
 * Chooses the cameras for showing a model.
 * @param {import("./metadata.js").Metadata} metadata the checked metadata of the model
 * @returns {{cameras: Camera[], fitted: Camera[], up: number[], target: number[], madeUp: boolean}} `cameras`, at least
 *   one, are those of a viewer, which starts at the first; `fitted` are those at which colours are fitted; `up` is a
 *   unit vector in world axes; `target` is the point that the viewer looks at, in world units; `madeUp` is true if the
 *   file has no usable cameras
 */
export function viewpointOf(metadata) {
  const provenance = metadata.provenance ?? {}, { frame } = metadata.config;
  const viewpoint = parseStoredViewpoint(provenance.viewpoint) ?? validateViewpoint(defaultViewpoint(frame)) ??
    defaultViewpoint({ center: [0, 0, 0], scale: 1 });
  const up = unit(viewpoint.up), { target } = viewpoint;
  const { cameras: stored, isCoarse } = storedCameras(metadata);
  if (!stored.length) {
    const others = orbitCameras(viewpoint, ORBIT_CAMERA_COUNT).filter((_, number) => number % 2 === 1);
    const cameras = evenlySpaced(others, MAX_SHOWN_CAMERAS);
    return { cameras, fitted: ringCameras(viewpoint, up), up, target, madeUp: true };
  }
  // Few coarse cameras are stored, too few for fitting colours, so rings of cameras about the scene are added.
  const fitted = [...evenlySpaced(stored, MAX_FITTED_CAMERAS), ...(isCoarse ? ringCameras(viewpoint, up) : [])];
  const shown = evenlySpaced(stored, MAX_SHOWN_CAMERAS);
  return { cameras: shown, fitted, up: estimateUp(stored, up), target, madeUp: false };
}

/**
 * Selects at most `count` evenly spaced items, which include the first and the last one.
 * @template Item
 * @param {Item[]} items
 * @param {number} count
 * @returns {Item[]}
 */
export function evenlySpaced(items, count) {
  const number = Math.min(items.length, count), last = items.length - 1;
  const step = number > 1 ? last / (number - 1) : 0;
  return Array.from({ length: number }, (_, k) => items[k > 0 && k === number - 1 ? last : roundHalfToEven(k * step)]);
}

/**
 * Rounds to the nearest integer. Halves are rounded to the nearest even integer.
 * @param {number} value
 */
const roundHalfToEven = (value) => (value % 1 === 0.5 ? 2 * Math.round(value / 2) : Math.round(value));

/**
 * Returns the position of a camera in world units.
 * @param {Camera} camera
 * @returns {number[]}
 */
export const cameraPosition = ({ camera_from_world: pose }) => mul(rotateBack(pose, pose.map((row) => row[3])), -1);

/**
 * Converts a camera to a view in a model's local units, with the position of its eye.
 * @param {Camera} camera
 * @param {import("./metadata.js").Frame} frame
 * @returns {import("./frustum.js").View & {eye: number[]}}
 */
export function toLocalView(camera, frame) {
  const { center, scale } = frame, axes = frameAxes(frame);
  const { camera_from_world: pose, ...lens } = camera, worldRows = pose.slice(0, 3);
  const translation = worldRows.map((row) => (dot(row, center) + row[3]) / scale);
  const eye = rotateBack(axes, cameraPosition(camera).map((value, axis) => (value - center[axis]) / scale));
  return { ...lens, rows: worldRows.map((row) => rotateBack(axes, row)), translation, eye };
}

// --- cameras of the file ---------------------------------------------------------------------------------------------

/**
 * Returns the cameras that a file keeps: the training cameras or, if these are absent or invalid, the few coarse ones.
 * @param {import("./metadata.js").Metadata} metadata the checked metadata of the model
 * @param {number} [limit] only so many cameras at the start of a list count; the others may be invalid
 * @returns {{cameras: Camera[], isCoarse: boolean}} `cameras` is empty if the file keeps none that are valid
 */
export function storedCameras({ provenance }, limit = Infinity) {
  const [exact, coarse] = [provenance?.cameras, provenance?.coarse_cameras].map((list) => parseCameras(list, limit));
  return exact.length ? { cameras: exact, isCoarse: false } : { cameras: coarse, isCoarse: true };
}

/**
 * Parses the cameras of a provenance. Returns an empty list if one of them is invalid.
 * @param {any} stored a parsed JSON value
 * @param {number} limit
 * @returns {Camera[]}
 */
function parseCameras(stored, limit) {
  if (!Array.isArray(stored)) return [];
  const cameras = stored.slice(0, limit).map(parseCameraNumbers);
  return cameras.every((camera) => camera !== null) ? cameras : [];
}

/**
 * Parses a camera that is stored as 18 numbers. Returns null if it is invalid.
 * @param {any} numbers
 * @returns {Camera | null}
 */
function parseCameraNumbers(numbers) {
  if (!Array.isArray(numbers) || numbers.length !== 18) return null;
  const [width, height, fx, fy, cx, cy, ...pose] = numbers;
  const rows = [0, 4, 8].map((start) => pose.slice(start, start + 4));
  return validateCamera({ width, height, fx, fy, cx, cy, camera_from_world: rows });
}

/**
 * Parses the viewpoint of a provenance. Returns null if it is absent or invalid.
 * @param {any} stored
 * @returns {Viewpoint | null}
 */
function parseStoredViewpoint(stored) {
  if (!stored?.intrinsics || !stored.arc) return null;
  const { center: target, up, intrinsics, arc, width, height, camera_from_world: pose } = stored;
  if (!isNumberList(intrinsics, 4)) return null;
  const [fx, fy, cx, cy] = intrinsics;
  return validateViewpoint({ target, up, camera: { width, height, fx, fy, cx, cy, camera_from_world: pose }, arc });
}

/**
 * Returns the viewpoint with a checked camera, or null if it is invalid.
 * @param {Record<keyof Viewpoint, any>} viewpoint
 * @returns {Viewpoint | null}
 */
function validateViewpoint({ target, up, camera: stored, arc }) {
  const camera = validateCamera(stored);
  if (!camera || !isNumberList(target, 3) || !isNumberList(up, 3) || !isNumberList(arc, 2)) return null;
  const others = [...target, ...cameraPosition(camera), camera.cx, camera.cy, ...arc];
  const length = Math.hypot(...up);
  if (!others.every((value) => Math.abs(value) < MAX_ABS_COORDINATE) || !(length > 0 && length < Infinity)) return null;
  return { target, up, camera, arc };
}

/**
 * Returns the camera with all four rows of its pose. Returns null if the size of its picture is invalid, or if its pose
 * is not rigid or not finite in float32.
 * @param {Record<keyof Camera, any>} camera
 * @returns {Camera | null}
 */
function validateCamera({ width, height, fx, fy, cx, cy, camera_from_world: rows }) {
  /** @type {(side: any) => boolean} */
  const isSide = (side) => Number.isInteger(side) && side >= 1 && side <= MAX_PICTURE_SIDE_PIXELS;
  if (![width, height].every(isSide) || ![fx, fy, cx, cy].every(Number.isFinite) || !(fx > 0 && fy > 0)) return null;
  if (!Array.isArray(rows) || ![3, 4].includes(rows.length) || !rows.every((row) => isNumberList(row, 4))) return null;
  const pose = [...rows.slice(0, 3), rows[3] ?? [0, 0, 0, 1]].map((row) => [...row]);
  if (!pose.flat().every((value) => Number.isFinite(Math.fround(value)))) return null;
  const [right, down, forward, last] = pose;
  /** @type {(value: number, expected: number) => boolean} */
  const isNear = (value, expected) => Math.abs(value - expected) <= RIGID_TOLERANCE;
  const axes = [right, down, forward];
  const isRigid = axes.every((a, i) => axes.every((b, j) => isNear(dot(a, b), i === j ? 1 : 0)));
  if (!isRigid || !last.every((value, k) => isNear(value, k === 3 ? 1 : 0))) return null;
  if (dot(cross(right, down), forward) < 0) return null; // it mirrors the world
  return { width, height, fx, fy, cx, cy, camera_from_world: pose };
}

/**
 * Returns whether a value is a list of `count` finite numbers.
 * @param {any} values
 * @param {number} count
 */
const isNumberList = (values, count) =>
  Array.isArray(values) && values.length === count && values.every((value) => Number.isFinite(value));

// --- default cameras -------------------------------------------------------------------------------------------------

/**
 * Returns the viewpoint of a model whose file has none. It looks slightly down from 2.5 times the frame's longest
 * half-axis away; up is the frame's -y axis.
 * @param {{center: number[], scale: number, rotation?: number[]}} frame
 * @returns {Viewpoint}
 */
export function defaultViewpoint({ center, scale, rotation }) {
  const slope = (20 * Math.PI) / 180, focal = 400 / Math.tan((25 * Math.PI) / 180), axes = frameAxes({ rotation });
  const up = rotateBy(axes, [0, -1, 0]);
  const place = add(center, mul(rotateBy(axes, [0, -Math.sin(slope), -Math.cos(slope)]), 2.5 * scale));
  const pose = lookAtPose(place, center, up);
  const camera = { width: 800, height: 600, fx: focal, fy: focal, cx: 400, cy: 300, camera_from_world: pose };
  return { target: [...center], up, camera, arc: [0, 360] };
}

/**
 * Returns cameras on a circle about the target or, if the photos cover only an arc, back and forth on that arc.
 * @param {Viewpoint} viewpoint
 * @param {number} count
 * @returns {Camera[]}
 */
function orbitCameras({ target, up: stored, camera, arc: [first, last] }, count) {
  const up = unit(stored);
  let offset = sub(cameraPosition(camera), target);
  const level = sub(offset, mul(up, dot(offset, up)));
  if (!(Math.hypot(...level) > 1e-9 * Math.hypot(...offset))) { // from straight above, the circle would be a point
    offset = add(offset, mul(perpendicularTo(up), 0.5 * Math.max(Math.hypot(...offset), 1e-6)));
  }
  return Array.from({ length: count }, (_, k) => {
    const turn = k / count;
    const swing = (first + last) / 2 + ((last - first) / 2) * Math.sin(2 * Math.PI * turn);
    const angle = last - first >= 360 ? first + (last - first) * turn : swing;
    const place = add(target, rotate(offset, up, (angle * Math.PI) / 180));
    return { ...camera, camera_from_world: lookAtPose(place, target, up) };
  });
}

/**
 * Returns rings of cameras about the target, at several heights.
 * @param {Viewpoint} viewpoint
 * @param {number[]} up
 * @returns {Camera[]}
 */
function ringCameras(viewpoint, up) {
  const { target } = viewpoint;
  return orbitCameras(viewpoint, CAMERAS_PER_RING).flatMap((camera) => {
    const place = cameraPosition(camera), away = Math.hypot(...sub(place, target));
    return RING_HEIGHT_RATIOS.map((height) => {
      const pose = lookAtPose(add(place, mul(up, height * away)), target, up);
      return { ...camera, camera_from_world: pose };
    });
  });
}

/**
 * Estimates the up direction. If cameras have similar viewing directions but rotated pictures, as those of drones that
 * look down, up is opposite to their viewing direction, unless an edit has stated nearly that direction.
 * @param {Camera[]} cameras
 * @param {number[]} up the direction for all other cameras
 * @returns {number[]} a unit vector
 */
function estimateUp(cameras, up) {
  const mean = (/** @type {number} */ row) => {
    const sum = cameras.reduce((total, { camera_from_world: pose }) => add(total, pose[row]), [0, 0, 0]);
    return mul(sum, 1 / cameras.length);
  };
  const forward = mean(2), agreement = Math.hypot(...forward);
  if (agreement < MIN_MEAN_FORWARD_LENGTH || Math.hypot(...mean(1)) >= MAX_MEAN_DOWN_LENGTH) return up;
  const above = mul(forward, -1 / agreement);
  return dot(up, above) >= MIN_STATED_UP_AGREEMENT ? up : above;
}

/**
 * Returns `camera_from_world` of a camera at `place` that looks at `target`; `up` is a unit vector.
 * @param {number[]} place
 * @param {number[]} target
 * @param {number[]} up
 * @returns {number[][]}
 */
function lookAtPose(place, target, up) {
  const ahead = sub(target, place), forward = Math.hypot(...ahead) > 1e-12 ? unit(ahead) : [0, 0, 1];
  const level = cross(forward, up), right = Math.hypot(...level) > 1e-9 ? unit(level) : perpendicularTo(forward);
  const rows = [right, cross(forward, right), forward];
  return [...rows.map((row) => [...row, -dot(row, place)]), [0, 0, 0, 1]];
}

/**
 * Returns a unit vector perpendicular to a unit vector.
 * @param {number[]} axis
 */
function perpendicularTo(axis) {
  const sizes = axis.map(Math.abs), smallest = sizes.indexOf(Math.min(...sizes));
  return unit(cross(axis, [0, 1, 2].map((k) => (k === smallest ? 1 : 0))));
}
