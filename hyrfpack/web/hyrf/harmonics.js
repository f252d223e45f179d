// A model as plain splats: the colours that its radiance field gives each Gaussian, fitted by spherical harmonics. For
// browsers that cannot evaluate the field while the view moves, and for programs that know splats alone.

import { HyrfFormatError } from "./errors.js";
import { colorsAlong, colorsOfRows, decodeGeometry, firstLayers } from "./fields.js";
import { cameraPlace } from "./viewpoint.js";

/** Harmonics beside the first, by degree. */
export const OTHER_HARMONICS = [0, 3, 8, 15];
/** The first: 1 / (2 sqrt(pi)), the same in all directions. */
export const BAND_0 = 0.28209479177387814;

const SPHERE_DIRECTIONS = 32;
const SPHERE_WEIGHT = 3e-3; // of all these together, against 1 for all cameras
const RIDGE = 1e-5;
const FITTED_ROWS = 256; // Gaussians that are fitted together
const SEEN_FROM = 0.01; // local units: what is nearer to a camera it does not see
const SEEN_BESIDE = 0.3; // nor what lies so much of half the picture's size outside of it
const SAMPLED = 4; // blocks, spread over all, that tell how large harmonics are
const CUT_PART = 1e-4; // part of them that may be larger than what can be stored
const COARSE_SHARE = 0.1; // of the time, about, until there is a first result

/**
 * Explicit splats. A place of the world is `center` + `unit` times one of theirs; axes are the world's. Seen along the
 * unit vector d the colour is max(0, `colors` + sum over k > 0 of Y_k(d) harmonic_k).
 * @typedef {{
 *   count: number,
 *   degree: number,
 *   antialiased: boolean,
 *   center: number[],
 *   unit: number,
 *   positions: Float32Array,
 *   scales: Float32Array,
 *   quats: Float32Array,
 *   opacities: Float32Array,
 *   colors: Float32Array,
 *   harmonics: Uint8Array,
 *   range: number,
 * }} Splats of each of which there are: the position and the scales (standard deviations) in page units; the rotation,
 *   wxyz of unit length; the opacity in [0, 1]; the colour; of every further harmonic RGB, (byte - 128) / 128 * range
 *
 * A camera in a model's local units: where it stands, its rotation and translation, bounds of x / z and y / z of what
 * it draws, by how much squares of its pictures are larger than those of angles, and the pixels of a picture.
 * @typedef {{place: number[], rows: number[][], translation: number[], bounds: number[], focal: number, area: number}}
 *   LocalEye
 *
 * @typedef {import("./index.js").Model} Model
 */

/**
 * A model as splats, with shapes and opacities of its own. For each Gaussian, over the cameras v that see it, colours
 * minimise
 *
 *     sum_v w_v |f(d_v) - color(d_v)|^2 + SPHERE_WEIGHT mean_s |f(d_s) - color(d_s)|^2 + RIDGE sum_{k > 0} |h_k|^2
 *
 * with w_v the area that it has in their pictures, sum_v w_v = 1, and directions d_s that cover the sphere evenly. What
 * hides behind what is not asked.
 *
 * @param {Model} model
 * @param {import("./viewpoint.js").Camera[]} viewpoints from where it is looked at, world units; none: the sphere alone
 * @param {number} degree of the harmonics, 0 to 3
 * @param {(progress: {done: number, splats: Splats, coarse: boolean}) => unknown} [report] told how it goes, and waited
 *   for: the part `done`, and the splats as they are. Once, if there is a Gaussian, `coarse` is true: then all of them
 *   are there, with the colours that the first viewpoint sees. What it throws ends the work.
 * @returns {Promise<Splats>}
 * @throws {HyrfFormatError} a number that comes out is NaN or infinite
 */
export async function fitHarmonics(model, viewpoints, degree, report = () => {}) {
  const { count, config } = model, { center, scale } = config.frame, others = OTHER_HARMONICS[degree];
  /** @type {Splats} */
  const splats = {
    count, degree,
    antialiased: config.antialiased,
    center: [...center],
    unit: scale,
    positions: model.positions.slice(0, 3 * count),
    scales: new Float32Array(3 * count),
    quats: new Float32Array(4 * count),
    opacities: new Float32Array(count),
    colors: new Float32Array(3 * count),
    harmonics: new Uint8Array(3 * others * count).fill(128),
    range: 1,
  };
  const eyes = viewpoints.map((camera) => localEye(camera, config.frame));
  for (let start = 0; start < count; start += FITTED_ROWS) {
    const stop = Math.min(start + FITTED_ROWS, count);
    shapeBlock(model, splats, eyes, start, stop);
    await report({ done: (COARSE_SHARE * stop) / count, splats, coarse: stop === count });
  }
  const fit = new HarmonicsFit(degree);
  splats.range = fit.range(model, splats, eyes);
  for (let start = 0; start < count; start += FITTED_ROWS) {
    const stop = Math.min(start + FITTED_ROWS, count);
    fit.block(model, splats, eyes, start, stop, (i) => fit.store(splats, i));
    await report({ done: COARSE_SHARE + ((1 - COARSE_SHARE) * stop) / count, splats, coarse: false });
  }
  return splats;
}

