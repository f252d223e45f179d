// Evaluates the background exactly, at each pixel of a view at rest that shows it.

import { WorkPacer } from "./graphics.js";

const TILE_SIDE_PIXELS = 32;
// Tiles take very different times. In steps of this share of all tiles, consecutive slices of the work do not.
const TILE_STEP_RATIO = 0.618;

export class Sky {
  // `mask` is the program that marks the pixels that show the background. `paint(framebuffer, part, view, needed)`
  // draws a part (x, y, width, height) of the background of a view, at pixels where the texture `needed` is 1.
  constructor(graphics, mask, paint) {
    Object.assign(this, { graphics, mask, paint });
    this.pace = new WorkPacer();
    this.size = [0, 0];
    this.key = null; // describes the view
    this.tiles = []; // those that are missing
  }

  // Returns the texture of a view, or null if it is of another view.
  of(view) {
    return this.key === describeView(view) ? this.texture : null;
  }

  // Starts a view. For `blend` see Fields.complete.
  begin(view, blend) {
    if (this.of(view)) return;
    const { gl } = this.graphics, { width, height } = view, blended = blend(view);
    this.reserve(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.markNeeded(width, height, blended);
    this.view = view;
    this.key = describeView(view);
    this.tiles = cutTiles(width, height);
  }

  // Provides textures of this size.
  reserve(width, height) {
    const { graphics } = this, { gl } = graphics;
    if (width === this.size[0] && height === this.size[1]) return;
    for (const object of [this.target, this.texture, this.marked, this.needed]) graphics.free(object);
    this.size = [width, height];
    this.texture = graphics.texture(gl.TEXTURE_2D, gl.RGB10_A2, width, height);
    this.target = graphics.framebuffer(this.texture);
    this.needed = graphics.texture(gl.TEXTURE_2D, gl.R8, width, height);
    this.marked = graphics.framebuffer(this.needed);
  }

  // Marks the pixels that show the background.
  markNeeded(width, height, { texture, used }) {
    const { graphics, mask } = this, { gl } = graphics;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.marked);
    gl.viewport(0, 0, width, height);
    gl.useProgram(mask.program);
    graphics.bind(mask, { u_splats: texture });
    gl.uniform2f(mask.u_used, ...used);
    gl.uniform2f(mask.u_size, width, height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Draws the missing tiles; for the callbacks see Fields.complete.
  async complete({ goOn, changed }) {
    const { graphics, tiles, view, pace } = this;
    if (!tiles.length) return true;
    const whole = await pace.run(graphics, tiles.length, (first, last) => {
      for (const tile of tiles.slice(first, last)) this.paint(this.target, tile, view, this.needed);
    }, { goOn });
    if (whole) this.tiles = [];
    changed();
    return whole;
  }
}

// Returns a text that is the same for the same view only.
const describeView = ({ rows, eye, width, height, fx, fy, cx, cy }) =>
  [rows, eye, width, height, fx, fy, cx, cy].join();

// Returns the tiles (x, y, width, height) of a picture, so that neighbours are far apart in the list.
function cutTiles(width, height) {
  const tiles = [];
  for (let y = 0; y < height; y += TILE_SIDE_PIXELS) {
    for (let x = 0; x < width; x += TILE_SIDE_PIXELS) {
      tiles.push([x, y, Math.min(TILE_SIDE_PIXELS, width - x), Math.min(TILE_SIDE_PIXELS, height - y)]);
    }
  }
  let step = Math.max(1, Math.round(TILE_STEP_RATIO * tiles.length));
  while (greatestDivisor(step, tiles.length) > 1) step++;
  return tiles.map((_, k) => tiles[(k * step) % tiles.length]);
}

const greatestDivisor = (a, b) => (b ? greatestDivisor(b, a % b) : a);
