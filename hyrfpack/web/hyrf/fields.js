// Evaluates the two fields of a model on the CPU: hash grids with small decoders (docs/reference/format.md 2.3, 2.4 and
// 2.7). Inputs and outputs are float32; all sums are computed in float64.

import { evaluateBasis } from "./basis.js";
import { HASH_FACTOR_Y, HASH_FACTOR_Z, decoderLayout, gridLevels } from "./grids.js";
import { ColorResiduals, SHAPE_RESIDUALS, addShapeResiduals } from "./residuals.js";

export const BACKGROUND_RADIUS = 100; // of the background sphere, in local units (docs/reference/format.md 2.7)

// Positions are evaluated in batches of this size, so that the data of a level or a layer stays in the cache.
const ROWS_PER_BATCH = 256;
// Outputs of a layer are computed in groups of this size, so that one pass over the inputs serves all of a group.
const OUTPUTS_PER_GROUP = 8;

/**
 * A layer of a decoder in the order that `runLayer` reads. `width` is the number of outputs, `stride` that number
 * rounded up to a multiple of OUTPUTS_PER_GROUP; `index` and `value` are buffers for the inputs that are not 0.
 * @typedef {{inputs: number, width: number, stride: number, weights: Float64Array, biases: Float64Array,
 *   index: Int32Array, value: Float64Array}} Layer
 *
 * A field that is prepared for evaluation. The decoder's first layer is split in two: `first` reads the features of a
 * position, `directional` the encoded direction. The Float64Arrays are buffers for ROWS_PER_BATCH rows: contracted
 * positions (`places`), max(1, distance from the frame's centre) (`radii`), hash features, encoded directions
 * (`encoded`), and the outputs of the three layers.
 * @typedef {{levels: import("./grids.js").GridLevel[], table: Float32Array, encoding: string,
 *   first: Layer, directional: Layer, middle: Layer, last: Layer,
 *   places: Float64Array, radii: Float64Array, features: Float64Array, encoded: Float64Array,
 *   hidden: Float64Array, hidden2: Float64Array, outputs: Float64Array}} PreparedField
 *
 * @typedef {import("./reader.js").Model} Model
 * @typedef {import("./grids.js").FieldName} FieldName
 */

/**
 * The prepared fields of each model, kept for later calls.
 * @type {WeakMap<Model, Record<FieldName, PreparedField>>}
 */
const preparedFields = new WeakMap();

/**
 * Evaluates the geometry field: opacities, scales and rotations of Gaussians `start` to `stop`.
 * @param {Model} model
 * @param {number} start the index of the first Gaussian
 * @param {number} stop the index after the last Gaussian
 * @returns {{opacities: Float32Array, scales: Float32Array, quats: Float32Array}} opacities (n) in [0, 1]; scales
 *   (3 n), standard deviations in local units; quaternions (4 n), wxyz of unit length
 */
export function decodeGeometry(model, start, stop) {
  const { geometry } = getPreparedFields(model), { scale_rule: rule, scale_grows: grows } = model.config;
  const { opacityLogits, scaleLogits, shapeResiduals } = model, { places, radii, outputs } = geometry;
  const opacities = new Float32Array(stop - start);
  const scales = new Float32Array(3 * (stop - start)), quats = new Float32Array(4 * (stop - start));
  for (let first = start; first < stop; first += ROWS_PER_BATCH) {
    const rows = Math.min(ROWS_PER_BATCH, stop - first);
    contractPositions(model, model.positions, first, rows, places, radii);
    encodePositions(geometry, rows);
    runLayer(geometry.first, geometry.features, geometry.first.inputs, false, rows, geometry.hidden);
    runLaterLayers(geometry, rows, outputs);
    for (let row = 0; row < rows; row++) {
      const i = first + row, at = i - start, raw = row * geometry.last.stride, maxScale = grows ? radii[row] : 1;
      if (shapeResiduals) addShapeResiduals(outputs, raw, shapeResiduals, SHAPE_RESIDUALS * i);
      opacities[at] = sigmoid(outputs[raw] + opacityLogits[i]);
      for (let axis = 0; axis < 3; axis++) {
        const predicted = outputs[raw + 1 + axis], logit = scaleLogits[i];
        const ratio = rule === "sum" ? sigmoid(predicted + logit) : sigmoid(predicted) * sigmoid(logit);
        scales[3 * at + axis] = maxScale * ratio;
      }
      const w = outputs[raw + 4] + 1, x = outputs[raw + 5], y = outputs[raw + 6], z = outputs[raw + 7];
      const length = Math.sqrt(w * w + x * x + y * y + z * z);
      const inverse = length === 0 ? 0 : 1 / length;
      quats[4 * at] = length === 0 ? 1 : w * inverse;
      quats[4 * at + 1] = x * inverse;
      quats[4 * at + 2] = y * inverse;
      quats[4 * at + 3] = z * inverse;
    }
  }
  return { opacities, scales, quats };
}

