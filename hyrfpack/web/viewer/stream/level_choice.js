// Chooses the levels of a scene's chunks for a view, within a budget of Gaussians and of rows of the textures. Large
// scenes exceed it even with the coarsest levels of all chunks. Then those of the nearest chunks are kept in memory,
// whatever the view shows, and another chunk has a level only if it is worth its cost in the view.

import { chooseLevels, predictErrors } from "../../hyrf/levels.js";
import { dot, sub } from "../../hyrf/vectors.js";
import { UNUSABLE } from "./chunk_levels.js";

const KEPT_BUDGET_RATIO = 1 / 4; // for the coarsest levels of the nearest chunks

// Sets the `target` of each of `chunks`, -1 for those that are left out, and whether its coarsest level `isKept`: of
// all chunks if memory holds the whole scene (`isWhole`). `rows` is the most rows of the chosen levels, or Infinity.
// Returns the predicted errors of the view by chunk and level, and last without the chunk.
export function chooseTargets(manifest, chunks, camera, { gaussians, rows, isWhole }) {
  const errors = predictErrors(manifest, camera);
  const costOf = ({ file, rowCount }) => Math.max(file.gaussians, (rowCount / rows) * gaussians);
  const costs = chunks.map(({ levels }) => [...levels.map(costOf), 0]);
  const limit = isWhole ? Infinity : KEPT_BUDGET_RATIO * gaussians;
  keepNearest(chunks, manifest.chunks.map((chunk) => angularSize(chunk, camera)), costs, limit);
  const isAvailable = (number, level) => {
    const { levels, coarsest, isKept } = chunks[number];
    return level > coarsest ? !isKept : levels[level].state !== UNUSABLE;
  };
  chooseLevels(costs, errors, gaussians, isAvailable).levels.forEach((level, number) => {
    chunks[number].target = level > chunks[number].coarsest ? -1 : level;
  });
  return errors;
}

// Returns how large a chunk looks from the eye, in whatever direction it is.
function angularSize({ low, high }, { camera_from_world: pose }) {
  const center = low.map((value, axis) => (value + high[axis]) / 2);
  const distance = Math.hypot(...pose.slice(0, 3).map((row) => dot(row, center) + row[3]));
  return Math.hypot(...sub(high, low)) / distance;
}

// Keeps the coarsest levels of the chunks that look largest, within a cost.
function keepNearest(chunks, sizes, costs, limit) {
  let spent = 0;
  for (const chunk of [...chunks].sort((a, b) => sizes[b.number] - sizes[a.number])) {
    spent += costs[chunk.number][chunk.coarsest];
    chunk.isKept = spent <= limit;
  }
}
