// Where a model is looked at from, by what its file says of its photos. The file's provenance is anyone's word: what of
// it makes no sense is as good as absent.

const SHOWN_CAMERAS = 12; // cameras at most that a viewer steps through
const FITTED_CAMERAS = 48; // cameras at most that colours are fitted at
const ORBIT_CAMERAS = 48; // cameras around a model whose file keeps none, of which every other one is shown
const RING_CAMERAS = 24, RING_LIFTS = [-0.2, 0, 0.2]; // or in rings about it, raised by so much of their distance
const MAX_SIDE = 16384; // pixels of a picture
const FARTHEST = 1e37; // so that cameras about a place are finite in float32
const RIGID_TOLERANCE = 1e-3;
const SAME_WAY = 0.9; // length of the mean viewing direction from which cameras count as looking the same way
const TURNED = 0.5; // length of the mean downward direction up to which pictures count as turned against each other

/**
 * A pinhole camera as files have it: OpenCV axes, pixels, world units.
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number,
 *   camera_from_world: number[][]}} Camera
 *
 * What is looked at, from where, which way is up, and the degrees about `up`, from the camera on, that photos cover.
 * @typedef {{target: number[], up: number[], camera: Camera, arc: number[]}} Viewpoint
 */

/**
 * From where to show a model.
 * @param {import("./metadata.js").Metadata} metadata of a model that was read
 * @returns {{cameras: Camera[], fitted: Camera[], up: number[], target: number[], madeUp: boolean}} `cameras`, at least
 *   one, to step through and to start from the first; `fitted`, that colours shall be fitted at; `up` in the world,
 *   unit length; `target`, what is looked at, world units; `madeUp`: the file keeps no cameras that can be used
 */
export function viewpointOf(metadata) {
  const provenance = metadata.provenance ?? {}, { center, scale } = metadata.config.frame;
  const viewpoint = storedViewpoint(provenance.viewpoint) ?? checkedViewpoint(frameViewpoint(center, scale)) ??
    frameViewpoint([0, 0, 0], 1);
  const up = unit3(viewpoint.up), { target } = viewpoint;
  const [exact, coarse] = [provenance.cameras, provenance.coarse_cameras].map(storedCameras);
  const kept = exact.length ? exact : coarse;
  if (!kept.length) {
    const others = orbitCameras(viewpoint, ORBIT_CAMERAS).filter((_, number) => number % 2 === 1);
    const cameras = evenlySpaced(others, SHOWN_CAMERAS);
    return { cameras, fitted: ringCameras(viewpoint, up), up, target, madeUp: true };
  }
  // A few coarse cameras are too few to fit colours to: rings about the scene say what lies between them.
  const fitted = [...evenlySpaced(kept, FITTED_CAMERAS), ...(exact.length ? [] : ringCameras(viewpoint, up))];
  return { cameras: evenlySpaced(kept, SHOWN_CAMERAS), fitted, up: upOfCameras(kept, up), target, madeUp: false };
}

/**
 * At most `count` of the items, spread over all of them, the first and the last among them.
 * @template Item
 * @param {Item[]} items
 * @param {number} count
 * @returns {Item[]}
 */
export function evenlySpaced(items, count) {
  const number = Math.min(items.length, count), last = items.length - 1;
  const step = number > 1 ? last / (number - 1) : 0;
  return Array.from({ length: number }, (_, k) => items[k > 0 && k === number - 1 ? last : toEven(k * step)]);
}

/**
 * To the nearest integer, halves to the even one.
 * @param {number} value
 */
const toEven = (value) => (value % 1 === 0.5 ? 2 * Math.round(value / 2) : Math.round(value));

/**
 * Where a camera stands, world units.
 * @param {Camera} camera
 * @returns {number[]}
 */
export function cameraPlace({ camera_from_world: pose }) {
  return [0, 1, 2].map((k) => -(pose[0][k] * pose[0][3] + pose[1][k] * pose[1][3] + pose[2][k] * pose[2][3]));
}

// --- what the file says ----------------------------------------------------------------------------------------------

/**
 * The cameras of a provenance, or none where one of them makes no sense.
 * @param {any} stored
 * @returns {Camera[]}
 */
function storedCameras(stored) {
  if (!Array.isArray(stored)) return [];
  const cameras = stored.map(cameraOfNumbers).filter((camera) => camera !== null);
  return cameras.length === stored.length ? cameras : [];
}

