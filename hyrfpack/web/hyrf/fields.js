// The two fields of a model on the CPU, as docs/format.md has them (2.3, 2.4, 2.7): hash grids read by small decoders.
// Numbers come in and go out as float32; every sum between is of float64.

import { HASH_Y, HASH_Z, decoderLayout, gridLevels } from "./grids.js";

const FIELD_ROWS = 256; // places that go through a field together: what a level or a layer needs stays in the cache
const LAYER_LANES = 8; // outputs of a layer that are added up together

/**
 * A layer of a decoder as `runLayer` wants it: inputs, outputs, and these filled up to whole LAYER_LANES; room for
 * inputs that are not 0.
 * @typedef {{inputs: number, width: number, stride: number, weights: Float64Array, biases: Float64Array,
 *   index: Int32Array, value: Float64Array}} Layer
 *
 * A field made ready: `first` takes a place's features, `turned` a direction; and room for FIELD_ROWS of all between.
 * @typedef {{levels: import("./grids.js").GridLevel[], table: Float32Array, encoding: string,
 *   first: Layer, turned: Layer, middle: Layer, last: Layer,
 *   places: Float64Array, growths: Float64Array, features: Float64Array, seen: Float64Array,
 *   hidden: Float64Array, deeper: Float64Array, shapes: Float64Array}} ReadyField
 *
 * @typedef {import("./index.js").Model} Model
 * @typedef {import("./grids.js").FieldName} FieldName
 */

/**
 * Of each model its fields, made ready once.
 * @type {WeakMap<Model, Record<FieldName, ReadyField>>}
 */
const fieldsOf = new WeakMap();

/**
 * What of Gaussians `start` to `stop` does not depend on the view.
 * @param {Model} model
 * @param {number} start
 * @param {number} stop
 * @returns {{opacities: Float32Array, scales: Float32Array, quats: Float32Array}} n in [0, 1]; 3 n standard deviations,
 *   local units; 4 n, wxyz of unit length
 */