/**
 * The largest harmonic to be stored, so that almost none is cut and steps are fine.
 * @param {number[]} sizes of many of them
 * @returns {number}
 */
export function storedRange(sizes) {
  const ordered = Float64Array.from(sizes).sort();
  return ordered[Math.floor((1 - CUT_PART) * ordered.length)] || 1;
}

/**
 * Shapes of a block of Gaussians, and their colours from the first viewpoint.
 * @param {Model} model
 * @param {Splats} splats
 * @param {LocalEye[]} eyes
 * @param {number} start
 * @param {number} stop
 */
function shapeBlock(model, splats, eyes, start, stop) {
  const { opacities, scales, quats } = decodeGeometry(model, start, stop);
  const eye = eyes[0]?.place ?? [0, 0, 0], directions = new Float32Array(3 * (stop - start));
  for (let i = start; i < stop; i++) aimFrom(eye, splats.positions, i, directions, i - start);
  const colors = colorsAlong(model, firstLayers(model, start, stop), start, stop, directions);
  needFinite("shape", opacities, scales, quats);
  needFinite("colour", colors);
  splats.opacities.set(opacities, start);
  splats.scales.set(scales, 3 * start);
  splats.quats.set(quats, 4 * start);
  splats.colors.set(colors, 3 * start);
}

/**
 * @param {string} what
 * @param {...Float32Array} arrays
 */
function needFinite(what, ...arrays) {
  if (arrays.every((array) => array.every(Number.isFinite))) return;
  throw new HyrfFormatError(`The ${what} of a Gaussian is not a finite number: the model is broken; train it again.`);
}

// --- views -----------------------------------------------------------------------------------------------------------

/**
 * A camera in the model's local units.
 * @param {import("./viewpoint.js").Camera} camera
 * @param {{center: number[], scale: number}} frame
 * @returns {LocalEye}
 */
function localEye(camera, { center, scale }) {
  const { fx, fy, cx, cy, width, height, camera_from_world: pose } = camera;
  const translation = [0, 1, 2].map((r) => {
    const [a, b, c, d] = pose[r];
    return (a * center[0] + b * center[1] + c * center[2] + d) / scale;
  });
  const place = cameraPlace(camera).map((value, k) => (value - center[k]) / scale);
  const wide = (SEEN_BESIDE * width) / 2, high = (SEEN_BESIDE * height) / 2;
  const bounds = [(-wide - cx) / fx, (width + wide - cx) / fx, (-high - cy) / fy, (height + high - cy) / fy];
  return { place, rows: pose.slice(0, 3), translation, bounds, focal: fx * fy, area: width * height };
}

/**
 * The area, in pixels, that Gaussian i has in the picture of an eye, as far as it is drawn there; 0 where it is not.
 * @param {LocalEye} eye
 * @param {Splats} splats
 * @param {number} i
 * @returns {number}
 */
function seenArea({ rows: [right, down, forward], translation: [tx, ty, tz], bounds, focal, area }, splats, i) {
  const { positions, scales } = splats, x = positions[3 * i], y = positions[3 * i + 1], z = positions[3 * i + 2];
  const depth = forward[0] * x + forward[1] * y + forward[2] * z + tz;
  if (!(depth > SEEN_FROM)) return 0;
  const across = (right[0] * x + right[1] * y + right[2] * z + tx) / depth;
  if (!(across > bounds[0] && across < bounds[1])) return 0;
  const along = (down[0] * x + down[1] * y + down[2] * z + ty) / depth;
  if (!(along > bounds[2] && along < bounds[3])) return 0;
  const a = scales[3 * i], b = scales[3 * i + 1], c = scales[3 * i + 2];
  const face = Math.max(a * b, b * c, c * a) / (depth * depth);
  return Math.min(2 * Math.PI * (focal * face + 0.3), area); // no smaller than the renderer's low-pass filter
}

/**
 * The unit vector from an eye to Gaussian i, as the row `to` of `directions`.
 * @param {number[]} eye
 * @param {Float32Array} positions
 * @param {number} i
 * @param {Float32Array} directions
 * @param {number} to
 */
