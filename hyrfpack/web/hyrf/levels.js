// Chooses the levels of detail of a scene's chunks for a view and a budget, like `hyrfpack.select_levels`
// (docs/reference/scene-folder.md).

import { sharedBytes } from "./manifest.js";
import { dot, sub } from "./vectors.js";

/**
 * @typedef {import("./manifest.js").Manifest} Manifest
 * @typedef {import("./viewpoint.js").Camera} Camera
 *
 * Levels for a view: `levels` has the level of each chunk, 0 for the finest, or -1 for a chunk without a level;
 * `gaussians` is their number of Gaussians, `bytes` the size of their files and of the shared files. `predictedMse` is
 * the predicted mean squared error of the view against the finest levels. `maxGap` bounds how much lower the error of
 * the best choice can be.
 * @typedef {{levels: number[], gaussians: number, bytes: number, predictedMse: number, maxGap: number}} LevelSelection
 *
 * A step from a level of an item to a better one on its hull; `rate` is the gain of error for its cost.
 * @typedef {{item: number, from: number, to: number, cost: number, gain: number, rate: number}} Upgrade
 */

const MIN_RADIUS = 1e-30;
const MIN_DEPTH_RATIO = 1e-3; // of the distance; nearer centres would project beyond all bounds

/**
 * Chooses a level for each chunk, with the least predicted error of a view within a budget: a greedy knapsack.
 * @param {Manifest} manifest
 * @param {Camera} camera the view, in world units
 * @param {{gaussians?: number, bytes?: number, isAvailable?: (chunk: number, level: number) => boolean}} [options]
 *   `gaussians`: the most Gaussians, or `bytes`: the most bytes of files; if not even the cheapest levels fit, these
 *   are chosen. Levels that are not available are left out.
 * @returns {LevelSelection}
 */
export const selectLevels = (manifest, camera, { gaussians, bytes, isAvailable = () => true } = {}) => {
  const { chunks } = manifest, shared = sharedBytes(manifest), errors = predictErrors(manifest, camera);
  const cost = bytes === undefined ? "gaussians" : "bytes";
  const costs = chunks.map((chunk) => chunk.levels.map((level) => level[cost]));
  const limit = bytes === undefined ? (gaussians ?? Infinity) : bytes - shared;
  const { levels, maxGap } = chooseLevels(costs, errors, limit, isAvailable);
  const selection = { levels, gaussians: 0, bytes: shared, predictedMse: 0, maxGap };
  levels.forEach((level, chunk) => {
    if (level < 0) return;
    selection.gaussians += chunks[chunk].levels[level].gaussians;
    selection.bytes += chunks[chunk].levels[level].bytes;
    selection.predictedMse += errors[chunk][level];
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
  /** @type {Upgrade[]} */
  const upgrades = [];
  hulls.forEach((hull, item) => {
    for (let place = 1; place < hull.length; place++) {
      const [from, to] = [hull[place - 1], hull[place]];
      const gain = errors[item][from] - errors[item][to], cost = costs[item][to] - costs[item][from];
      upgrades.push({ item, from, to, cost, gain, rate: gain / cost });
    }
  });
  upgrades.sort((a, b) => b.rate - a.rate || a.item - b.item); // the sort is stable, so places stay in order
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
    if (hull.length && costs[level] === costs[last]) hull.pop();
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
 * Predicts the mean squared error that each level of each chunk adds to a view.
 * @param {Manifest} manifest
 * @param {Camera} camera
 * @returns {number[][]} by chunk and level
 */
export const predictErrors = ({ chunks, error_radii }, camera) => {
  const pixels = camera.width * camera.height, position = eyeOf(camera), logRadii = error_radii.map(Math.log);
  return chunks.map(({ low, high, levels }) => {
    const center = low.map((value, axis) => (value + high[axis]) / 2), radius = Math.hypot(...sub(high, low)) / 2;
    const projected = projectSphere(center, radius, camera, position);
    const logRadius = Math.log(Math.max(projected.radius, MIN_RADIUS)), share = projected.area / pixels;
    return levels.map(({ errors }) => share * interpolate(logRadii, errors, logRadius));
  });
};

/**
 * Returns the position of a camera in world units.
 * @param {Camera} camera
 */
const eyeOf = ({ camera_from_world: pose }) =>
  [0, 1, 2].map((axis) => -(pose[0][axis] * pose[0][3] + pose[1][axis] * pose[1][3] + pose[2][axis] * pose[2][3]));

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
