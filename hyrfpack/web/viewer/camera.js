// Defines cameras. The page has the origin `scene.center`, the unit `scene.unit` (both in world units) and the world's
// axes, rotated by the quaternion `scene.rotation` if there is one. A view is a pinhole camera in these coordinates:
// rows (right, down, forward), translation, eye, and fx, fy, cx, cy in pixels.

import { frameAxes, rotateBack, rotateBy } from "../hyrf/rotation.js";
import { add, cross, dot, mul, rotate, sub, unit } from "../hyrf/vectors.js";

const POSE_TOLERANCE = 1e-3; // the maximum error of the dot products of a pose's rows
const MAX_ELEVATION_RADIANS = 1.55;

// Returns whether a value is a row of a pose: four finite numbers.
const isPoseRow = (row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite);

// Returns whether three rows are a rotation matrix.
function isRigid(rows) {
  const hasProduct = (a, b, expected) => Math.abs(dot(a, b) - expected) <= POSE_TOLERANCE;
  const isOrthonormal = rows.every((a, i) => rows.every((b, j) => hasProduct(a, b, i === j ? 1 : 0)));
  return isOrthonormal && dot(cross(rows[0], rows[1]), rows[2]) > 0;
}

// Converts a point in world units to the page's coordinates.
export const toPage = (point, scene) => mul(rotateBack(frameAxes(scene), sub(point, scene.center)), 1 / scene.unit);

// Converts a point in the page's coordinates to world units.
export const toWorld = (point, scene) => add(scene.center, mul(rotateBy(frameAxes(scene), point), scene.unit));

// Converts a camera in world units, {width, height, fx, fy, cx, cy, camera_from_world: 4 x 4 rows}, to a view. The last
// row may be absent. Throws an Error that says what is wrong with an invalid camera.
export function viewOf({ width, height, fx, fy, cx, cy, camera_from_world: pose }, scene) {
  const hasPose = Array.isArray(pose) && [3, 4].includes(pose.length) && pose.every(isPoseRow);
  if (!hasPose || ![width, height, fx, fy, cx, cy].every(Number.isFinite)) {
    throw new Error("it needs width, height, fx, fy, cx, cy and camera_from_world (4 x 4), all of them numbers");
  }
  if (![width, height].every((side) => Number.isInteger(side) && side > 0)) {
    throw new Error("width and height must be whole numbers above 0");
  }
  if (!(fx > 0 && fy > 0)) throw new Error("fx and fy must be above 0");
  const worldRows = pose.slice(0, 3).map((row) => row.slice(0, 3)), axes = frameAxes(scene);
  if (!isRigid(worldRows)) throw new Error("the first three columns of camera_from_world must be a rotation");
  const translation = worldRows.map((row, k) => (dot(row, scene.center) + pose[k][3]) / scene.unit);
  const rows = worldRows.map((row) => rotateBack(axes, row));
  return { rows, translation, eye: eyeOf(rows, translation), width, height, fx, fy, cx, cy };
}

// Returns the point that a pose maps to the origin. The rows are inverted, not transposed, because those of rounded
// poses are not quite orthonormal: `Eye.view` must return the same translation again.
function eyeOf([right, down, forward], translation) {
  const columns = [cross(down, forward), cross(forward, right), cross(right, down)];
  return mul(rotateBack(columns, translation), -1 / dot(right, columns[0]));
}

// Converts a view to a camera in world units: the inverse of `viewOf`.
export function cameraOf({ rows, translation, width, height, fx, fy, cx, cy }, scene) {
  const worldRows = rows.map((row) => rotateBy(frameAxes(scene), row));
  const pose = worldRows.map((row, r) => [...row, translation[r] * scene.unit - dot(row, scene.center)]);
  return { width, height, fx, fy, cx, cy, camera_from_world: [...pose, [0, 0, 0, 1]] };
}

// The movable camera from which the window's picture is drawn.
export class Eye {
  // The size of the scene is the median distance of `views` from its target.
  constructor(scene, views) {
    this.up = rotateBack(frameAxes(scene), scene.up);
    this.center = toPage(scene.target, scene);
    const distances = views.map((view) => Math.hypot(...sub(view.eye, this.center))).sort((a, b) => a - b);
    this.size = distances[distances.length >> 1];
  }

