// Limits how finely a view samples a model: no more finely than its photos did, as training has seen no finer detail
// (docs/reference/format.md 2.10).

import { storedCameras, toLocalView } from "./viewpoint.js";

const PICTURE_MARGIN_RATIO = 0.15; // positions in this margin count as visible; in sizes of the picture
const MIN_DEPTH_LOCAL = 0.01;
const COARSE_RATE_RATIO = 1.1; // coarse cameras underestimate the rate of all photos
const MAX_RATE_RATIO = 1e3;
const MAX_CAMERAS = 128; // bounds the time that a forged file can take
const MAX_SIZE_LOCAL = 1e6; // larger ones come from broken cameras
const DEFAULT_BACKGROUND_STRIDE = 2;
const MAX_BACKGROUND_STRIDE = 64;
const STRIDE_TOLERANCE = 0.01; // files round focal lengths
const NUMBERS_PER_VIEW = 20; // see `packViews`

/** @typedef {import("./metadata.js").Metadata} Metadata */

/**
 * Computes the pixel size of the photos at positions: q = min over the cameras of the file that see the position of
 * z / f, with f = max(fx, fy) and the depth z in local units. Where no camera sees it, q is the minimum over all
 * cameras of distance / f. It is divided by the rate of all photos relative to theirs.
 *
 * @param {Float32Array} positions 3 n, in local units
 * @param {Metadata} metadata the checked metadata of the model
 * @returns {Float32Array} n sizes of a pixel in local units; 0 if the file has no valid cameras,
 *   or if these give no sensible size
 */
export function pixelSizes(positions, metadata) {
  const sizes = new Float32Array(positions.length / 3), { cameras, ratio } = samplingCameras(metadata);
  const views = packViews(cameras, metadata.config.frame);
  for (let i = 0, p = 0; i < sizes.length; i++, p += 3) {
    const x = positions[p], y = positions[p + 1], z = positions[p + 2];
    let smallest = Infinity;
    for (let k = 0; k < views.length; k += NUMBERS_PER_VIEW) {
      const depth = views[k] * x + views[k + 1] * y + views[k + 2] * z + views[k + 3], size = depth * views[k + 4];
      if (!(depth > MIN_DEPTH_LOCAL && size < smallest)) continue;
      const across = views[k + 5] * x + views[k + 6] * y + views[k + 7] * z + views[k + 8];
      if (!(across >= views[k + 9] * depth && across <= views[k + 10] * depth)) continue;
      const down = views[k + 11] * x + views[k + 12] * y + views[k + 13] * z + views[k + 14];
      if (down >= views[k + 15] * depth && down <= views[k + 16] * depth) smallest = size;
    }
    if (smallest === Infinity) smallest = smallestByDistance(views, x, y, z);
    const size = smallest / ratio;
    sizes[i] = size <= MAX_SIZE_LOCAL ? size : 0;
  }
  return sizes;
}

/**
 * Returns the first MAX_CAMERAS cameras of a file, and the rate of all photos relative to theirs.
 * @param {Metadata} metadata
 */
function samplingCameras(metadata) {
  const { cameras, isCoarse } = storedCameras(metadata, MAX_CAMERAS), stored = metadata.provenance?.rate_ratio;
  const isValid = Number.isFinite(stored) && stored >= 1 && stored <= MAX_RATE_RATIO;
  return { cameras, ratio: isValid ? stored : isCoarse ? COARSE_RATE_RATIO : 1 };
}

/**
 * Returns the minimum over views of the distance from the eye to a position, divided by the focal length.
 * @param {Float64Array} views from `packViews`
 * @param {number} x
 * @param {number} y
 * @param {number} z
 */
function smallestByDistance(views, x, y, z) {
  let smallest = Infinity;
  for (let k = 0; k < views.length; k += NUMBERS_PER_VIEW) {
    const dx = x - views[k + 17], dy = y - views[k + 18], dz = z - views[k + 19];
    const size = Math.max(Math.sqrt(dx * dx + dy * dy + dz * dz), MIN_DEPTH_LOCAL) * views[k + 4];
    if (size < smallest) smallest = size;
  }
  return smallest;
}

/**
 * Packs cameras as views in local units, NUMBERS_PER_VIEW numbers each: the row of the depth z (4), 1 / f, the row of x
 * with its bounds in units of z (6), that of y (6), and the position of the eye (3).
 * @param {import("./viewpoint.js").Camera[]} cameras in world units
 * @param {import("./metadata.js").Frame} frame
 */
function packViews(cameras, frame) {
  const numbers = cameras.flatMap((camera) => {
    const { rows, translation, eye, fx, fy, cx, cy, width, height } = toLocalView(camera, frame);
    const [across, down, depth] = rows.map((row, k) => [...row, translation[k]]);
    /** @type {(size: number, center: number, focal: number) => number[]} */
    const bounds = (size, center, focal) => {
      return [-PICTURE_MARGIN_RATIO, 1 + PICTURE_MARGIN_RATIO].map((end) => (end * size - center) / focal);
    };
    const sides = [...across, ...bounds(width, cx, fx), ...down, ...bounds(height, cy, fy)];
    return [...depth, 1 / Math.max(fx, fy), ...sides, ...eye];
  });
  return Float64Array.from(numbers);
}

/**
 * Returns the spacing of the nodes at which training evaluated the background, at the middle of a photo: the pixels
 * between them, divided by the longest focal length of the file's cameras.
 * @param {Metadata} metadata the checked metadata of the model
 * @returns {number} the tangent of an angle; 0 if the file has no valid cameras
 */
export function backgroundSpacing(metadata) {
  const focals = samplingCameras(metadata).cameras.map(({ fx, fy }) => Math.max(fx, fy));
  const stride = metadata.provenance?.background_stride;
  const isValid = Number.isInteger(stride) && stride >= 1 && stride <= MAX_BACKGROUND_STRIDE;
  return focals.length ? (isValid ? stride : DEFAULT_BACKGROUND_STRIDE) / Math.max(...focals) : 0;
}

/**
 * Returns the pixels between the nodes at which a view evaluates the background, as far apart as in training or nearer.
 * @param {number} spacing from `backgroundSpacing`
 * @param {{fx: number, fy: number}} view at its full resolution
 * @returns {number} an integer, 1 or more
 */
export function backgroundStride(spacing, { fx, fy }) {
  const pixels = Math.floor(spacing * Math.max(fx, fy) + STRIDE_TOLERANCE);
  return Math.min(MAX_BACKGROUND_STRIDE, Math.max(1, pixels));
}
