// Finds the Gaussians that the actions of an edit keep, in the worker.

import { readFile } from "../hyrf/reader.js";
import { decodeGeometry } from "../hyrf/fields.js";

// Returns the opacities of a model's Gaussians, and the lengths of their longest axes in local units. `bytes` are those
// of its file.
export async function measureGaussians(bytes) {
  const model = await readFile(bytes), { count } = model, { opacities, scales } = decodeGeometry(model, 0, count);
  const lengths = Float32Array.from({ length: count }, (_, i) => Math.max(...scales.subarray(3 * i, 3 * i + 3)));
  return { opacities, lengths };
}

// Returns {kept: a byte for each Gaussian, 1 if all selections keep it; counts: the numbers that are left after each}.
// A selection is one of
//     {rows, low, high, isInverted}   rows: 3 x 4 numbers, from positions to the axes of the box
//     {minOpacity} or {maxLength}     these need `measures`, from measureGaussians
export function selectGaussians(selections, positions, measures) {
  const count = positions.length / 3, kept = new Uint8Array(count).fill(1);
  const counts = selections.map((selection) => {
    const keeps = predicateOf(selection, positions, measures);
    let left = 0;
    for (let i = 0; i < count; i++) left += kept[i] &&= keeps(i) ? 1 : 0;
    return left;
  });
  return { kept, counts };
}

// Returns the predicate of a selection: a function of a Gaussian's index, true if the selection keeps that Gaussian.
function predicateOf({ rows, low, high, isInverted, minOpacity, maxLength }, positions, measures) {
  if (minOpacity !== undefined) return (i) => measures.opacities[i] >= minOpacity;
  if (maxLength !== undefined) return (i) => measures.lengths[i] <= maxLength;
  const isInside = (i) =>
    rows.every(([a, b, c, d], axis) => {
      const value = a * positions[3 * i] + b * positions[3 * i + 1] + c * positions[3 * i + 2] + d;
      return value >= low[axis] && value <= high[axis];
    });
  return (i) => isInside(i) !== isInverted;
}
