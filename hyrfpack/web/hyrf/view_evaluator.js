// Evaluates a model for one viewpoint after the other, row by row, so that what a view needs most comes first.

import { BACKGROUND_RADIUS, backgroundColors, colorsAlong, decodeGeometry, firstLayers } from "./fields.js";
import { CULL_MARGIN_RATIO, frustumPlanes } from "./frustum.js";
import { rotateBack, rowsOf } from "./rotation.js";
import { RowStates, rowBalls } from "./row_states.js";
import { backgroundSpacing, pixelSizes } from "./sampling.js";
import { mul } from "./vectors.js";

/** The number of Gaussians of a row, which are evaluated together. */
export const GAUSSIANS_PER_ROW = 2048;
/** The number of floats that describe the shape of a Gaussian: its position and three axes. */
export const FLOATS_PER_SHAPE = 12;
export const FLOATS_PER_COLOR = 4;

const MAX_FRESH_TURN_RADIANS = 2e-3; // a larger turn of its viewing direction makes a row's colours stale
const MIN_SKY_HEIGHT_PIXELS = 256; // directions are encoded finely, even if the hash grid is coarse
const MAX_SKY_HEIGHT_PIXELS = 1024;
const COARSE_SKY_HEIGHT_PIXELS = 64;
const TILE_WIDTH_PIXELS = 64, TILE_HEIGHT_PIXELS = 32;

/**
 * @typedef {import("./reader.js").Model} Model
 * @typedef {import("./frustum.js").View} View
 *
 * A row of Gaussians, of which the first has the index GAUSSIANS_PER_ROW times `row`. `shapes` has FLOATS_PER_SHAPE
 * numbers for each: its position, and its three axes, each with the length of the standard deviation, in local units.
 * `pixelSizes` has the pixel size of the photos at each, in local units, or 0 (see sampling.js). Both are null if they
 * were delivered before. `colors` has red, green, blue and opacity of each, in [0, 1]; colours with residuals may
 * exceed 1.
 * @typedef {{row: number, shapes: Float32Array | null, pixelSizes: Float32Array | null, colors: Float32Array}}
 *   EvaluatedRow
 *
 * A part of the equirectangular picture of the background: its place and its RGBA bytes. Column c of a picture with
 * height h is at the longitude (c + 0.5) pi / h - pi, row r at the latitude pi / 2 - (r + 0.5) pi / h. Longitudes run
 * from +z to +x, latitudes to -y, in local axes. `isCoarse` is true for the small picture, which comes first.
 * @typedef {{isCoarse: boolean, x: number, y: number, width: number, height: number, pixels: Uint8Array}} SkyTile
 *
 * The size of the background's picture and of its coarse version.
 * @typedef {{width: number, height: number, coarseWidth: number, coarseHeight: number}} SkySize
 */

/**
 * Returns the size of the background's picture, or null if the model has no background.
 * @param {import("./metadata.js").Metadata} metadata
 * @returns {SkySize | null}
 */
export function skySize(metadata) {
  const { background, radiance } = metadata.config;
  if (!background) return null;
  // Along an arc, two pixels per cell of the grid are enough, and pixels need not be finer than nodes in training.
  const fine = Math.ceil(Math.PI * Math.min(radiance.finest, 1 / backgroundSpacing(metadata)));
  const height = Math.min(MAX_SKY_HEIGHT_PIXELS, Math.max(MIN_SKY_HEIGHT_PIXELS, fine));
  const coarseHeight = COARSE_SKY_HEIGHT_PIXELS;
  return { width: 2 * height, height, coarseWidth: 2 * coarseHeight, coarseHeight };
}

