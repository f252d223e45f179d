// Packs splats and models into the textures that the shaders read. Textures are TEXTURE_WIDTH wide.

import { estimateGaussians } from "./estimate.js";
import { decoderLayout, gridLevels } from "../hyrf/grids.js";
import { rowBalls } from "../hyrf/row_states.js";
import { SHAPE_RESIDUALS } from "../hyrf/residuals.js";
import { backgroundSpacing, pixelSizes } from "../hyrf/sampling.js";
import { TEXTURE_WIDTH } from "./constants.js";
import { backgroundPicture } from "./scene.js";

const COARSE_BACKGROUND_HEIGHT_PIXELS = 32;
const UNITS_PER_CELL = 8; // hidden units that the shaders process together
// Bits of float32 numbers.
const MIN_NORMAL_HALF_BITS = 0x38800000; // 2^-14
const HALF_EXPONENT_OFFSET = 0x38000000, HALF_ROUNDING = 0x1000;

const countRows = (count, width = TEXTURE_WIDTH) => Math.max(1, Math.ceil(count / width));

const unorm16 = (value) => Math.round(65535 * Math.min(1, Math.max(0, value)));
const snorm16 = (value) => Math.round(32767 * Math.min(1, Math.max(-1, value))) & 0xffff;
const pair16 = (low, high) => (low | (high << 16)) >>> 0;
const quantizeScale = (scale) => unorm16((Math.log(scale) + 22) / 44);
const quantizeColor = (color, levels) => Math.round((levels * (Math.min(2, Math.max(-1, color)) + 1)) / 3);

const float = new Float32Array(1), floatBits = new Uint32Array(float.buffer);

// Returns the bits of a number in [0, 1] as a half. Numbers below the smallest normal one become 0.
function encodeHalf(number) {
  float[0] = number;
  const bits = floatBits[0];
  return bits < MIN_NORMAL_HALF_BITS ? 0 : (bits - HALF_EXPONENT_OFFSET + HALF_ROUNDING) >>> 13;
}

// Packs positions, opacities, scales and rotations in 4 words each of `places` and `shapes` per splat. The last word of
// `shapes` is left 0.
function packShapes({ count, positions, scales, quats, opacities }) {
  const capacity = TEXTURE_WIDTH * countRows(count);
  const floats = new Uint32Array(positions.buffer, positions.byteOffset, 3 * count);
  const places = new Uint32Array(4 * capacity), shapes = new Uint32Array(4 * capacity);
  for (let i = 0, p = 0, q = 0; i < count; i++, p += 3, q += 4) {
    for (let k = 0; k < 3; k++) places[q + k] = floats[p + k];
    places[q + 3] = pair16(unorm16(opacities[i]), quantizeScale(scales[p + 2]));
    shapes[q] = pair16(snorm16(quats[q]), snorm16(quats[q + 1]));
    shapes[q + 1] = pair16(snorm16(quats[q + 2]), snorm16(quats[q + 3]));
    shapes[q + 2] = pair16(quantizeScale(scales[p]), quantizeScale(scales[p + 1]));
  }
  return { places, shapes };
}

// Packs splats (see viewer/formats): positions and shapes take 4 words per splat, harmonics 4 words per splat and
// layer.
export function packSplats(splats) {
  const { count, degree, antialiased, colors, harmonics, range } = splats, { places, shapes } = packShapes(splats);
  const height = countRows(count), capacity = TEXTURE_WIDTH * height;
  for (let i = 0, p = 0, q = 0; i < count; i++, p += 3, q += 4) {
    const red = quantizeColor(colors[p], 2047), green = quantizeColor(colors[p + 1], 2047);
    const blue = quantizeColor(colors[p + 2], 1023);
    shapes[q + 3] = red | (green << 11) | (blue << 22);
  }
  const higher = count ? harmonics.length / count : 0;
  const layered = new Uint8Array(16 * capacity * degree); // a layer has 16 bytes per splat
  for (let i = 0, at = 0; i < count; i++) {
    for (let b = 0; b < higher; b++) layered[16 * ((b >> 4) * capacity + i) + (b & 15)] = harmonics[at++];
  }
  return { count, height, degree, range, antialiased, places, shapes, harmonics: new Uint32Array(layered.buffer) };
}

// Packs an estimate of a model's Gaussians (see estimate.js) as geometry.frag and colors.frag pack the exact ones.
function packEstimate(model, eye, pixelSizes) {
  const { count, positions } = model, { colors, ...shapesOf } = estimateGaussians(model, eye);
  const { places, shapes } = packShapes({ count, positions, ...shapesOf }), packed = new Uint32Array(places.length / 2);
  const sizes = new Float32Array(shapes.buffer);
  for (let i = 0, p = 0; i < count; i++, p += 3) {
    packed[2 * i] = pair16(encodeHalf(colors[p]), encodeHalf(colors[p + 1]));
    packed[2 * i + 1] = encodeHalf(colors[p + 2]);
    sizes[4 * i + 3] = pixelSizes[i];
  }
  return { places, shapes, colors: packed };
}

// Packs a model that hyrf/reader.js has read for fields.js. `eye` is the first viewpoint in local units.
export function packModel(model, eye) {
  const { count } = model, gaussians = packGaussians(model, TEXTURE_WIDTH);
  const estimate = packEstimate(model, eye, gaussians.pixelSizes);
  return { count, height: countRows(count), ...packFields(model), ...gaussians, estimate };
}

