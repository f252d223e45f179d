// Chooses the levels of detail of a scene's chunks for a view and a budget, like `hyrfpack.select_levels`
// (docs/reference/scene-folder.md).

import { sharedBytes } from "./manifest.js";
import { dot, sub } from "./vectors.js";
import { cameraPosition } from "./viewpoint.js";

/**
 * @typedef {import("./manifest.js").Manifest} Manifest
 * @typedef {import("./viewpoint.js").Camera} Camera
 *
 * Levels for a view: `levels` has the level of each chunk, 0 for the finest, or -1 if it is left out. `bytes` are those
 * of their files and of the shared files, `predictedMse` the mean squared error of the view against the finest levels.
 * `maxGap` bounds how much lower the error of the best choice can be.
 * @typedef {{levels: number[], gaussians: number, bytes: number, predictedMse: number, maxGap: number}} LevelSelection
 */

const LEFT_OUT_RATIO = 3; // of the errors of a view without a chunk and with its coarsest level
const MIN_LEFT_OUT_MSE = 0.003; // of the pixels that a missing chunk covers
const UNSEEN_MSE = 1e-12; // of missing chunks outside the picture, as what they cover is an estimate
const MIN_RADIUS = 1e-30;
const MIN_DEPTH_RATIO = 1e-3; // of the distance; nearer centres would project beyond all bounds

/**
 * Chooses a level for each chunk, with the least predicted error of a view within a budget: a greedy knapsack.
 * @param {Manifest} manifest
 * @param {Camera} camera the view, in world units
 * @param {{gaussians?: number, bytes?: number, isAvailable?: (chunk: number, level: number) => boolean}} [options]
 *   `gaussians`: the most Gaussians, or `bytes`: the most bytes of files, with the shared files. Levels that are not
 *   available are not chosen.
 * @returns {LevelSelection}
 * @throws {TypeError} both limits are given
 */
export const selectLevels = (manifest, camera, { gaussians, bytes, isAvailable = () => true } = {}) => {
  if (gaussians !== undefined && bytes !== undefined) throw new TypeError("Give `gaussians` or `bytes`, not both.");
  const { chunks } = manifest, shared = sharedBytes(manifest), errors = predictErrors(manifest, camera);
  const cost = bytes === undefined ? "gaussians" : "bytes";
  const costs = chunks.map(({ levels }) => [...levels.map((level) => level[cost]), 0]);
  const limit = bytes === undefined ? (gaussians ?? Infinity) : bytes - shared;
  for (const own of errors) own[own.length - 1] += UNSEEN_MSE;
  const { levels, maxGap } = chooseLevels(costs, errors, limit, (chunk, level) => {
    return level === chunks[chunk].levels.length || isAvailable(chunk, level);
  });
  const selection = { levels, gaussians: 0, bytes: shared, predictedMse: 0, maxGap };
  levels.forEach((level, chunk) => {
    selection.predictedMse += errors[chunk][level];
    const file = chunks[chunk].levels[level];
    if (!file) return void (levels[chunk] = -1);
    selection.gaussians += file.gaussians;
    selection.bytes += file.bytes;
  });
  return selection;
};

/**
 * Chooses one level of each item with a low total error and a total cost of at most `limit`.
 * @param {number[][]} costs by item and level
 * @param {number[][]} errors by item and level
 * @param {number} limit
 * @param {(item: number, level: number) => boolean} isAvailable
 * @returns {{levels: number[], maxGap: number}} see LevelSelection
 */
export const chooseLevels = (costs, errors, limit, isAvailable) => {
  const hulls = costs.map((own, item) => lowerHull(own, errors[item], (level) => isAvailable(item, level)));
  const levels = hulls.map(([first = -1]) => first);
  let spent = levels.reduce((sum, level, item) => sum + (level < 0 ? 0 : costs[item][level]), 0);
  if (spent > limit) return { levels, maxGap: 0 };
  /** @type {{item: number, to: number, cost: number, gain: number}[]} to a better level on the hull of an item */
  const upgrades = [];
  hulls.forEach((hull, item) => {
    for (let place = 1; place < hull.length; place++) {
      const [from, to] = [hull[place - 1], hull[place]];
      const gain = errors[item][from] - errors[item][to], cost = costs[item][to] - costs[item][from];
      upgrades.push({ item, to, cost, gain });
    }
  });
  // The sort is stable, so places stay in order.
  upgrades.sort((a, b) => b.gain / b.cost - a.gain / a.cost || a.item - b.item);
  let maxGap = 0;
  const full = new Set();
  for (const { item, to, cost, gain } of upgrades) {
    if (!full.has(item) && spent + cost <= limit) {
      levels[item] = to;
      spent += cost;
    } else {
      maxGap ||= gain;
      full.add(item);
    }
  }
  return { levels, maxGap };
};

