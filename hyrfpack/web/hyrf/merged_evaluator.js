// Evaluates the models of a merged file for one viewpoint after the other, as one set of Gaussians in the local units
// of the scene, the first model. Each model begins a row.

import { CULL_MARGIN_RATIO, NEAR_PLANE_LOCAL, frustumPlanes } from "./frustum.js";
import { IDENTITY_PLACE, movePositions, placeOf, viewFromPlace } from "./places.js";
import { rotateBy } from "./rotation.js";
import { DepthSort } from "./sort.js";
import { add, mul } from "./vectors.js";
import { FLOATS_PER_SHAPE, GAUSSIANS_PER_ROW, ViewEvaluator } from "./view_evaluator.js";

/**
 * @typedef {import("./frustum.js").View} View
 * @typedef {import("./places.js").Place} Place
 * @typedef {import("./view_evaluator.js").EvaluatedRow} EvaluatedRow
 * @typedef {import("./view_evaluator.js").SkyTile} SkyTile
 *
 * A model of a merged file: its place in the scene, its first row and its number of rows.
 * @typedef {{evaluator: ViewEvaluator, place: Place, firstRow: number, rowCount: number}} Part
 */

/** The models of a file, drawn as one set of Gaussians. */
export class MergedEvaluator {
  /** @param {import("./reader.js").Model[]} models the scene first */
  constructor(models) {
    /** The number of rows. */
    this.rowCount = 0;
    /** @type {Part[]} */
    this.parts = models.map((model, number) => {
      const evaluator = new ViewEvaluator(model, number === 0), firstRow = this.rowCount;
      const rowCount = Math.ceil(model.count / GAUSSIANS_PER_ROW);
      this.rowCount += rowCount;
      return { evaluator, place: placeOf(model.config.frame, models[0].config.frame), firstRow, rowCount };
    });
    const joined = new Float32Array(3 * GAUSSIANS_PER_ROW * this.rowCount).fill(NaN); // splats at NaN are not drawn
    for (const { evaluator: { model }, place, firstRow } of this.parts) {
      joined.set(movePositions(model.positions, place), 3 * GAUSSIANS_PER_ROW * firstRow);
    }
    const units = this.parts.flatMap(({ place, rowCount }) => Array(rowCount).fill(place.scale));
    this.sorter = new DepthSort(joined, GAUSSIANS_PER_ROW, units);
    this.sky = this.parts[0].evaluator.sky;
  }

  /**
   * Sorts the Gaussians by their depth in a view.
   * @param {View} view in local units
   * @param {Uint32Array | null} spare an earlier order, to be overwritten
   */
  sort(view, spare) {
    // The picture is enlarged, so that no Gaussians are missing at its edges until the next order arrives.
    const sides = frustumPlanes(view, 1 + CULL_MARGIN_RATIO);
    return this.sorter.sort([...view.rows[2], view.translation[2]], sides, NEAR_PLANE_LOCAL, spare);
  }

  /**
   * Evaluates what a view needs, like `ViewEvaluator.evaluate`. What is in view of all models comes first.
   * @param {View} view
   * @param {() => void} onComplete
   * @returns {Generator<EvaluatedRow | SkyTile, void>}
   */
  *evaluate(view, onComplete) {
    const rest = [];
    for (const part of this.parts) {
      let isComplete = false;
      const steps = part.evaluator.evaluate(viewFromPlace(view, part.place), () => (isComplete = true));
      while (!isComplete) {
        const { value, done } = steps.next();
        if (done || !value) break;
        yield moveToScene(value, part);
      }
      rest.push({ part, steps });
    }
    onComplete();
    for (const { part, steps } of rest) {
      for (const value of steps) yield moveToScene(value, part);
    }
  }
}

/**
 * Returns what a part evaluates in the units and rows of the scene.
 * @param {EvaluatedRow | SkyTile} value
 * @param {Part} part
 * @returns {EvaluatedRow | SkyTile}
 */
function moveToScene(value, { place, firstRow }) {
  if (!("row" in value) || place === IDENTITY_PLACE) return value;
  const { shapes, pixelSizes } = value;
  for (let at = 0; shapes && at < shapes.length; at += FLOATS_PER_SHAPE) {
    for (let k = 0; k < FLOATS_PER_SHAPE; k += 3) {
      const vector = mul(rotateBy(place.rows, [shapes[at + k], shapes[at + k + 1], shapes[at + k + 2]]), place.scale);
      shapes.set(k ? vector : add(vector, place.shift), at + k); // the position comes before the axes
    }
  }
  for (let k = 0; pixelSizes && k < pixelSizes.length; k++) pixelSizes[k] *= place.scale;
  return { ...value, row: value.row + firstRow };
}
