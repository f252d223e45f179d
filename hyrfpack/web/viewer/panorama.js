// Draws the background as an equirectangular picture, which is shown while the view moves: first the worker's coarse
// one, then finer tiles, those in view first. A tile has the colours that an eye sees from one place. It is drawn again
// when the eye has moved far enough.

import { dot, sub } from "../hyrf/vectors.js";
import { frustumPlanes, intersectsFrustum } from "../hyrf/frustum.js";
import { WorkPacer } from "./graphics.js";
import { BACKGROUND_RADIUS } from "./constants.js";

// Pictures are twice as wide as high. The encoding of directions needs MIN_HEIGHT_TEXELS even with a coarse hash grid.
const MIN_HEIGHT_TEXELS = 256;
const MAX_HEIGHT_TEXELS = 1024;
const TILE_SIZE_TEXELS = [32, 32];
const MAX_EAGER_TILE_MS = 2.5; // devices that draw a tile in this time draw tiles out of view, too
const MAX_FRESH_TURN_RADIANS = 1e-2; // a larger turn of the rays to a tile makes its colours stale

export class Panorama {
  // `coarse` is the texture of a coarse picture. `paint(framebuffer, size, part, eye)` draws a part (x, y, width,
  // height) of a picture. `finest` is the finest resolution of the hash grid, and `halfExtent` the half-axes of its
  // frame. An arc from pole to pole crosses about pi / 2 times as many cells, more where a half-axis is short, and two
  // texels per cell are enough. Texels need not be finer than `backgroundSpacing`, the spacing in training.
  constructor(graphics, { finest, halfExtent, backgroundSpacing }, coarse, paint) {
    Object.assign(this, { graphics, paint, texture: coarse });
    this.pace = new WorkPacer();
    const finestHeight = Math.ceil(Math.PI * Math.min(finest / Math.min(...halfExtent), 1 / backgroundSpacing));
    this.height = Math.min(MAX_HEIGHT_TEXELS, Math.max(MIN_HEIGHT_TEXELS, finestHeight));
  }

  // Returns the time in ms that a texel takes, or NaN if it is not known yet.
  get texelMs() {
    return (this.pace.unit ?? NaN) / (TILE_SIZE_TEXELS[0] * TILE_SIZE_TEXELS[1]);
  }

  get size() {
    return [2 * this.height, this.height];
  }

  // Creates the texture of the whole picture, and fills it with the coarse one by the program `enlarge`.
  begin(enlarge) {
    const { graphics, texture: coarse } = this, { gl } = graphics;
    this.texture = graphics.texture(gl.TEXTURE_2D, gl.RGB10_A2, ...this.size);
    graphics.setPanoramic(this.texture);
    this.target = graphics.framebuffer(this.texture);
    gl.viewport(0, 0, ...this.size);
    gl.useProgram(enlarge.program);
    graphics.bind(enlarge, { u_picture: coarse });
    gl.uniform2f(enlarge.u_size, ...this.size);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    graphics.free(coarse);
    this.tiles = this.cut();
  }

  // Returns the tiles. Each has its part of the picture, a ball around that part of the sphere, and the `eye` from
  // which it was drawn, or null.
  cut() {
    const { height } = this, tiles = [], [tileWidth, tileHeight] = TILE_SIZE_TEXELS;
    const angle = Math.PI / height; // per texel
    const radius = (BACKGROUND_RADIUS * angle * Math.hypot(tileWidth, tileHeight)) / 2;
    for (let y = 0; y < height; y += tileHeight) {
      for (let x = 0; x < 2 * height; x += tileWidth) {
        const longitude = angle * (x + tileWidth / 2) - Math.PI, latitude = Math.PI / 2 - angle * (y + tileHeight / 2);
        const [across, ahead] = [Math.sin(longitude), Math.cos(longitude)].map((side) => side * Math.cos(latitude));
        const middle = [across, -Math.sin(latitude), ahead].map((side) => BACKGROUND_RADIUS * side);
        const part = [x, y, Math.min(tileWidth, 2 * height - x), Math.min(tileHeight, height - y)];
        tiles.push({ part, middle, radius, eye: null });
      }
    }
    return tiles;
  }

  // Returns the tiles in view that are stale for its eye, those without colours first and then those in the middle.
  stale(view) {
    const sides = frustumPlanes(view, 0), ahead = ({ middle }) => dot(view.rows[2], middle);
    return this.tiles
      .filter((tile) => isStale(tile, view.eye) && intersectsFrustum(sides, ...tile.middle, tile.radius))
      .sort((a, b) => Boolean(a.eye) - Boolean(b.eye) || ahead(b) - ahead(a));
  }

  // Draws tiles with the colours that an eye sees.
  draw(tiles, eye) {
    for (const tile of tiles) {
      this.paint(this.target, this.size, tile.part, eye);
      tile.eye = eye;
    }
  }

  // Draws, while the view moves, as many stale tiles as take about `ms`, or none.
  advance(view, ms) {
    if (this.pace.unit < ms) this.draw(this.stale(view).slice(0, this.pace.within(ms)), view.eye);
  }

  // Draws all stale tiles that a view shows while `goOn()` is true; fast devices then draw those out of view.
  async complete(view, goOn) {
    const make = (tiles) => {
      const work = (first, last) => this.draw(tiles.slice(first, last), view.eye);
      return this.pace.run(this.graphics, tiles.length, work, { goOn });
    };
    const whole = await make(this.stale(view));
    if (whole && this.pace.unit < MAX_EAGER_TILE_MS) await make(this.tiles.filter(({ eye }) => !eye));
  }
}

const isStale = ({ eye }, from) => !eye || Math.hypot(...sub(eye, from)) > MAX_FRESH_TURN_RADIANS * BACKGROUND_RADIUS;