/**
 * Returns the levels on the lower convex hull of (cost, error), from the cheapest, as far as the error falls.
 * @param {number[]} costs
 * @param {number[]} errors
 * @param {(level: number) => boolean} isAvailable
 */
const lowerHull = (costs, errors, isAvailable) => {
  /** @type {number[]} */
  const hull = [];
  const levels = costs.map((_, level) => level).filter(isAvailable);
  for (const level of levels.sort((a, b) => costs[a] - costs[b] || errors[a] - errors[b] || a - b)) {
    const last = hull[hull.length - 1];
    if (hull.length && errors[level] >= errors[last]) continue;
    while (hull.length > 1) {
      const [a, b] = hull.slice(-2), rises = (errors[b] - errors[a]) * (costs[level] - costs[a]);
      if (rises < (errors[level] - errors[a]) * (costs[b] - costs[a])) break;
      hull.pop();
    }
    hull.push(level);
  }
  return hull;
};

/**
 * Predicts the mean squared error that each level of each chunk adds to a view, and last that of leaving it out.
 * @param {Manifest} manifest
 * @param {Camera} camera
 * @returns {number[][]} by chunk and level, with one more than there are levels
 */
export const predictErrors = ({ chunks, error_radii }, camera) => {
  const pixels = camera.width * camera.height, position = cameraPosition(camera), logRadii = error_radii.map(Math.log);
  return chunks.map(({ low, high, levels }) => {
    const center = low.map((value, axis) => (value + high[axis]) / 2), radius = Math.hypot(...sub(high, low)) / 2;
    const projected = projectSphere(center, radius, camera, position);
    const logRadius = Math.log(Math.max(projected.radius, MIN_RADIUS)), share = projected.area / pixels;
    const errors = levels.map((level) => interpolate(logRadii, level.errors, logRadius));
    errors.push(Math.max(LEFT_OUT_RATIO * errors[errors.length - 1], MIN_LEFT_OUT_MSE));
    return errors.map((error) => share * error);
  });
};

/**
 * Returns the radius in pixels of a sphere's projection, and its area within the picture in square pixels.
 * @param {number[]} center
 * @param {number} radius
 * @param {Camera} camera
 * @param {number[]} position of the camera
 */
const projectSphere = (center, radius, { width, height, fx, fy, cx, cy, camera_from_world: pose }, position) => {
  const offset = sub(center, position), [x, y, z] = pose.slice(0, 3).map((row) => dot(row, offset));
  const distance = Math.hypot(x, y, z), focal = Math.sqrt(fx * fy), pixels = width * height;
  const projected = (focal * radius) / Math.max(distance, radius, MIN_RADIUS);
  if (distance <= radius) return { radius: projected, area: pixels };
  if (z <= 0 && -z >= radius) return { radius: projected, area: 0 };
  const depth = Math.max(z, MIN_DEPTH_RATIO * distance), half = (focal * radius) / depth;
  const u = cx + (fx * x) / depth, v = cy + (fy * y) / depth;
  const wide = Math.min(u + half, width) - Math.max(u - half, 0);
  const high = Math.min(v + half, height) - Math.max(v - half, 0);
  return { radius: projected, area: Math.min((Math.PI / 4) * Math.max(wide, 0) * Math.max(high, 0), pixels) };
};

/**
 * Interpolates values linearly between rising places; beyond the first and the last they are constant.
 * @param {number[]} places
 * @param {number[]} values
 * @param {number} place
 */
const interpolate = (places, values, place) => {
  const next = places.findIndex((other) => other > place);
  if (next <= 0) return values[next < 0 ? values.length - 1 : 0];
  const slope = (values[next] - values[next - 1]) / (places[next] - places[next - 1]);
  return slope * (place - places[next - 1]) + values[next - 1];
};