/**
 * @param {any} numbers
 * @returns {Camera | null}
 */
function cameraOfNumbers(numbers) {
  if (!Array.isArray(numbers) || numbers.length !== 18) return null;
  const [width, height, fx, fy, cx, cy, ...pose] = numbers;
  const rows = [0, 4, 8].map((start) => pose.slice(start, start + 4));
  return checkedCamera({ width, height, fx, fy, cx, cy, camera_from_world: rows });
}

/**
 * @param {any} stored
 * @returns {Viewpoint | null}
 */
function storedViewpoint(stored) {
  if (!stored?.intrinsics || !stored.arc) return null;
  const { center: target, up, intrinsics, arc, width, height, camera_from_world: pose } = stored;
  if (!isNumbers(intrinsics, 4)) return null;
  const [fx, fy, cx, cy] = intrinsics;
  return checkedViewpoint({ target, up, camera: { width, height, fx, fy, cx, cy, camera_from_world: pose }, arc });
}

/**
 * @param {Record<keyof Viewpoint, any>} viewpoint
 * @returns {Viewpoint | null}
 */
function checkedViewpoint({ target, up, camera: stored, arc }) {
  const camera = checkedCamera(stored);
  if (!camera || !isNumbers(target, 3) || !isNumbers(up, 3) || !isNumbers(arc, 2)) return null;
  const others = [...target, ...cameraPlace(camera), camera.cx, camera.cy, ...arc];
  const length = Math.hypot(...up);
  if (!others.every((value) => Math.abs(value) < FARTHEST) || !(length > 0 && length < Infinity)) return null;
  return { target, up, camera, arc };
}

/**
 * A camera whose picture has a size and whose pose is rigid and finite in float32, with all four rows; or null.
 * @param {Record<keyof Camera, any>} camera
 * @returns {Camera | null}
 */
function checkedCamera({ width, height, fx, fy, cx, cy, camera_from_world: rows }) {
  const sides = [width, height].every((side) => Number.isInteger(side) && side >= 1 && side <= MAX_SIDE);
  if (!sides || ![fx, fy, cx, cy].every(Number.isFinite) || !(fx > 0 && fy > 0)) return null;
  if (!Array.isArray(rows) || ![3, 4].includes(rows.length) || !rows.every((row) => isNumbers(row, 4))) return null;
  const pose = [...rows.slice(0, 3), rows[3] ?? [0, 0, 0, 1]].map((row) => [...row]);
  if (!pose.flat().every((value) => Number.isFinite(Math.fround(value)))) return null;
  const [right, down, forward, last] = pose;
  /** @type {(value: number, wanted: number) => boolean} */
  const near = (value, wanted) => Math.abs(value - wanted) <= RIGID_TOLERANCE;
  const axes = [right, down, forward];
  const rigid = axes.every((a, i) => axes.every((b, j) => near(dot3(a, b), i === j ? 1 : 0)));
  if (!rigid || !last.every((value, k) => near(value, k === 3 ? 1 : 0))) return null;
  if (dot3(cross3(right, down), forward) < 0) return null; // it mirrors the world
  return { width, height, fx, fy, cx, cy, camera_from_world: pose };
}

/**
 * @param {any} values
 * @param {number} count
 */
const isNumbers = (values, count) =>
  Array.isArray(values) && values.length === count && values.every((value) => Number.isFinite(value));

// --- what is made up -------------------------------------------------------------------------------------------------

/**
 * Of a model that says nothing: slightly from above, from 2.5 times the frame's longest half-axis away.
 * @param {number[]} center
 * @param {number} scale
 * @returns {Viewpoint}
 */
function frameViewpoint(center, scale) {
  const slope = (20 * Math.PI) / 180, up = [0, -1, 0], focal = 400 / Math.tan((25 * Math.PI) / 180);
  const place = plus3(center, times3([0, -Math.sin(slope), -Math.cos(slope)], 2.5 * scale));
  const pose = poseTowards(place, center, up);
  const camera = { width: 800, height: 600, fx: focal, fy: focal, cx: 400, cy: 300, camera_from_world: pose };
  return { target: [...center], up, camera, arc: [0, 360] };
}

/**
 * Cameras on a circle about what is looked at, or to and fro over the arc that photos covered.
 * @param {Viewpoint} viewpoint
 * @param {number} count
 * @returns {Camera[]}
 */