function aimFrom(eye, positions, i, directions, to) {
  const x = positions[3 * i] - eye[0], y = positions[3 * i + 1] - eye[1], z = positions[3 * i + 2] - eye[2];
  const length = Math.max(Math.sqrt(x * x + y * y + z * z), 1e-12);
  directions[3 * to] = x / length;
  directions[3 * to + 1] = y / length;
  directions[3 * to + 2] = z / length;
}

// --- least squares ---------------------------------------------------------------------------------------------------

class HarmonicsFit {
  /** @param {number} degree */
  constructor(degree) {
    const terms = (degree + 1) ** 2;
    this.degree = degree;
    this.terms = terms;
    this.sphere = sphereDirections(SPHERE_DIRECTIONS);
    this.sphereBasis = new Float64Array(SPHERE_DIRECTIONS * terms);
    this.basis = new Float64Array(terms);
    this.matrix = new Float64Array(terms * terms); // the lower half
    this.right = new Float64Array(terms * 3);
    this.start = new Float64Array(terms * terms); // of the matrix: what is the same for all Gaussians
    for (let k = 1; k < terms; k++) this.start[k * terms + k] = RIDGE;
    for (let s = 0; s < SPHERE_DIRECTIONS; s++) {
      const [x, y, z] = this.sphere.subarray(3 * s, 3 * s + 3);
      fillBasis(degree, x, y, z, this.basis);
      this.sphereBasis.set(this.basis, s * terms);
      addSquare(this.start, this.basis, terms, SPHERE_WEIGHT / SPHERE_DIRECTIONS);
    }
  }

  /**
   * How large harmonics have to be stored, by a sample of all.
   * @param {Model} model
   * @param {Splats} splats
   * @param {LocalEye[]} eyes
   * @returns {number}
   */
  range(model, splats, eyes) {
    const last = Math.ceil(model.count / FITTED_ROWS) - 1, sizes = /** @type {number[]} */ ([]);
    for (const block of new Set(Array.from({ length: SAMPLED }, (_, k) => Math.floor((k * last) / (SAMPLED - 1))))) {
      const start = Math.max(block, 0) * FITTED_ROWS, stop = Math.min(start + FITTED_ROWS, model.count);
      this.block(model, splats, eyes, start, stop, () => {
        for (let k = 3; k < 3 * this.terms; k++) sizes.push(Math.abs(this.right[k]));
      });
    }
    return storedRange(sizes);
  }

  /**
   * Fit the colours of Gaussians `start` to `stop`, whose shapes are known; `keep` is called with the number of each.
   * @param {Model} model
   * @param {Splats} splats
   * @param {LocalEye[]} eyes
   * @param {number} start
   * @param {number} stop
   * @param {(i: number) => void} keep
   */
  block(model, splats, eyes, start, stop, keep) {
    const most = (eyes.length + SPHERE_DIRECTIONS) * (stop - start);
    const rows = new Int32Array(most), weights = new Float64Array(most), directions = new Float32Array(3 * most);
    const ends = new Int32Array(stop - start);
    let used = 0;
    for (let i = start; i < stop; i++) {
      const own = used;
      let sum = 0;
      for (const eye of eyes) {
        const area = seenArea(eye, splats, i);
        if (area === 0) continue;
        aimFrom(eye.place, splats.positions, i, directions, used);
        weights[used++] = area;
        sum += area;
      }
      for (let k = own; k < used; k++) weights[k] /= sum;
      directions.set(this.sphere, 3 * used);
      weights.fill(SPHERE_WEIGHT / SPHERE_DIRECTIONS, used, used + SPHERE_DIRECTIONS);
      used += SPHERE_DIRECTIONS;
      rows.fill(i - start, own, used);
      ends[i - start] = used;
    }
    const layers = firstLayers(model, start, stop);
    const colors = colorsOfRows(model, layers, start, rows.subarray(0, used), directions, new Float32Array(3 * used));
    for (let i = start, from = 0; i < stop; from = ends[i - start], i++) {
      this.solve(directions, weights, colors, from, ends[i - start]);
      keep(i);
    }
  }

  /**
   * Coefficients, as `right`, from rows `from` to `to` of directions, weights and colours; the sphere's are the last.
   * @param {Float32Array} directions
   * @param {Float64Array} weights
   * @param {Float32Array} colors
   * @param {number} from
   * @param {number} to
   */
  solve(directions, weights, colors, from, to) {
    const { degree, terms, basis, matrix, right, sphereBasis } = this, sphere = to - SPHERE_DIRECTIONS;
    matrix.set(this.start);
    right.fill(0);
    for (let row = from; row < to; row++) {
      const weight = weights[row];
      if (row < sphere) {
        fillBasis(degree, directions[3 * row], directions[3 * row + 1], directions[3 * row + 2], basis);
        addSquare(matrix, basis, terms, weight);
      } else {
        for (let k = 0; k < terms; k++) basis[k] = sphereBasis[(row - sphere) * terms + k];
      }
      const red = weight * (colors[3 * row] - 0.5), green = weight * (colors[3 * row + 1] - 0.5);
      const blue = weight * (colors[3 * row + 2] - 0.5);
      for (let k = 0; k < terms; k++) {
        right[3 * k] += basis[k] * red;
        right[3 * k + 1] += basis[k] * green;
        right[3 * k + 2] += basis[k] * blue;
      }
    }
    solveCholesky(matrix, right, terms);
  }

