// Converts a model to explicit splats by fitting spherical harmonics to the colours of its radiance field. Splats are
// for browsers that cannot evaluate the field while the view moves, and for programs that read only splats.

import { SH_BAND_0, evaluateBasis } from "./basis.js";
import { HyrfFormatError } from "./errors.js";
import { colorsAlong, colorsOfRows, decodeGeometry, firstLayers } from "./fields.js";
import { toLocalView } from "./viewpoint.js";

/** The number of harmonics of degree 1 and higher, by the largest degree. */
export const HIGHER_HARMONICS_BY_DEGREE = [0, 3, 8, 15];

const SPHERE_DIRECTION_COUNT = 32;
const SPHERE_TOTAL_WEIGHT = 3e-3; // small against the cameras' weights, which add up to 1
const RIDGE_WEIGHT = 1e-5;
const GAUSSIANS_PER_BLOCK = 256; // fitted together, so that the data of a block stays in the cache
const MIN_VISIBLE_DEPTH_LOCAL = 0.01;
const PICTURE_MARGIN_RATIO = 0.3; // Gaussians in this margin count as visible; in halves of the picture's size
const RANGE_SAMPLE_BLOCKS = 4;
const CLIPPED_RATIO = 1e-4; // clipping a few harmonics gives all others finer steps
const COARSE_TIME_RATIO = 0.1; // the measured share of the time until the coarse result

/**
 * Explicit splats in local axes. The world position of a point p is `center` + `unit` R p, with the rotation R of the
 * quaternion `rotation` (wxyz; absent: the axes are the world's). The colour along the unit vector d is max(0, `colors`
 * + sum over k > 0 of Y_k(d) harmonic_k).
 * @typedef {{
 *   count: number,
 *   degree: number,
 *   antialiased: boolean,
 *   center: number[],
 *   unit: number,
 *   rotation?: number[],
 *   positions: Float32Array,
 *   scales: Float32Array,
 *   quats: Float32Array,
 *   opacities: Float32Array,
 *   colors: Float32Array,
 *   harmonics: Uint8Array,
 *   range: number,
 * }} Splats For each Gaussian: position and scales (standard deviations) in units of `unit`; the rotation, wxyz of unit
 *   length; the opacity in [0, 1]; the colour; RGB of each higher harmonic, (byte - 128) / 128 * range
 *
 * A camera in a model's local units, at `place`. `bounds` are the minimum and maximum of x / z, then of y / z, that
 * count as visible; `focal` is the product of both focal lengths in pixels; `area` is the picture's number of pixels.
 * @typedef {{place: number[], rows: number[][], translation: number[], bounds: number[], focal: number, area: number}}
 *   LocalCamera
 *
 * @typedef {import("./reader.js").Model} Model
 */

/**
 * Converts a model to splats with the model's shapes and opacities. The harmonics h of each Gaussian minimise, over the
 * cameras v that see it,
 *
 *     sum_v w_v |f(d_v) - color(d_v)|^2 + s mean_s |f(d_s) - color(d_s)|^2 + r sum_{k > 0} |h_k|^2
 *
 * where s is SPHERE_TOTAL_WEIGHT, r is RIDGE_WEIGHT, w_v is proportional to the Gaussian's area in the picture of v,
 * sum_v w_v = 1, and the directions d_s cover the sphere evenly. Occlusion is ignored.
 *
 * @param {Model} model
 * @param {import("./viewpoint.js").Camera[]} viewpoints cameras in world units; if empty, only the sphere is fitted
 * @param {number} degree of the harmonics, 0 to 3
 * @param {(progress: {done: number, splats: Splats, coarse: boolean}) => unknown} [report] called and awaited after
 *   each block, with the fraction `done` in [0, 1] and the splats so far. `coarse` is true in one call, unless the
 *   model is empty: then all Gaussians are present, with their colours from the first viewpoint. An exception that
 *   `report` throws ends the conversion.
 * @returns {Promise<Splats>}
 * @throws {HyrfFormatError} a shape or a colour is NaN or infinite
 * @throws {RangeError} `degree` is not 0, 1, 2 or 3
 */