  // Moves the eye to a view. It then orbits about the point on the view's axis that is nearest to the scene's target.
  setView(view) {
    this.position = view.eye;
    this.rows = view.rows;
    this.focal = view.fy / Math.sqrt(view.width * view.height);
    const ahead = dot(sub(this.center, this.position), this.rows[2]);
    this.pace = Math.max(ahead, 0.3 * this.size) || 1; // for cameras inside the scene, the depth is small or negative
    this.target = add(this.position, mul(this.rows[2], this.pace));
  }

  // Returns the state of the eye, which `Object.assign` restores.
  get pose() {
    const { position, rows, focal, pace, target } = this;
    return { position, rows, focal, pace, target };
  }

  // Returns the view for a picture of this size in pixels. The focal length is scaled so that pictures of different
  // shapes show equal areas.
  view(width, height) {
    const focal = this.focal * Math.sqrt(width * height);
    return {
      rows: this.rows, eye: this.position, translation: this.rows.map((row) => -dot(row, this.position)),
      width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2,
    };
  }

  // Returns the depth of the target.
  get depth() {
    return Math.max(dot(sub(this.target, this.position), this.rows[2]), 1e-3 * this.pace);
  }

  // Returns the point at a depth along the ray through x and y, which are measured from the picture's centre in units
  // of the focal length.
  point(x, y, depth = this.depth) {
    return add(this.position, mul(add(add(mul(this.rows[0], x), mul(this.rows[1], y)), this.rows[2]), depth));
  }

  // Rotates the eye about a point, by a yaw about the up axis and then a pitch, in radians. The view direction never
  // reaches straight up or straight down.
  turn(yaw, pitch, about) {
    const level = sub(this.rows[0], mul(this.up, dot(this.rows[0], this.up)));
    const across = Math.hypot(...level) > 0.3 ? unit(level) : unit(cross(this.rows[2], this.up));
    const elevation = Math.asin(Math.max(-1, Math.min(1, dot(this.rows[2], this.up))));
    if (dot(this.rows[1], this.up) > 0) yaw = -yaw; // so that the scene follows the pointer when it is upside down
    const lowest = Math.min(-MAX_ELEVATION_RADIANS, elevation), highest = Math.max(MAX_ELEVATION_RADIANS, elevation);
    pitch = Math.max(lowest, Math.min(highest, elevation + pitch)) - elevation;
    const turn = (vector) => rotate(rotate(vector, across, pitch), this.up, yaw);
    this.rows = this.rows.map(turn);
    this.position = add(about, turn(sub(this.position, about)));
    this.target = add(about, turn(sub(this.target, about)));
  }

  // Turns the eye to a point, which becomes its target, and multiplies their distance by a factor. The eye keeps its
  // roll about the view's axis.
  approach(point, factor) {
    const ahead = unit(sub(point, this.position)), level = (vector) => sub(vector, mul(this.up, dot(vector, this.up)));
    const turnTo = (from, to, axis) => {
      const angle = Math.atan2(dot(axis, cross(from, to)), dot(from, to));
      this.rows = this.rows.map((row) => rotate(row, axis, angle));
    };
    turnTo(level(this.rows[2]), level(ahead), this.up);
    turnTo(this.rows[2], ahead, unit(cross(this.rows[2], ahead)));
    this.position = add(point, mul(sub(this.position, point), factor));
    this.target = point;
  }

  // Rotates the eye about its target.
  orbit(yaw, pitch) {
    this.turn(yaw, pitch, this.target);
  }

  // Rotates the eye in its place.
  look(yaw, pitch) {
    this.turn(yaw, pitch, this.position);
  }

  // Moves the eye and its target along its right, down and forward axes.
  move(right, down, forward) {
    const step = [right, down, forward].reduce((sum, length, r) => add(sum, mul(this.rows[r], length)), [0, 0, 0]);
    this.position = add(this.position, step);
    this.target = add(this.target, step);
  }

  // Moves the eye so that the picture of points at the target's depth moves by x and y, in units of the focal length.
  pan(x, y) {
    this.move(-x * this.depth, -y * this.depth, 0);
  }

  // Multiplies the distance to a point at the target's depth by a factor; factors below 1 move the eye nearer. The
  // point keeps its place in the picture, which x and y give as for `point`.
  zoom(factor, x, y) {
    const minFactor = (1e-3 * this.pace) / this.depth;
    const point = this.point(x, y);
    factor = Math.max(factor, minFactor);
    this.position = add(point, mul(sub(this.position, point), factor));
    this.target = add(point, mul(sub(this.target, point), factor));
  }
}