  /**
   * The coefficients found last, as those of Gaussian i.
   * @param {Splats} splats
   * @param {number} i
   */
  store({ colors, harmonics, range }, i) {
    const { right, terms } = this, others = 3 * (terms - 1);
    for (let c = 0; c < 3; c++) colors[3 * i + c] = 0.5 + BAND_0 * right[c];
    for (let k = 0; k < others; k++) {
      harmonics[others * i + k] = Math.max(0, Math.min(255, Math.round(128 + (128 / range) * right[3 + k])));
    }
  }
}

/**
 * To the lower half of a matrix, the products of a vector's elements, times a weight.
 * @param {Float64Array} matrix
 * @param {Float64Array} vector
 * @param {number} size
 * @param {number} weight
 */
function addSquare(matrix, vector, size, weight) {
  for (let row = 0; row < size; row++) {
    const factor = weight * vector[row];
    for (let column = 0, at = row * size; column <= row; column++) matrix[at + column] += factor * vector[column];
  }
}

/**
 * Solve A x = b for three right sides by A = L L^T; both are overwritten, by L and x. A is symmetric, its lower half
 * given, and positive definite.
 * @param {Float64Array} matrix
 * @param {Float64Array} right
 * @param {number} size
 */
function solveCholesky(matrix, right, size) {
  for (let row = 0; row < size; row++) {
    for (let column = 0; column <= row; column++) {
      let value = matrix[row * size + column];
      for (let k = 0; k < column; k++) value -= matrix[row * size + k] * matrix[column * size + k];
      matrix[row * size + column] = row === column ? Math.sqrt(value) : value / matrix[column * size + column];
    }
  }
  for (let c = 0; c < 3; c++) {
    for (let row = 0; row < size; row++) {
      let value = right[3 * row + c];
      for (let k = 0; k < row; k++) value -= matrix[row * size + k] * right[3 * k + c];
      right[3 * row + c] = value / matrix[row * size + row];
    }
    for (let row = size - 1; row >= 0; row--) {
      let value = right[3 * row + c];
      for (let k = row + 1; k < size; k++) value -= matrix[k * size + row] * right[3 * k + c];
      right[3 * row + c] = value / matrix[row * size + row];
    }
  }
}

/**
 * Unit vectors spread evenly over the sphere: points of a Fibonacci lattice.
 * @param {number} count
 */
function sphereDirections(count) {
  const directions = new Float32Array(3 * count);
  for (let k = 0; k < count; k++) {
    const height = 1 - (2 * k + 1) / count, angle = Math.PI * (1 + Math.sqrt(5)) * k;
    const radius = Math.sqrt(1 - height * height);
    directions.set([radius * Math.cos(angle), radius * Math.sin(angle), height], 3 * k);
  }
  return directions;
}

/**
 * Real spherical harmonics with the Condon-Shortley phase, as files of splats have them, up to a degree.
 * @param {number} degree
 * @param {number} x
 * @param {number} y
 * @param {number} z
 * @param {Float64Array} basis
 */
function fillBasis(degree, x, y, z, basis) {
  basis[0] = BAND_0;
  if (degree < 1) return;
  basis[1] = -0.4886025119029199 * y;
  basis[2] = 0.4886025119029199 * z;
  basis[3] = -0.4886025119029199 * x;
  if (degree < 2) return;
  const xx = x * x, yy = y * y, zz = z * z;
  basis[4] = 1.0925484305920792 * x * y;
  basis[5] = -1.0925484305920792 * y * z;
  basis[6] = 0.31539156525252005 * (3 * zz - 1);
  basis[7] = -1.0925484305920792 * x * z;
  basis[8] = 0.5462742152960396 * (xx - yy);
  if (degree < 3) return;
  basis[9] = -0.5900435899266435 * y * (3 * xx - yy);
  basis[10] = 2.890611442640554 * x * y * z;
  basis[11] = -0.4570457994644658 * y * (5 * zz - 1);
  basis[12] = 0.3731763325901154 * z * (5 * zz - 3);
  basis[13] = -0.4570457994644658 * x * (5 * zz - 1);
  basis[14] = 1.445305721320277 * z * (xx - yy);
  basis[15] = -0.5900435899266435 * x * (xx - 3 * yy);
}