export async function fitHarmonics(model, viewpoints, degree, report = () => {}) {
  if (![0, 1, 2, 3].includes(degree)) throw new RangeError(`degree must be 0 to 3, not ${degree}.`);
  const { count, config } = model, { center, scale, rotation } = config.frame;
  const higher = HIGHER_HARMONICS_BY_DEGREE[degree];
  /** @type {Splats} */
  const splats = {
    count, degree,
    antialiased: config.antialiased,
    center: [...center],
    unit: scale,
    ...(rotation && { rotation: [...rotation] }),
    positions: model.positions.slice(0, 3 * count),
    scales: new Float32Array(3 * count),
    quats: new Float32Array(4 * count),
    opacities: new Float32Array(count),
    colors: new Float32Array(3 * count),
    harmonics: new Uint8Array(3 * higher * count).fill(128),
    range: 1,
  };
  const cameras = viewpoints.map((camera) => toLocalCamera(camera, config.frame));
  for (let start = 0; start < count; start += GAUSSIANS_PER_BLOCK) {
    const stop = Math.min(start + GAUSSIANS_PER_BLOCK, count);
    decodeBlock(model, splats, cameras, start, stop);
    await report({ done: (COARSE_TIME_RATIO * stop) / count, splats, coarse: stop === count });
  }
  const fit = new HarmonicsFit(degree);
  splats.range = fit.range(model, splats, cameras);
  for (let start = 0; start < count; start += GAUSSIANS_PER_BLOCK) {
    const stop = Math.min(start + GAUSSIANS_PER_BLOCK, count);
    fit.block(model, splats, cameras, start, stop, (i) => fit.store(splats, i));
    await report({ done: COARSE_TIME_RATIO + ((1 - COARSE_TIME_RATIO) * stop) / count, splats, coarse: false });
  }
  return splats;
}

/**
 * Chooses the largest magnitude of harmonics that can be stored: a high quantile, so that few are clipped and steps are
 * fine.
 * @param {number[]} sizes the magnitudes of a sample of harmonics
 * @returns {number}
 */
export function chooseHarmonicsRange(sizes) {
  const ordered = Float64Array.from(sizes).sort();
  return ordered[Math.floor((1 - CLIPPED_RATIO) * ordered.length)] || 1;
}

/**
 * Decodes the shapes of a block of Gaussians, and their colours from the first viewpoint.
 * @param {Model} model
 * @param {Splats} splats
 * @param {LocalCamera[]} cameras
 * @param {number} start the index of the first Gaussian
 * @param {number} stop the index after the last Gaussian
 */
function decodeBlock(model, splats, cameras, start, stop) {
  const { opacities, scales, quats } = decodeGeometry(model, start, stop);
  const eye = cameras[0]?.place ?? [0, 0, 0], directions = new Float32Array(3 * (stop - start));
  for (let i = start; i < stop; i++) writeDirection(eye, splats.positions, i, directions, i - start);
  const colors = colorsAlong(model, firstLayers(model, start, stop), start, stop, directions);
  requireFinite("shape", opacities, scales, quats);
  requireFinite("colour", colors);
  splats.opacities.set(opacities, start);
  splats.scales.set(scales, 3 * start);
  splats.quats.set(quats, 4 * start);
  splats.colors.set(colors, 3 * start);
}

/**
 * Throws an error unless all numbers are finite.
 * @param {string} what the name of the numbers in the message
 * @param {...Float32Array} arrays
 * @throws {HyrfFormatError}
 */
function requireFinite(what, ...arrays) {
  if (arrays.every((array) => array.every(Number.isFinite))) return;
  throw new HyrfFormatError(`The ${what} of a Gaussian is not a finite number: the model is broken; train it again.`);
}

// --- views -----------------------------------------------------------------------------------------------------------

/**
 * Converts a camera to the model's local units.
 * @param {import("./viewpoint.js").Camera} camera
 * @param {import("./metadata.js").Frame} frame
 * @returns {LocalCamera}
 */
function toLocalCamera(camera, frame) {
  const { fx, fy, cx, cy, width, height, rows, translation, eye } = toLocalView(camera, frame);
  const wide = (PICTURE_MARGIN_RATIO * width) / 2, high = (PICTURE_MARGIN_RATIO * height) / 2;
  const bounds = [(-wide - cx) / fx, (width + wide - cx) / fx, (-high - cy) / fy, (height + high - cy) / fy];
  return { place: eye, rows, translation, bounds, focal: fx * fy, area: width * height };
}

