// Cameras. The page's axes are the world's, its origin and unit are `scene.center` and `scene.unit` of it; a view is a
// pinhole camera in them: rows (right, down, forward), translation, eye, fx, fy, cx, cy.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const mul = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => mul(a, 1 / (Math.hypot(...a) || 1));

// A vector turned about a unit axis (Rodrigues).
function rotate(vector, axis, angle) {
  const c = Math.cos(angle);
  return add(add(mul(vector, c), mul(cross(axis, vector), Math.sin(angle))), mul(axis, dot(axis, vector) * (1 - c)));
}

const RIGID = 1e-3; // that rows of a pose may be off being at right angles and of length 1

const isRow = (row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite);

function isRigid(rows) {
  const near = (a, b, wanted) => Math.abs(dot(a, b) - wanted) <= RIGID;
  const right = rows.every((a, i) => rows.every((b, j) => near(a, b, i === j ? 1 : 0)));
  return right && dot(cross(rows[0], rows[1]), rows[2]) > 0;
}

// The view of a camera of the world: {width, height, fx, fy, cx, cy, camera_from_world: 4 x 4 rows}; the last row may
// be left out. Throws an Error with a sentence where that is none.
export function viewOf({ width, height, fx, fy, cx, cy, camera_from_world: pose }, scene) {
  const posed = Array.isArray(pose) && [3, 4].includes(pose.length) && pose.every(isRow);
  if (!posed || ![width, height, fx, fy, cx, cy].every(Number.isFinite)) {
    throw new Error("it needs width, height, fx, fy, cx, cy and camera_from_world (4 x 4), all of them numbers");
  }
  if (![width, height].every((side) => Number.isInteger(side) && side > 0)) {
    throw new Error("width and height must be whole numbers above 0");
  }
  if (!(fx > 0 && fy > 0)) throw new Error("fx and fy must be above 0");
  const rows = pose.slice(0, 3).map((row) => row.slice(0, 3));
  if (!isRigid(rows)) throw new Error("the first three columns of camera_from_world must be a rotation");
  const translation = pose.slice(0, 3).map((row) => (dot(row, scene.center) + row[3]) / scene.unit);
  const eye = [0, 1, 2].map((k) => -rows.reduce((sum, row, r) => sum + row[k] * translation[r], 0));
  return { rows, translation, eye, width, height, fx, fy, cx, cy };
}

// The camera of the world of a view: the inverse of `viewOf`.
export function cameraOf({ rows, translation, width, height, fx, fy, cx, cy }, scene) {
  const world = rows.map((row, r) => [...row, translation[r] * scene.unit - dot(row, scene.center)]);
  return { width, height, fx, fy, cx, cy, camera_from_world: [...world, [0, 0, 0, 1]] };
}

// What one looks through: a view that can be moved.
export class Eye {
  // `views` tell how large the scene is.
  constructor(scene, views) {
    this.up = scene.up;
    this.middle = mul(sub(scene.target, scene.center), 1 / scene.unit);
    const distances = views.map((view) => Math.hypot(...sub(view.eye, this.middle))).sort((a, b) => a - b);
    this.size = distances[distances.length >> 1];
  }

  // Stand where a view is taken from. Orbits go about the point on its axis that is nearest to the scene's middle.
  stand(view) {
    this.position = view.eye;
    this.rows = view.rows;
    this.focal = view.fy / Math.sqrt(view.width * view.height);
    const ahead = dot(sub(this.middle, this.position), this.rows[2]);
    this.pace = Math.max(ahead, 0.3 * this.size) || 1; // cameras among the scene look past its middle
    this.target = add(this.position, mul(this.rows[2], this.pace));
  }

  // Where it is, to be taken up again by `Object.assign`.
  get pose() {
    const { position, rows, focal, pace, target } = this;
    return { position, rows, focal, pace, target };
  }

  // The view in a picture of some size. A photo's picture and a window of another shape show equally large areas.
  view(width, height) {
    const focal = this.focal * Math.sqrt(width * height);
    return {
      rows: this.rows, eye: this.position, translation: this.rows.map((row) => -dot(row, this.position)),
      width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2,
    };
  }

  // How deep the target lies before the eye.
  get depth() {
    return Math.max(dot(sub(this.target, this.position), this.rows[2]), 1e-3 * this.pace);
  }

  // The point at this depth behind a place of the picture, x and y from its middle in units of the focal length.
  point(x, y, depth = this.depth) {
    return add(this.position, mul(add(add(mul(this.rows[0], x), mul(this.rows[1], y)), this.rows[2]), depth));
  }

  // Turn everything about a point, or only the eye: yaw about up, then pitch, short of straight up and down.
  turn(yaw, pitch, about) {
    const level = sub(this.rows[0], mul(this.up, dot(this.rows[0], this.up)));
    const across = Math.hypot(...level) > 0.3 ? unit(level) : unit(cross(this.rows[2], this.up));
    const elevation = Math.asin(Math.max(-1, Math.min(1, dot(this.rows[2], this.up))));
    const most = 1.55;
    if (dot(this.rows[1], this.up) > 0) yaw = -yaw; // upside down: what is seen still follows the pointer
    pitch = Math.max(Math.min(-most, elevation), Math.min(Math.max(most, elevation), elevation + pitch)) - elevation;
    const turn = (vector) => rotate(rotate(vector, across, pitch), this.up, yaw);
    this.rows = this.rows.map(turn);
    this.position = add(about, turn(sub(this.position, about)));
    this.target = add(about, turn(sub(this.target, about)));
  }

  orbit(yaw, pitch) {
    this.turn(yaw, pitch, this.target);
  }

  look(yaw, pitch) {
    this.turn(yaw, pitch, this.position);
  }

  // Shift by so much along right, down and forward.
  move(right, down, forward) {
    const step = [right, down, forward].reduce((sum, length, r) => add(sum, mul(this.rows[r], length)), [0, 0, 0]);
    this.position = add(this.position, step);
    this.target = add(this.target, step);
  }

  // Shift so that what is at the target's depth follows the pointer; in units of the focal length.
  pan(x, y) {
    this.move(-x * this.depth, -y * this.depth, 0);
  }

  // Come nearer (factor < 1) to the point at the target's depth behind a place of the picture, which stays in place.
  zoom(factor, x, y) {
    const least = (1e-3 * this.pace) / this.depth;
    const point = this.point(x, y);
    factor = Math.max(factor, least);
    this.position = add(point, mul(sub(this.position, point), factor));
    this.target = add(point, mul(sub(this.target, point), factor));
  }
}