function orbitCameras({ target, up: stored, camera, arc: [first, last] }, count) {
  const up = unit3(stored);
  let offset = minus3(cameraPlace(camera), target);
  const level = minus3(offset, times3(up, dot3(offset, up)));
  if (!(Math.hypot(...level) > 1e-9 * Math.hypot(...offset))) { // straight above: the circle would be a point
    offset = plus3(offset, times3(acrossAxis(up), 0.5 * Math.max(Math.hypot(...offset), 1e-6)));
  }
  return Array.from({ length: count }, (_, k) => {
    const part = k / count;
    const swing = (first + last) / 2 + ((last - first) / 2) * Math.sin(2 * Math.PI * part);
    const angle = last - first >= 360 ? first + (last - first) * part : swing;
    const place = plus3(target, turnedAbout(offset, up, (angle * Math.PI) / 180));
    return { ...camera, camera_from_world: poseTowards(place, target, up) };
  });
}

/**
 * Where a scene may have been photographed from: rings about it, at several heights.
 * @param {Viewpoint} viewpoint
 * @param {number[]} up
 * @returns {Camera[]}
 */
function ringCameras(viewpoint, up) {
  const { target } = viewpoint;
  return orbitCameras(viewpoint, RING_CAMERAS).flatMap((camera) => {
    const place = cameraPlace(camera), away = Math.hypot(...minus3(place, target));
    return RING_LIFTS.map((lift) => {
      const pose = poseTowards(plus3(place, times3(up, lift * away)), target, up);
      return { ...camera, camera_from_world: pose };
    });
  });
}

/**
 * Which way is up: for cameras that look down on a flat scene and turn, as drones do, against them.
 * @param {Camera[]} cameras
 * @param {number[]} up
 * @returns {number[]}
 */
function upOfCameras(cameras, up) {
  const mean = (/** @type {number} */ row) => {
    const sum = cameras.reduce((total, { camera_from_world: pose }) => plus3(total, pose[row]), [0, 0, 0]);
    return times3(sum, 1 / cameras.length);
  };
  const forward = mean(2), agreement = Math.hypot(...forward);
  return agreement < SAME_WAY || Math.hypot(...mean(1)) >= TURNED ? up : times3(forward, -1 / agreement);
}

/**
 * camera_from_world of a camera at `place` that looks at `target` with `up` (unit) upwards.
 * @param {number[]} place
 * @param {number[]} target
 * @param {number[]} up
 * @returns {number[][]}
 */
function poseTowards(place, target, up) {
  const ahead = minus3(target, place), forward = Math.hypot(...ahead) > 1e-12 ? unit3(ahead) : [0, 0, 1];
  const level = cross3(forward, up), right = Math.hypot(...level) > 1e-9 ? unit3(level) : acrossAxis(forward);
  const rows = [right, cross3(forward, right), forward];
  return [...rows.map((row) => [...row, -dot3(row, place)]), [0, 0, 0, 1]];
}

/**
 * A unit vector at right angles to a unit vector.
 * @param {number[]} axis
 */
function acrossAxis(axis) {
  const sizes = axis.map(Math.abs), least = sizes.indexOf(Math.min(...sizes));
  return unit3(cross3(axis, [0, 1, 2].map((k) => (k === least ? 1 : 0))));
}

/**
 * A vector turned about a unit axis (Rodrigues), angle in radians.
 * @param {number[]} vector
 * @param {number[]} axis
 * @param {number} angle
 */
function turnedAbout(vector, axis, angle) {
  const cosine = Math.cos(angle), along = times3(axis, dot3(axis, vector) * (1 - cosine));
  return plus3(plus3(times3(vector, cosine), times3(cross3(axis, vector), Math.sin(angle))), along);
}

/** @typedef {(a: number[], b: number[]) => number[]} VectorSum */

/** @type {VectorSum} */
const plus3 = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** @type {VectorSum} */
const minus3 = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** @type {VectorSum} */
const cross3 = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** @type {(a: number[], b: number[]) => number} */
const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @type {(a: number[], s: number) => number[]} */
const times3 = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
/** @type {(a: number[]) => number[]} */
const unit3 = (a) => {
  const length = Math.hypot(...a);
  return a.map((value) => value / length);
};