export function decodeGeometry(model, start, stop) {
  const { geometry } = readyFields(model), { scale_rule: rule, scale_grows: grows } = model.config;
  const { opacityLogits, scaleLogits } = model, { places, growths, shapes } = geometry;
  const opacities = new Float32Array(stop - start);
  const scales = new Float32Array(3 * (stop - start)), quats = new Float32Array(4 * (stop - start));
  for (let first = start; first < stop; first += FIELD_ROWS) {
    const rows = Math.min(FIELD_ROWS, stop - first);
    contractPlaces(model, model.positions, first, rows, places, growths);
    encodePlaces(geometry, rows);
    runLayer(geometry.first, geometry.features, geometry.first.inputs, false, rows, geometry.hidden);
    runRest(geometry, rows, shapes);
    for (let row = 0; row < rows; row++) {
      const i = first + row, at = i - start, raw = row * geometry.last.stride, largest = grows ? growths[row] : 1;
      opacities[at] = sigmoid(shapes[raw] + opacityLogits[i]);
      for (let axis = 0; axis < 3; axis++) {
        const neural = shapes[raw + 1 + axis], own = scaleLogits[i];
        const part = rule === "sum" ? sigmoid(neural + own) : sigmoid(neural) * sigmoid(own);
        scales[3 * at + axis] = largest * part;
      }
      const w = shapes[raw + 4] + 1, x = shapes[raw + 5], y = shapes[raw + 6], z = shapes[raw + 7];
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
 * Of the colour decoder's first layer what does not depend on the view, before its ReLU, for `colorsAlong`.
 * @param {Model} model
 * @param {number} start
 * @param {number} stop
 * @returns {Float32Array} `config.hidden` numbers for each Gaussian
 */
export function firstLayers(model, start, stop) {
  const { radiance } = readyFields(model), { width, stride } = radiance.first;
  const layers = new Float32Array((stop - start) * width);
  for (let first = start; first < stop; first += FIELD_ROWS) {
    const rows = Math.min(FIELD_ROWS, stop - first);
    contractPlaces(model, model.positions, first, rows, radiance.places, radiance.growths);
    encodePlaces(radiance, rows);
    runLayer(radiance.first, radiance.features, radiance.first.inputs, false, rows, radiance.hidden);
    for (let row = 0, at = (first - start) * width; row < rows; row++, at += width) {
      for (let k = 0; k < width; k++) layers[at + k] = radiance.hidden[row * stride + k];
    }
  }
  return layers;
}

/**
 * Colours of Gaussians `start` to `stop`.
 * @param {Model} model
 * @param {Float32Array} layers from `firstLayers`, of the same Gaussians
 * @param {number} start
 * @param {number} stop
 * @param {Float32Array} directions 3 n: along which each is seen, from the eye to it, unit length
 * @returns {Float32Array} 3 n in [0, 1]
 */
export function colorsAlong(model, layers, start, stop, directions) {
  const rows = Int32Array.from({ length: stop - start }, (_, row) => row);
  return colorsOfRows(model, layers, start, rows, directions, new Float32Array(3 * rows.length));
}

/**
 * The same of any of these Gaussians, each as often as it is named.
 * @param {Model} model
 * @param {Float32Array} layers from `firstLayers`
 * @param {number} start the first of the Gaussians that `layers` are of
 * @param {Int32Array} rows n: which of them, counted from there
 * @param {Float32Array} directions 3 n or more
 * @param {Float32Array} colors 3 n or more, to be written
 * @returns {Float32Array} `colors`
 */
export function colorsOfRows(model, layers, start, rows, directions, colors) {
  const { radiance } = readyFields(model), { colorLogits } = model;
  const { hidden, shapes, last, first: { width, stride } } = radiance;
  for (let first = 0; first < rows.length; first += FIELD_ROWS) {
    const count = Math.min(FIELD_ROWS, rows.length - first);
    encodeDirections(radiance, directions, first, count);
    runLayer(radiance.turned, radiance.seen, radiance.turned.inputs, false, count, hidden);
    for (let row = 0; row < count; row++) {
      for (let k = 0, at = rows[first + row] * width; k < width; k++) hidden[row * stride + k] += layers[at + k];
    }
    runRest(radiance, count, shapes);
    for (let row = 0, at = 3 * first; row < count; row++) {
      const own = 3 * (start + rows[first + row]);
      for (let c = 0; c < 3; c++) colors[at++] = sigmoid(shapes[row * last.stride + c] + colorLogits[own + c]);
    }
  }
  return colors;
}

/**
 * Colours of the background sphere.
 * @param {Model} model
 * @param {Float32Array} places 3 n: on the sphere, local units
 * @param {Float32Array} directions 3 n: along which they are seen, unit length
 * @returns {Float32Array} 3 n in [0, 1]
 */
export function backgroundColors(model, places, directions) {
  const { radiance } = readyFields(model), { hidden, shapes, last } = radiance;
  const count = directions.length / 3, colors = new Float32Array(3 * count), turned = new Float64Array(hidden.length);
  for (let first = 0; first < count; first += FIELD_ROWS) {
    const rows = Math.min(FIELD_ROWS, count - first);
    encodeDirections(radiance, directions, first, rows);
    runLayer(radiance.turned, radiance.seen, radiance.turned.inputs, false, rows, turned);
    contractPlaces(model, places, first, rows, radiance.places, radiance.growths);
    encodePlaces(radiance, rows);
    runLayer(radiance.first, radiance.features, radiance.first.inputs, false, rows, hidden);
    for (let k = 0; k < rows * radiance.first.stride; k++) hidden[k] += turned[k];
    runRest(radiance, rows, shapes);
    for (let row = 0, at = 3 * first; row < rows; row++) {
      for (let c = 0; c < 3; c++) colors[at++] = sigmoid(shapes[row * last.stride + c]);
    }
  }
  return colors;
}

/** @param {number} logit */
const sigmoid = (logit) => 1 / (1 + Math.exp(-logit));

// --- fields made ready -----------------------------------------------------------------------------------------------

/**
 * @param {Model} model
 * @returns {Record<FieldName, ReadyField>}
 */
function readyFields(model) {
  const made = fieldsOf.get(model);
  if (made) return made;
  const fields = { geometry: readyField(model, "geometry"), radiance: readyField(model, "radiance") };
  fieldsOf.set(model, fields);
  return fields;
}

/**
 * @param {Model} model
 * @param {FieldName} which
 * @returns {ReadyField}
 */
function readyField(model, which) {
  const { table, decoder } = model[which], [one, two, three] = decoderLayout(model.config, which);
  const levels = gridLevels(model.config[which]), features = 2 * levels.length;
  const first = packLayer(decoder, one, 0, features, true);
  const turned = packLayer(decoder, one, features, one.inputs, false);
  const middle = packLayer(decoder, two, 0, two.inputs, true), last = packLayer(decoder, three, 0, three.inputs, true);
  const room = (/** @type {number} */ width) => new Float64Array(width * FIELD_ROWS);
  return {
    levels, table, first, turned, middle, last,
    encoding: model.config.direction_encoding,
    places: room(3), growths: room(1), features: room(features), seen: room(turned.inputs),
    hidden: room(first.stride), deeper: room(middle.stride), shapes: room(last.stride),
  };
}

/**
 * Columns `from` to `to` of a layer's matrix: the weights of LAYER_LANES outputs side by side, input after input, and
 * zeros for outputs that fill up the last lanes. Without `biased` biases are zeros.
 * @param {Float32Array} decoder
 * @param {import("./grids.js").DecoderLayer} layer
 * @param {number} from
 * @param {number} to
 * @param {boolean} biased
 * @returns {Layer}
 */
function packLayer(decoder, { inputs, outputs, matrix, bias }, from, to, biased) {
  const stride = LAYER_LANES * Math.ceil(outputs / LAYER_LANES), width = to - from;
  const weights = new Float64Array(stride * width), biases = new Float64Array(stride);
  for (let o = 0; o < outputs; o++) {
    const lane = o % LAYER_LANES, group = o - lane;
    for (let i = 0; i < width; i++) {
      weights[group * width + i * LAYER_LANES + lane] = decoder[matrix + o * inputs + from + i];
    }
    if (biased) biases[o] = decoder[bias + o];
  }
  const index = new Int32Array(width), value = new Float64Array(width);
  return { inputs: width, width: outputs, stride, weights, biases, index, value };
}

// --- places ----------------------------------------------------------------------------------------------------------

/**
 * Local positions into the grids' unit cube, and how far out they lie: max(1, |u|).
 * @param {Model} model
 * @param {Float32Array} positions
 * @param {number} first
 * @param {number} rows
 * @param {Float64Array} places
 * @param {Float64Array} growths
 */
function contractPlaces(model, positions, first, rows, places, growths) {
  const [hx, hy, hz] = model.config.frame.half_extent;
  for (let row = 0, from = 3 * first, at = 0; row < rows; row++, from += 3, at += 3) {
    const x = positions[from] / hx, y = positions[from + 1] / hy, z = positions[from + 2] / hz;
    const radius = Math.sqrt(x * x + y * y + z * z);
    const growth = radius <= 1 ? 1 : radius; // so NaN goes on
    const factor = (0.25 * (2 - 1 / growth)) / growth;
    places[at] = factor * x + 0.5;
    places[at + 1] = factor * y + 0.5;
    places[at + 2] = factor * z + 0.5;
    growths[row] = growth;
  }
}

/**
 * Hash features of `places`, one level after the other, so that a level's rows stay in the cache.
 * @param {ReadyField} field
 * @param {number} rows
 */
function encodePlaces({ levels, table, places, features }, rows) {
  const wide = 2 * levels.length;
  for (let level = 0; level < levels.length; level++) {
    const { resolution, rows: tableRows, first, dense } = levels[level];
    const span = resolution - 1, most = resolution - 2, mask = tableRows - 1, start = 2 * first;
    for (let row = 0, from = 0, to = 2 * level; row < rows; row++, from += 3, to += wide) {
      const vx = places[from] * span, vy = places[from + 1] * span, vz = places[from + 2] * span;
      const x = Math.min(vx | 0, most), y = Math.min(vy | 0, most), z = Math.min(vz | 0, most); // NaN | 0 is 0
      let y0, y1, z0, z1, a, b, c, d, e, f, g, h; // corners: x, then y, then z
      if (dense) {
        y0 = resolution * (y + resolution * z) + x;
        y1 = y0 + resolution;
        z0 = resolution * resolution;
        a = y0, b = y0 + 1, c = y1, d = y1 + 1, e = y0 + z0, f = e + 1, g = y1 + z0, h = g + 1;
      } else {
        y0 = Math.imul(y, HASH_Y), y1 = (y0 + HASH_Y) | 0;
        z0 = Math.imul(z, HASH_Z), z1 = (z0 + HASH_Z) | 0;
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
 * @param {ReadyField} field
 * @param {Float32Array} directions
 * @param {number} first of them
 * @param {number} rows
 */
function encodeDirections({ encoding, seen }, directions, first, rows) {
  const encode = encoding === "sh" ? encodeHarmonics : encodeFrequencies;
  for (let row = 0, from = 3 * first; row < rows; row++, from += 3) {
    encode(seen, row, directions[from], directions[from + 1], directions[from + 2]);
  }
}

/**
 * @param {Float64Array} seen
 * @param {number} row
 * @param {number} x
 * @param {number} y
 * @param {number} z
 */
function encodeHarmonics(seen, row, x, y, z) {
  const at = 9 * row;
  seen[at] = 0.28209479177387814;
  seen[at + 1] = 0.4886025119029199 * y;
  seen[at + 2] = 0.4886025119029199 * z;
  seen[at + 3] = 0.4886025119029199 * x;
  seen[at + 4] = 1.0925484305920792 * x * y;
  seen[at + 5] = 1.0925484305920792 * y * z;
  seen[at + 6] = 0.31539156525252005 * (3 * z * z - 1);
  seen[at + 7] = 1.0925484305920792 * x * z;
  seen[at + 8] = 0.5462742152960396 * (x * x - y * y);
}

/**
 * Sines and cosines of pi, 2 pi, 4 pi and 8 pi times x, y, z: the higher ones by doubling.
 * @param {Float64Array} seen
 * @param {number} row
 * @param {number} x
 * @param {number} y
 * @param {number} z
 */
function encodeFrequencies(seen, row, x, y, z) {
  for (let axis = 0; axis < 3; axis++) {
    const phase = Math.PI * (axis === 0 ? x : axis === 1 ? y : z);
    let sine = Math.sin(phase), cosine = Math.cos(phase);
    for (let octave = 0, at = 24 * row + axis; octave < 4; octave++, at += 3) {
      seen[at] = sine;
      seen[at + 12] = cosine;
      const twice = 2 * sine;
      sine = twice * cosine;
      cosine = 1 - twice * (twice / 2);
    }
  }
}

// --- decoders --------------------------------------------------------------------------------------------------------

/**
 * The second and third layer, from `field.hidden` before its ReLU.
 * @param {ReadyField} field
 * @param {number} rows
 * @param {Float64Array} outputs
 */
function runRest(field, rows, outputs) {
  runLayer(field.middle, field.hidden, field.first.stride, true, rows, field.deeper);
  runLayer(field.last, field.deeper, field.middle.stride, true, rows, outputs);
}

/**
 * One layer of a decoder, without the ReLU after it. Inputs of 0 are left out: after a ReLU it is half of them.
 * @param {Layer} layer
 * @param {Float64Array} from inputs
 * @param {number} apart from one row of them to the next
 * @param {boolean} rectified whether they go through a ReLU
 * @param {number} rows
 * @param {Float64Array} to outputs
 */
function runLayer({ inputs, stride, weights, biases, index, value }, from, apart, rectified, rows, to) {
  const groupSize = inputs * LAYER_LANES;
  for (let row = 0; row < rows; row++) {
    let used = 0;
    for (let i = 0, at = row * apart; i < inputs; i++, at++) {
      const number = from[at];
      if (rectified ? number <= 0 : number === 0) continue; // NaN is neither
      index[used] = i * LAYER_LANES;
      value[used++] = number;
    }
    for (let first = 0, group = 0, out = row * stride; first < stride; first += LAYER_LANES, out += LAYER_LANES) {
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