/**
 * Estimates the area, in pixels, of Gaussian i in a camera's picture, or 0 if the camera does not see it.
 * @param {LocalCamera} eye
 * @param {Splats} splats
 * @param {number} i
 * @returns {number}
 */
function visibleArea({ rows: [right, down, forward], translation: [tx, ty, tz], bounds, focal, area }, splats, i) {
  const { positions, scales } = splats, x = positions[3 * i], y = positions[3 * i + 1], z = positions[3 * i + 2];
  const depth = forward[0] * x + forward[1] * y + forward[2] * z + tz;
  if (!(depth > MIN_VISIBLE_DEPTH_LOCAL)) return 0;
  const across = (right[0] * x + right[1] * y + right[2] * z + tx) / depth;
  if (!(across > bounds[0] && across < bounds[1])) return 0;
  const along = (down[0] * x + down[1] * y + down[2] * z + ty) / depth;
  if (!(along > bounds[2] && along < bounds[3])) return 0;
  const a = scales[3 * i], b = scales[3 * i + 1], c = scales[3 * i + 2];
  const face = Math.max(a * b, b * c, c * a) / (depth * depth);
  return Math.min(2 * Math.PI * (focal * face + 0.3), area); // 0.3 px^2: variance of the renderer's low-pass
}

/**
 * Writes the unit vector from an eye to Gaussian i to row `to` of `directions`.
 * @param {number[]} eye
 * @param {Float32Array} positions
 * @param {number} i
 * @param {Float32Array} directions
 * @param {number} to
 */
function writeDirection(eye, positions, i, directions, to) {
  const x = positions[3 * i] - eye[0], y = positions[3 * i + 1] - eye[1], z = positions[3 * i + 2] - eye[2];
  const length = Math.max(Math.sqrt(x * x + y * y + z * z), 1e-12);
  directions[3 * to] = x / length;
  directions[3 * to + 1] = y / length;
  directions[3 * to + 2] = z / length;
}

// --- least squares ---------------------------------------------------------------------------------------------------

/** Fits harmonics by least squares, one Gaussian at a time. */
class HarmonicsFit {
  /** @param {number} degree 0 to 3 */
  constructor(degree) {
    const terms = (degree + 1) ** 2;
    this.degree = degree;
    this.terms = terms;
    this.sphere = fibonacciDirections(SPHERE_DIRECTION_COUNT);
    this.sphereBasis = new Float64Array(SPHERE_DIRECTION_COUNT * terms);
    this.basis = new Float64Array(terms);
    this.matrix = new Float64Array(terms * terms); // symmetric; only its lower half is used
    this.right = new Float64Array(terms * 3);
    this.start = new Float64Array(terms * terms); // the part of the matrix that all Gaussians share
    for (let k = 1; k < terms; k++) this.start[k * terms + k] = RIDGE_WEIGHT;
    for (let s = 0; s < SPHERE_DIRECTION_COUNT; s++) {
      const [x, y, z] = this.sphere.subarray(3 * s, 3 * s + 3);
      evaluateBasis(degree, x, y, z, this.basis);
      this.sphereBasis.set(this.basis, s * terms);
      addOuterProduct(this.start, this.basis, terms, SPHERE_TOTAL_WEIGHT / SPHERE_DIRECTION_COUNT);
    }
  }

  /**
   * Chooses the range of the stored harmonics from a sample of blocks.
   * @param {Model} model
   * @param {Splats} splats
   * @param {LocalCamera[]} cameras
   * @returns {number}
   */
  range(model, splats, cameras) {
    const last = Math.ceil(model.count / GAUSSIANS_PER_BLOCK) - 1, sizes = /** @type {number[]} */ ([]);
    const sampled = Array.from({ length: RANGE_SAMPLE_BLOCKS }, (_, k) => {
      return Math.floor((k * last) / (RANGE_SAMPLE_BLOCKS - 1));
    });
    for (const block of new Set(sampled)) {
      const start = Math.max(block, 0) * GAUSSIANS_PER_BLOCK, stop = Math.min(start + GAUSSIANS_PER_BLOCK, model.count);
      this.block(model, splats, cameras, start, stop, () => {
        for (let k = 3; k < 3 * this.terms; k++) sizes.push(Math.abs(this.right[k]));
      });
    }
    return chooseHarmonicsRange(sizes);
  }