/**
 * Evaluates the view-independent part of the colour decoder's first layer, before its ReLU, for `colorsAlong`.
 * @param {Model} model
 * @param {number} start the index of the first Gaussian
 * @param {number} stop the index after the last Gaussian
 * @returns {Float32Array} `config.hidden` numbers for each Gaussian
 */
export function firstLayers(model, start, stop) {
  const { radiance } = getPreparedFields(model), { width, stride } = radiance.first;
  const layers = new Float32Array((stop - start) * width);
  for (let first = start; first < stop; first += ROWS_PER_BATCH) {
    const rows = Math.min(ROWS_PER_BATCH, stop - first);
    contractPositions(model, model.positions, first, rows, radiance.places, radiance.radii);
    encodePositions(radiance, rows);
    runLayer(radiance.first, radiance.features, radiance.first.inputs, false, rows, radiance.hidden);
    for (let row = 0, at = (first - start) * width; row < rows; row++, at += width) {
      for (let k = 0; k < width; k++) layers[at + k] = radiance.hidden[row * stride + k];
    }
  }
  return layers;
}

/**
 * Evaluates the colours of Gaussians `start` to `stop` along given directions.
 * @param {Model} model
 * @param {Float32Array} layers from `firstLayers`, of the same Gaussians
 * @param {number} start the index of the first Gaussian
 * @param {number} stop the index after the last Gaussian
 * @param {Float32Array} directions 3 n: unit vectors from the viewpoint to each Gaussian
 * @returns {Float32Array} 3 n, 0 or more, and at most 1 without residuals
 */
export function colorsAlong(model, layers, start, stop, directions) {
  const rows = Int32Array.from({ length: stop - start }, (_, row) => row);
  return colorsOfRows(model, layers, start, rows, directions, new Float32Array(3 * rows.length));
}

/**
 * Evaluates colours of selected Gaussians along given directions. A Gaussian may be selected repeatedly.
 * @param {Model} model
 * @param {Float32Array} layers from `firstLayers`
 * @param {number} start the first Gaussian of `layers`
 * @param {Int32Array} rows n: the selected Gaussians, counted from `start`
 * @param {Float32Array} directions 3 n or more: a unit vector from the viewpoint for each selected Gaussian
 * @param {Float32Array} colors 3 n or more, overwritten
 * @returns {Float32Array} `colors`
 */
export function colorsOfRows(model, layers, start, rows, directions, colors) {
  const { radiance } = getPreparedFields(model), { colorLogits, colorResiduals, config } = model;
  const residuals = colorResiduals && new ColorResiduals(colorResiduals, config.residual_degree ?? 0);
  const { hidden, outputs, last, first: { width, stride } } = radiance;
  for (let first = 0; first < rows.length; first += ROWS_PER_BATCH) {
    const count = Math.min(ROWS_PER_BATCH, rows.length - first);
    encodeDirections(radiance, directions, first, count);
    runLayer(radiance.directional, radiance.encoded, radiance.directional.inputs, false, count, hidden);
    for (let row = 0; row < count; row++) {
      for (let k = 0, at = rows[first + row] * width; k < width; k++) hidden[row * stride + k] += layers[at + k];
    }
    runLaterLayers(radiance, count, outputs);
    for (let row = 0, at = 3 * first; row < count; row++) {
      const gaussian = start + rows[first + row];
      residuals?.turn(directions, at);
      for (let c = 0; c < 3; c++) {
        const color = sigmoid(outputs[row * last.stride + c] + colorLogits[3 * gaussian + c]);
        colors[at++] = residuals ? residuals.corrected(color, gaussian, c) : color;
      }
    }
  }
  return colors;
}

/**
 * Evaluates the colours of the background sphere.
 * @param {Model} model
 * @param {Float32Array} places 3 n: points on the sphere, local units
 * @param {Float32Array} directions 3 n: unit vectors from the viewpoint to these points
 * @returns {Float32Array} 3 n in [0, 1]
 */