// Packs the residuals of a model, if it has any.
function packResiduals({ count, shapeResiduals, colorResiduals }, width) {
  if (!shapeResiduals) return {};
  return {
    shapeResiduals: layerNumbers(shapeResiduals, count, SHAPE_RESIDUALS, width),
    colorResiduals: layerNumbers(colorResiduals, count, colorResiduals.length / Math.max(1, count), width),
  };
}

// Packs what the Gaussians of a model share.
export function packFields(model) {
  const { metadata, config } = model;
  const field = (which) => ({
    table: model[which].table,
    levels: gridLevels(config[which]).map((level) => [level.resolution, level.first, level.rows, Number(level.dense)]),
    decoder: packDecoder(model[which].decoder, decoderLayout(config, which)),
  });
  return {
    coarseBackground: backgroundPicture(model, COARSE_BACKGROUND_HEIGHT_PIXELS),
    backgroundSpacing: backgroundSpacing(metadata),
    geometry: field("geometry"),
    radiance: field("radiance"),
    cells: Math.ceil(config.hidden / UNITS_PER_CELL),
    sh: config.direction_encoding === "sh",
    halfExtent: config.frame.half_extent,
    product: config.scale_rule === "product",
    grows: config.scale_grows,
    antialiased: config.antialiased,
    background: config.background,
    finest: config.radiance.finest,
    residualDegree: config.residual_degree,
  };
}

// Packs the Gaussians of a model for textures that are `width` wide.
export function packGaussians(model, width) {
  const { metadata, count, positions, colorLogits, scaleLogits, opacityLogits } = model;
  const texels = width * countRows(count, width), sizes = new Float32Array(texels);
  const explicit = new Float32Array(4 * texels), logits = new Float32Array(4 * texels);
  sizes.set(pixelSizes(positions, metadata));
  for (let i = 0, p = 0, q = 0; i < count; i++, p += 3, q += 4) {
    for (let k = 0; k < 3; k++) {
      explicit[q + k] = positions[p + k];
      logits[q + k] = colorLogits[p + k];
    }
    explicit[q + 3] = opacityLogits[i];
    logits[q + 3] = scaleLogits[i];
  }
  const balls = rowBalls(positions, width);
  return { explicit, logits, pixelSizes: sizes, balls, ...packResiduals(model, width) };
}

// Arranges numbers, `columns` for each Gaussian, for a texture array that is `width` wide and has three of them in each
// layer.
function layerNumbers(numbers, count, columns, width) {
  const texels = width * countRows(count, width);
  const layered = new Float32Array(4 * texels * Math.ceil(columns / 3));
  for (let i = 0, at = 0; i < count; i++) {
    for (let k = 0; k < columns; k++) layered[4 * (texels * Math.floor(k / 3) + i) + (k % 3)] = numbers[at++];
  }
  return layered;
}

// Returns the positions of several parts (3 N each) as one array, in which each part begins a row of the textures.
// Numbers that belong to no Gaussian are NaN.
export function joinPositions(parts) {
  const heights = parts.map((positions) => countRows(positions.length / 3));
  const joined = new Float32Array(3 * TEXTURE_WIDTH * heights.reduce((sum, height) => sum + height, 0)).fill(NaN);
  let row = 0;
  parts.forEach((positions, number) => {
    joined.set(positions, 3 * TEXTURE_WIDTH * row);
    row += heights[number];
  });
  return joined;
}

// Packs a decoder's numbers in groups of four; hidden units are padded to whole cells. The order is: bias 1, the
// weights of each input, bias 2, matrix 2 (for each four outputs, the weights of each input), bias 3, matrix 3 like
// matrix 2. Returns {numbers, places: the offset of each part, in groups of four}.
function packDecoder(decoder, [first, second, last]) {
  const width = UNITS_PER_CELL * Math.ceil(first.outputs / UNITS_PER_CELL), ends = 4 * Math.ceil(last.outputs / 4);
  const places = { BIAS_1: 0, INPUTS: width / 4 };
  places.BIAS_2 = places.INPUTS + (first.inputs * width) / 4;
  places.MATRIX_2 = places.BIAS_2 + width / 4;
  places.BIAS_3 = places.MATRIX_2 + (width * width) / 4;
  places.MATRIX_3 = places.BIAS_3 + ends / 4;
  const WEIGHTS = places.MATRIX_3 + (ends * width) / 4, numbers = new Float32Array(4 * WEIGHTS);
  const bias = (layer, at) => numbers.set(decoder.subarray(layer.bias, layer.bias + layer.outputs), 4 * at);
  const weight = (layer, output, input) => decoder[layer.matrix + output * layer.inputs + input];
  bias(first, places.BIAS_1);
  bias(second, places.BIAS_2);
  bias(last, places.BIAS_3);
  for (let i = 0; i < first.inputs; i++) {
    for (let o = 0; o < first.outputs; o++) numbers[4 * places.INPUTS + i * width + o] = weight(first, o, i);
  }
  for (const [layer, at] of [[second, places.MATRIX_2], [last, places.MATRIX_3]]) {
    for (let o = 0; o < layer.outputs; o++) {
      const group = o - (o % 4);
      for (let i = 0; i < layer.inputs; i++) numbers[4 * at + group * width + 4 * i + (o % 4)] = weight(layer, o, i);
    }
  }
  return { numbers, places: { ...places, WEIGHTS } };
}