  /**
   * Fits the colours of Gaussians `start` to `stop`, whose shapes are decoded. `keep` is called with the index of each
   * Gaussian while `right` has its coefficients.
   * @param {Model} model
   * @param {Splats} splats
   * @param {LocalCamera[]} cameras
   * @param {number} start the index of the first Gaussian
   * @param {number} stop the index after the last Gaussian
   * @param {(i: number) => void} keep
   */
  block(model, splats, cameras, start, stop, keep) {
    const capacity = (cameras.length + SPHERE_DIRECTION_COUNT) * (stop - start);
    const rows = new Int32Array(capacity), weights = new Float64Array(capacity);
    const directions = new Float32Array(3 * capacity);
    const ends = new Int32Array(stop - start);
    let used = 0;
    for (let i = start; i < stop; i++) {
      const own = used;
      let sum = 0;
      for (const eye of cameras) {
        const area = visibleArea(eye, splats, i);
        if (area === 0) continue;
        writeDirection(eye.place, splats.positions, i, directions, used);
        weights[used++] = area;
        sum += area;
      }
      for (let k = own; k < used; k++) weights[k] /= sum;
      directions.set(this.sphere, 3 * used);
      weights.fill(SPHERE_TOTAL_WEIGHT / SPHERE_DIRECTION_COUNT, used, used + SPHERE_DIRECTION_COUNT);
      used += SPHERE_DIRECTION_COUNT;
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
   * Computes the coefficients `right` from rows `from` to `to` of directions, weights and colours. The last
   * SPHERE_DIRECTION_COUNT rows are those of the sphere.
   * @param {Float32Array} directions
   * @param {Float64Array} weights
   * @param {Float32Array} colors
   * @param {number} from
   * @param {number} to
   */
  solve(directions, weights, colors, from, to) {
    const { degree, terms, basis, matrix, right, sphereBasis } = this, sphere = to - SPHERE_DIRECTION_COUNT;
    matrix.set(this.start);
    right.fill(0);
    for (let row = from; row < to; row++) {
      const weight = weights[row];
      if (row < sphere) {
        evaluateBasis(degree, directions[3 * row], directions[3 * row + 1], directions[3 * row + 2], basis);
        addOuterProduct(matrix, basis, terms, weight);
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
   * Stores the coefficients `right` as those of Gaussian i.
   * @param {Splats} splats
   * @param {number} i
   */
  store({ colors, harmonics, range }, i) {
    const { right, terms } = this, higher = 3 * (terms - 1);
    for (let c = 0; c < 3; c++) colors[3 * i + c] = 0.5 + SH_BAND_0 * right[c];
    for (let k = 0; k < higher; k++) {
      harmonics[higher * i + k] = Math.max(0, Math.min(255, Math.round(128 + (128 / range) * right[3 + k])));
    }
  }
}

/**
 * Adds weight v v^T to the lower half of a matrix.
 * @param {Float64Array} matrix
 * @param {Float64Array} vector
 * @param {number} size
 * @param {number} weight
 */
function addOuterProduct(matrix, vector, size, weight) {
  for (let row = 0; row < size; row++) {
    const factor = weight * vector[row];
    for (let column = 0, at = row * size; column <= row; column++) matrix[at + column] += factor * vector[column];
  }
}

/**
 * Solves A x = b for three right-hand sides by Cholesky decomposition, A = L L^T. A must be symmetric and positive
 * definite; only its lower half is read. L overwrites A, x overwrites b.
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
 * Returns unit vectors that cover the sphere evenly: the points of a Fibonacci lattice.
 * @param {number} count
 */
function fibonacciDirections(count) {
  const directions = new Float32Array(3 * count);
  for (let k = 0; k < count; k++) {
    const height = 1 - (2 * k + 1) / count, angle = Math.PI * (1 + Math.sqrt(5)) * k;
    const radius = Math.sqrt(1 - height * height);
    directions.set([radius * Math.cos(angle), radius * Math.sin(angle), height], 3 * k);
  }
  return directions;
}