export function backgroundColors(model, places, directions) {
  const { radiance } = getPreparedFields(model), { hidden, outputs, last } = radiance;
  const count = directions.length / 3, colors = new Float32Array(3 * count);
  const directional = new Float64Array(hidden.length);
  for (let first = 0; first < count; first += ROWS_PER_BATCH) {
    const rows = Math.min(ROWS_PER_BATCH, count - first);
    encodeDirections(radiance, directions, first, rows);
    runLayer(radiance.directional, radiance.encoded, radiance.directional.inputs, false, rows, directional);
    contractPositions(model, places, first, rows, radiance.places, radiance.radii);
    encodePositions(radiance, rows);
    runLayer(radiance.first, radiance.features, radiance.first.inputs, false, rows, hidden);
    for (let k = 0; k < rows * radiance.first.stride; k++) hidden[k] += directional[k];
    runLaterLayers(radiance, rows, outputs);
    for (let row = 0, at = 3 * first; row < rows; row++) {
      for (let c = 0; c < 3; c++) colors[at++] = sigmoid(outputs[row * last.stride + c]);
    }
  }
  return colors;
}

/**
 * Returns the logistic function 1 / (1 + e^-x).
 * @param {number} logit
 */
const sigmoid = (logit) => 1 / (1 + Math.exp(-logit));

// --- prepared fields -------------------------------------------------------------------------------------------------

/**
 * Returns the prepared fields of a model. The first call for a model prepares them.
 * @param {Model} model
 * @returns {Record<FieldName, PreparedField>}
 */
function getPreparedFields(model) {
  const prepared = preparedFields.get(model);
  if (prepared) return prepared;
  const fields = { geometry: prepareField(model, "geometry"), radiance: prepareField(model, "radiance") };
  preparedFields.set(model, fields);
  return fields;
}

/**
 * Arranges a field's decoder for `runLayer` and allocates its buffers.
 * @param {Model} model
 * @param {FieldName} name
 * @returns {PreparedField}
 */
function prepareField(model, name) {
  const { table, decoder } = model[name], [one, two, three] = decoderLayout(model.config, name);
  const levels = gridLevels(model.config[name]), features = 2 * levels.length;
  const first = packLayer(decoder, one, 0, features, true);
  const directional = packLayer(decoder, one, features, one.inputs, false);
  const middle = packLayer(decoder, two, 0, two.inputs, true), last = packLayer(decoder, three, 0, three.inputs, true);
  const allocate = (/** @type {number} */ width) => new Float64Array(width * ROWS_PER_BATCH);
  return {
    levels, table, first, directional, middle, last,
    encoding: model.config.direction_encoding,
    places: allocate(3), radii: allocate(1), features: allocate(features), encoded: allocate(directional.inputs),
    hidden: allocate(first.stride), hidden2: allocate(middle.stride), outputs: allocate(last.stride),
  };
}

/**
 * Copies columns `from` to `to` of a layer's matrix into groups: for each input, the weights of OUTPUTS_PER_GROUP
 * outputs are adjacent. The last group is padded with zeros.
 * @param {Float32Array} decoder the decoder's numbers
 * @param {import("./grids.js").DecoderLayer} layer
 * @param {number} from the index of the first column (input)
 * @param {number} to the index after the last column
 * @param {boolean} hasBiases whether the layer's biases are copied, too
 * @returns {Layer}
 */
function packLayer(decoder, { inputs, outputs, matrix, bias }, from, to, hasBiases) {
  const stride = OUTPUTS_PER_GROUP * Math.ceil(outputs / OUTPUTS_PER_GROUP), width = to - from;
  const weights = new Float64Array(stride * width), biases = new Float64Array(stride);
  for (let o = 0; o < outputs; o++) {
    const lane = o % OUTPUTS_PER_GROUP, group = o - lane;
    for (let i = 0; i < width; i++) {
      weights[group * width + i * OUTPUTS_PER_GROUP + lane] = decoder[matrix + o * inputs + from + i];
    }
    if (hasBiases) biases[o] = decoder[bias + o];
  }
  const index = new Int32Array(width), value = new Float64Array(width);
  return { inputs: width, width: outputs, stride, weights, biases, index, value };
}

// --- positions -------------------------------------------------------------------------------------------------------