/** A model, and which of its rows and of the tiles of its background were evaluated from which viewpoint. */
export class ViewEvaluator {
  /**
   * @param {Model} model
   * @param {boolean} [withSky] whether its background is evaluated, if it has one
   */
  constructor(model, withSky = true) {
    this.model = model;
    this.rows = new RowStates(model.count ? rowBalls(model.positions, GAUSSIANS_PER_ROW) : new Float32Array(0));
    this.pixelSizes = pixelSizes(model.positions, model.metadata);
    this.opacities = new Float32Array(model.count);
    /** @type {(Float32Array | null)[]} */
    this.firstLayers = Array.from({ length: this.rows.count }, () => null); // by row, once they are needed
    this.sky = withSky ? skySize(model.metadata) : null;
    this.tiles = this.sky ? cutTiles(this.sky.width, this.sky.height, false) : [];
    this.tileStates = new RowStates(Float32Array.from(this.tiles.flatMap(({ ball }) => ball)));
    this.hasCoarseSky = !this.sky;
  }

  /**
   * Evaluates, one at a time, what a view needs: first what is in view and was never evaluated, then what has changed
   * most, and in the end everything at this very viewpoint. Rows out of view come last, after `onComplete` was called.
   * @param {View} view in local units
   * @param {() => void} onComplete called when everything in view is evaluated at the viewpoint
   * @returns {Generator<EvaluatedRow | SkyTile, void>}
   */
  *evaluate(view, onComplete) {
    const sides = frustumPlanes(view, CULL_MARGIN_RATIO), skySides = frustumPlanes(view, 0);
    const eye = mul(rotateBack(view.rows, view.translation), -1);
    if (!this.hasCoarseSky) {
      this.hasCoarseSky = true;
      yield this.skyTile(cutTiles(2 * COARSE_SKY_HEIGHT_PIXELS, COARSE_SKY_HEIGHT_PIXELS, true)[0], eye);
    }
    for (const turn of [MAX_FRESH_TURN_RADIANS, 0]) {
      for (const row of this.rows.stale(sides, eye, turn).rows) yield this.row(row, eye);
      for (const tile of this.tileStates.stale(skySides, eye, turn).rows) {
        this.tileStates.colored(tile, eye);
        yield this.skyTile(this.tiles[tile], eye);
      }
    }
    onComplete();
    for (const row of this.rows.fresh()) yield this.row(row, eye);
    for (const tile of this.tileStates.fresh()) {
      this.tileStates.colored(tile, eye);
      yield this.skyTile(this.tiles[tile], eye);
    }
  }

  /**
   * Evaluates a row of Gaussians.
   * @param {number} row
   * @param {number[]} eye
   * @returns {EvaluatedRow}
   */
  row(row, eye) {
    const { model, opacities } = this, { positions } = model;
    const start = row * GAUSSIANS_PER_ROW, stop = Math.min(model.count, start + GAUSSIANS_PER_ROW);
    let layers = this.firstLayers[row], shapes = null, sizes = null;
    if (!layers) {
      const geometry = decodeGeometry(model, start, stop);
      opacities.set(geometry.opacities, start);
      shapes = packShapes(positions.subarray(3 * start, 3 * stop), geometry);
      sizes = this.pixelSizes.slice(start, stop);
      layers = this.firstLayers[row] = firstLayers(model, start, stop);
    }
    const directions = unitDirections(positions.subarray(3 * start, 3 * stop), eye);
    const evaluated = colorsAlong(model, layers, start, stop, directions);
    const colors = new Float32Array(FLOATS_PER_COLOR * (stop - start));
    for (let i = 0, from = 0, to = 0; i < stop - start; i++) {
      colors[to++] = evaluated[from++];
      colors[to++] = evaluated[from++];
      colors[to++] = evaluated[from++];
      colors[to++] = opacities[start + i];
    }
    this.rows.colored(row, eye);
    return { row, shapes, pixelSizes: sizes, colors };
  }

