// Estimates the shapes and colours of a model's Gaussians for a first picture, from few evaluations of its fields.
// Fields vary little between neighbours, so Gaussians take the neural values of the nearest of a few thousand anchors.
// They add their own logits, which are not approximate. Residuals are left out.

import { colorsAlong, decodeGeometry, firstLayers } from "../hyrf/fields.js";

const MAX_ANCHORS = 4096; // take about 0.1 s
const CODE_BITS_PER_AXIS = 10;
const NEIGHBOR_REACH = 2; // candidates before and after a Gaussian's place in the order of the anchors

// Estimates what decodeGeometry and colorsAlong in hyrf/fields.js compute. `eye` is the viewpoint in local units. The
// values of anchors are exact; with up to MAX_ANCHORS Gaussians, all are anchors.
export function estimateGaussians(model, eye) {
  const { count, positions, opacityLogits, scaleLogits, colorLogits, config } = model;
  const sources = anchorIndices(count), anchors = evaluateAnchors(model, sources, eye);
  const nearest = nearestAnchors(model, sources, anchors.positions), isProduct = config.scale_rule === "product";
  const opacities = new Float32Array(count), scales = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count), colors = new Float32Array(3 * count);
  for (let i = 0, p = 0, q = 0; i < count; i++, p += 3, q += 4) {
    const anchor = nearest[i], a = 3 * anchor, b = 4 * anchor, largest = scaleBound(positions, p, config);
    const ownOdds = Math.exp(scaleLogits[i]), own = 1 / (1 + 1 / ownOdds);
    opacities[i] = addLogit(anchors.opacities[anchor], Math.exp(opacityLogits[i]));
    for (let k = 0; k < 3; k++) {
      const neural = anchors.scales[a + k];
      scales[p + k] = largest * (isProduct ? neural * own : addLogit(neural, ownOdds));
      colors[p + k] = addLogit(anchors.colors[a + k], Math.exp(colorLogits[p + k]));
    }
    for (let k = 0; k < 4; k++) quats[q + k] = anchors.quats[b + k];
  }
  return { opacities, scales, quats, colors };
}

// Returns sigmoid(x + y) from sigmoid(x) and exp(y).
const addLogit = (probability, odds) => 1 / (1 + (1 / probability - 1) / odds);

// Returns the largest scale of the Gaussian whose position begins at index `p`, in local units.
function scaleBound(positions, p, { scale_grows: grows, frame: { half_extent: [hx, hy, hz] } }) {
  return grows ? Math.max(1, Math.hypot(positions[p] / hx, positions[p + 1] / hy, positions[p + 2] / hz)) : 1;
}

// Returns the indices of the Gaussians that are anchors. They are evenly spaced in the file, which has neighbours near
// each other.
function anchorIndices(count) {
  const length = Math.min(count, MAX_ANCHORS);
  return Uint32Array.from({ length }, (_, k) => Math.floor(((k + 0.5) * count) / length));
}

// Evaluates the fields alone at the positions of Gaussians: what these would be if their logits were 0, and their
// scales as fractions, before their own factor.
function evaluateAnchors(model, sources, eye) {
  const count = sources.length, positions = new Float32Array(3 * count), directions = new Float32Array(3 * count);
  for (let k = 0, p = 0; k < count; k++, p += 3) {
    positions.set(model.positions.subarray(3 * sources[k], 3 * sources[k] + 3), p);
    const ray = eye.map((value, axis) => positions[p + axis] - value), length = Math.hypot(...ray) || 1;
    for (let axis = 0; axis < 3; axis++) directions[p + axis] = ray[axis] / length;
  }
  const logits = new Float32Array(3 * count);
  const explicit = { opacityLogits: logits, scaleLogits: logits, colorLogits: logits };
  const bare = { ...model, count, positions, ...explicit, shapeResiduals: null, colorResiduals: null };
  const { opacities, scales, quats } = decodeGeometry(bare, 0, count);
  const colors = colorsAlong(bare, firstLayers(bare, 0, count), 0, count, directions);
  const ownFactor = model.config.scale_rule === "product" ? 0.5 : 1; // sigmoid(0)
  for (let p = 0; p < scales.length; p++) {
    scales[p] /= ownFactor * scaleBound(positions, p - (p % 3), model.config);
  }
  return { positions, opacities, scales, quats, colors };
}

// Returns for each Gaussian the index of a near anchor: itself, or the nearest of those that are next to it on a
// space-filling curve.
function nearestAnchors({ count, positions, config: { frame } }, sources, anchorPositions) {
  const anchorCodes = curveCodes(anchorPositions, frame.half_extent), codes = curveCodes(positions, frame.half_extent);
  const order = sources.map((_, k) => k).sort((a, b) => anchorCodes[a] - anchorCodes[b]);
  const sorted = order.map((anchor) => anchorCodes[anchor]), nearest = new Uint32Array(count);
  for (let i = 0, p = 0; i < count; i++, p += 3) {
    let first = 0, last = sorted.length; // bounds of the first anchor whose code is not smaller
    while (first < last) {
      const middle = (first + last) >>> 1;
      if (sorted[middle] < codes[i]) first = middle + 1;
      else last = middle;
    }
    let smallest = Infinity;
    const end = Math.min(sorted.length, first + NEIGHBOR_REACH);
    for (let k = Math.max(0, first - NEIGHBOR_REACH); k < end; k++) {
      const a = 3 * order[k];
      const x = anchorPositions[a] - positions[p], y = anchorPositions[a + 1] - positions[p + 1];
      const z = anchorPositions[a + 2] - positions[p + 2], square = x * x + y * y + z * z;
      if (square >= smallest) continue;
      smallest = square;
      nearest[i] = order[k];
    }
  }
  sources.forEach((source, k) => (nearest[source] = k)); // near anchors may have the same code
  return nearest;
}

// Returns the places of positions on a Morton curve through the unit cube of the hash grids.
function curveCodes(positions, [hx, hy, hz]) {
  const codes = new Uint32Array(positions.length / 3), cells = 2 ** CODE_BITS_PER_AXIS;
  for (let i = 0, p = 0; i < codes.length; i++, p += 3) {
    const x = positions[p] / hx, y = positions[p + 1] / hy, z = positions[p + 2] / hz;
    const radius = Math.max(1, Math.sqrt(x * x + y * y + z * z)), factor = (0.25 * (2 - 1 / radius)) / radius;
    const cell = (side) => Math.min(cells - 1, (cells * (factor * side + 0.5)) | 0);
    codes[i] = spreadBits(cell(x)) | (spreadBits(cell(y)) << 1) | (spreadBits(cell(z)) << 2);
  }
  return codes;
}

// Puts two zeros between the bits of a number of CODE_BITS_PER_AXIS bits.
function spreadBits(bits) {
  let spread = (bits | (bits << 16)) & 0x030000ff;
  spread = (spread | (spread << 8)) & 0x0300f00f;
  spread = (spread | (spread << 4)) & 0x030c30c3;
  return (spread | (spread << 2)) & 0x09249249;
}