/**
 * Maps local positions into the unit cube of the hash grids (the contraction of docs/reference/format.md 2.3).
 * @param {Model} model
 * @param {Float32Array} positions local units
 * @param {number} first the index of the first position to be mapped
 * @param {number} rows the number of positions to be mapped, at most ROWS_PER_BATCH
 * @param {Float64Array} places receives the contracted positions
 * @param {Float64Array} radii receives max(1, |u|) of each position u in units of the half extents
 */
function contractPositions(model, positions, first, rows, places, radii) {
  const [hx, hy, hz] = model.config.frame.half_extent;
  for (let row = 0, from = 3 * first, at = 0; row < rows; row++, from += 3, at += 3) {
    const x = positions[from] / hx, y = positions[from + 1] / hy, z = positions[from + 2] / hz;
    const radius = Math.sqrt(x * x + y * y + z * z);
    const growth = radius <= 1 ? 1 : radius; // a NaN radius stays NaN
    const factor = (0.25 * (2 - 1 / growth)) / growth;
    places[at] = factor * x + 0.5;
    places[at + 1] = factor * y + 0.5;
    places[at + 2] = factor * z + 0.5;
    radii[row] = growth;
  }
}

/**
 * Interpolates the hash features of `places`. The outer loop is over levels, so that a level's rows stay in the cache.
 * @param {PreparedField} field
 * @param {number} rows
 */
function encodePositions({ levels, table, places, features }, rows) {
  const featuresPerRow = 2 * levels.length;
  for (let level = 0; level < levels.length; level++) {
    const { resolution, rows: tableRows, first, dense } = levels[level];
    const span = resolution - 1, maxCell = resolution - 2, mask = tableRows - 1, start = 2 * first;
    for (let row = 0, from = 0, to = 2 * level; row < rows; row++, from += 3, to += featuresPerRow) {
      const vx = places[from] * span, vy = places[from + 1] * span, vz = places[from + 2] * span;
      const x = Math.min(vx | 0, maxCell), y = Math.min(vy | 0, maxCell), z = Math.min(vz | 0, maxCell); // NaN | 0 is 0
      let y0, y1, z0, z1, a, b, c, d, e, f, g, h; // a to h: the rows of the 8 corners; x varies fastest
      if (dense) {
        y0 = resolution * (y + resolution * z) + x;
        y1 = y0 + resolution;
        z0 = resolution * resolution;
        a = y0, b = y0 + 1, c = y1, d = y1 + 1, e = y0 + z0, f = e + 1, g = y1 + z0, h = g + 1;
      } else {
        y0 = Math.imul(y, HASH_FACTOR_Y), y1 = (y0 + HASH_FACTOR_Y) | 0;
        z0 = Math.imul(z, HASH_FACTOR_Z), z1 = (z0 + HASH_FACTOR_Z) | 0;
        const next = x + 1;
        a = (x ^ y0 ^ z0) & mask, b = (next ^ y0 ^ z0) & mask, c = (x ^ y1 ^ z0) & mask, d = (next ^ y1 ^ z0) & mask;
        e = (x ^ y0 ^ z1) & mask, f = (next ^ y0 ^ z1) & mask, g = (x ^ y1 ^ z1) & mask, h = (next ^ y1 ^ z1) & mask;
      }
      a = start + 2 * a, b = start + 2 * b, c = start + 2 * c, d = start + 2 * d;
      e = start + 2 * e, f = start + 2 * f, g = start + 2 * g, h = start + 2 * h;
      const px = vx - x, py = vy - y, pz = vz - z, qx = 1 - px, qy = 1 - py, qz = 1 - pz;
      const qq = qy * qz, pq = py * qz, qp = qy * pz, pp = py * pz;
      features[to] =
        qq * (qx * table[a] + px * table[b]) + pq * (qx * table[c] + px * table[d]) +
        qp * (qx * table[e] + px * table[f]) + pp * (qx * table[g] + px * table[h]);
      features[to + 1] =
        qq * (qx * table[a + 1] + px * table[b + 1]) + pq * (qx * table[c + 1] + px * table[d + 1]) +
        qp * (qx * table[e + 1] + px * table[f + 1]) + pp * (qx * table[g + 1] + px * table[h + 1]);
    }
  }
}

// --- directions ------------------------------------------------------------------------------------------------------