  /**
   * Evaluates a part of the background.
   * @param {Tile} tile
   * @param {number[]} eye
   * @returns {SkyTile}
   */
  skyTile({ isCoarse, x, y, width, height, pictureHeight }, eye) {
    const places = new Float32Array(3 * width * height);
    for (let row = 0, at = 0; row < height; row++) {
      for (let column = 0; column < width; column++, at += 3) {
        places.set(pointOnSphere(x + column + 0.5, y + row + 0.5, pictureHeight), at);
      }
    }
    const colors = backgroundColors(this.model, places, unitDirections(places, eye));
    const pixels = new Uint8Array(4 * width * height).fill(255);
    for (let i = 0, from = 0; i < width * height; i++) {
      for (let channel = 0; channel < 3; channel++) pixels[4 * i + channel] = Math.round(255 * colors[from++]);
    }
    return { isCoarse, x, y, width, height, pixels };
  }
}

/**
 * Returns the unit vectors from the eye to places. A place at the eye has the direction 0.
 * @param {Float32Array} places
 * @param {number[]} eye
 */
function unitDirections(places, [eyeX, eyeY, eyeZ]) {
  const directions = new Float32Array(places.length);
  for (let i = 0; i < places.length; i += 3) {
    const x = places[i] - eyeX, y = places[i + 1] - eyeY, z = places[i + 2] - eyeZ;
    const inverse = 1 / Math.max(Math.sqrt(x * x + y * y + z * z), 1e-12);
    directions[i] = x * inverse;
    directions[i + 1] = y * inverse;
    directions[i + 2] = z * inverse;
  }
  return directions;
}

/**
 * Packs positions and axes, see EvaluatedRow.
 * @param {Float32Array} positions
 * @param {{scales: Float32Array, quats: Float32Array}} geometry
 */
function packShapes(positions, { scales, quats }) {
  const count = positions.length / 3, shapes = new Float32Array(FLOATS_PER_SHAPE * count);
  for (let i = 0, p = 0, q = 0, at = 0; i < count; i++, p += 3, q += 4, at += FLOATS_PER_SHAPE) {
    const rows = rowsOf(quats.subarray(q, q + 4));
    for (let k = 0; k < 3; k++) {
      shapes[at + k] = positions[p + k];
      for (let axis = 0; axis < 3; axis++) shapes[at + 3 + 3 * axis + k] = scales[p + axis] * rows[k][axis];
    }
  }
  return shapes;
}

/**
 * A part of a picture of the background, with a ball around its part of the sphere.
 * @typedef {{isCoarse: boolean, x: number, y: number, width: number, height: number, pictureHeight: number,
 *   ball: number[]}} Tile
 */

/**
 * Cuts a picture into tiles, or makes one of the whole picture.
 * @param {number} width
 * @param {number} height
 * @param {boolean} isCoarse
 * @returns {Tile[]}
 */
function cutTiles(width, height, isCoarse) {
  const [tileWidth, tileHeight] = isCoarse ? [width, height] : [TILE_WIDTH_PIXELS, TILE_HEIGHT_PIXELS];
  const radius = (BACKGROUND_RADIUS * (Math.PI / height) * Math.hypot(tileWidth, tileHeight)) / 2, tiles = [];
  for (let y = 0; y < height; y += tileHeight) {
    for (let x = 0; x < width; x += tileWidth) {
      const size = { width: Math.min(tileWidth, width - x), height: Math.min(tileHeight, height - y) };
      const ball = [...pointOnSphere(x + tileWidth / 2, y + tileHeight / 2, height), radius];
      tiles.push({ isCoarse, x, y, ...size, pictureHeight: height, ball });
    }
  }
  return tiles;
}

/**
 * Returns the point of the background sphere at a place of an equirectangular picture.
 * @param {number} x in pixels
 * @param {number} y in pixels
 * @param {number} height of the picture, in pixels
 */
function pointOnSphere(x, y, height) {
  const longitude = (Math.PI * x) / height - Math.PI, latitude = Math.PI / 2 - (Math.PI * y) / height;
  const level = BACKGROUND_RADIUS * Math.cos(latitude);
  return [level * Math.sin(longitude), -BACKGROUND_RADIUS * Math.sin(latitude), level * Math.cos(longitude)];
}