/**
 * Encodes `rows` directions, from the one with index `first` on, into the buffer `encoded`.
 * @param {PreparedField} field
 * @param {Float32Array} directions unit vectors
 * @param {number} first
 * @param {number} rows
 */
function encodeDirections({ encoding, encoded }, directions, first, rows) {
  const encode = encoding === "sh" ? encodeHarmonics : encodeFrequencies;
  for (let row = 0, from = 3 * first; row < rows; row++, from += 3) {
    encode(encoded, row, directions[from], directions[from + 1], directions[from + 2]);
  }
}

/**
 * Writes the real spherical harmonics of degree 0 to 2 of a direction as a row of `encoded`. The models' harmonics have
 * no Condon-Shortley phase, which half a turn about z cancels.
 * @param {Float64Array} encoded
 * @param {number} row
 * @param {number} x
 * @param {number} y
 * @param {number} z
 */
function encodeHarmonics(encoded, row, x, y, z) {
  evaluateBasis(2, -x, -y, z, encoded, 9 * row);
}

/**
 * Writes the sines and cosines of pi, 2 pi, 4 pi and 8 pi times x, y, z as a row of `encoded`. Higher octaves are
 * computed by the double-angle formulas.
 * @param {Float64Array} encoded
 * @param {number} row
 * @param {number} x
 * @param {number} y
 * @param {number} z
 */
function encodeFrequencies(encoded, row, x, y, z) {
  for (let axis = 0; axis < 3; axis++) {
    const phase = Math.PI * (axis === 0 ? x : axis === 1 ? y : z);
    let sine = Math.sin(phase), cosine = Math.cos(phase);
    for (let octave = 0, at = 24 * row + axis; octave < 4; octave++, at += 3) {
      encoded[at] = sine;
      encoded[at + 12] = cosine;
      const twice = 2 * sine;
      sine = twice * cosine;
      cosine = 1 - twice * (twice / 2);
    }
  }
}

// --- decoders --------------------------------------------------------------------------------------------------------

/**
 * Runs the second and third layer of a decoder on `field.hidden`, the first layer's outputs before their ReLU.
 * @param {PreparedField} field
 * @param {number} rows
 * @param {Float64Array} outputs
 */
function runLaterLayers(field, rows, outputs) {
  runLayer(field.middle, field.hidden, field.first.stride, true, rows, field.hidden2);
  runLayer(field.last, field.hidden2, field.middle.stride, true, rows, outputs);
}

/**
 * Runs one layer of a decoder, without the ReLU after it. Zero inputs are skipped, because a ReLU sets about half of
 * its outputs to zero.
 * @param {Layer} layer
 * @param {Float64Array} from the inputs
 * @param {number} inputStride the distance in `from` between the starts of two rows
 * @param {boolean} isRectified whether a ReLU is applied to the inputs
 * @param {number} rows
 * @param {Float64Array} to receives the outputs, `stride` numbers for each row
 */
function runLayer({ inputs, stride, weights, biases, index, value }, from, inputStride, isRectified, rows, to) {
  const groupSize = inputs * OUTPUTS_PER_GROUP;
  for (let row = 0; row < rows; row++) {
    let used = 0;
    for (let i = 0, at = row * inputStride; i < inputs; i++, at++) {
      const number = from[at];
      if (isRectified ? number <= 0 : number === 0) continue; // false for NaN, which is kept
      index[used] = i * OUTPUTS_PER_GROUP;
      value[used++] = number;
    }
    for (let first = 0, group = 0; first < stride; first += OUTPUTS_PER_GROUP) {
      const out = row * stride + first;
      let a = biases[first], b = biases[first + 1], c = biases[first + 2], d = biases[first + 3];
      let e = biases[first + 4], f = biases[first + 5], g = biases[first + 6], h = biases[first + 7];
      for (let k = 0; k < used; k++) {
        const at = group + index[k], number = value[k];
        a += number * weights[at];
        b += number * weights[at + 1];
        c += number * weights[at + 2];
        d += number * weights[at + 3];
        e += number * weights[at + 4];
        f += number * weights[at + 5];
        g += number * weights[at + 6];
        h += number * weights[at + 7];
      }
      to[out] = a;
      to[out + 1] = b;
      to[out + 2] = c;
      to[out + 3] = d;
      to[out + 4] = e;
      to[out + 5] = f;
      to[out + 6] = g;
      to[out + 7] = h;
      group += groupSize;
    }
  }
}
