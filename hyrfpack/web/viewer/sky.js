// Evaluates the background of a view at rest, at the nodes of a grid between which pixels are interpolated. The nodes
// are the centres of the pixels 0, s, 2 s, ... of both axes, up to the first at or past the edge. See
// docs/reference/format.md 2.10.

import { backgroundStride } from "../hyrf/sampling.js";
import { WorkPacer } from "./graphics.js";

const TILE_SIDE_NODES = 32;
// Tiles take very different times. In steps of this share of all tiles, consecutive slices of the work do not.
const TILE_STEP_RATIO = 0.618;

export class Sky {
  // `mask` is the program that marks the nodes that a view needs. `spacing` is that of training, see hyrf/sampling.js.
  // `paint(framebuffer, size, part, view, needed, stride)` draws a part (x, y, width, height) of a grid of `size`
  // nodes, where the texture `needed` is 1.
  constructor(graphics, mask, spacing, paint) {
    Object.assign(this, { graphics, mask, spacing, paint });
    this.pace = new WorkPacer();
    this.size = [0, 0]; // of the grid
    this.stride = 1; // pixels between its nodes
    this.key = null; // describes the view
    this.tiles = []; // those that are missing
  }

  // Returns the {texture, stride} of the grid of a view, or null if the grid is of another view.
  of(view) {
    const { texture, stride } = this;
    return this.key === describeView(view) ? { texture, stride } : null;
  }

  // Starts a view. For `blend` see Fields.complete.
  begin(view, blend) {
    if (this.of(view)) return;
    const blended = blend(view), [stride, ...size] = this.grid(view);
    this.stride = stride;
    this.reserve(...size);
    this.clearNodes();
    this.markNeeded(view, blended);
    this.view = view;
    this.key = describeView(view);
    this.tiles = cutTiles(...this.size);
  }

  // Returns the stride, the width and the height of the grid of a view.
  grid(view) {
    const stride = backgroundStride(this.spacing, view);
    return [stride, ...[view.width, view.height].map((side) => Math.ceil((side - 1) / stride) + 1)];
  }

  // Evaluates all nodes of a moving view, at once, if that takes at most `ms` at `nodeMs` a node. Returns whether it
  // did.
  follow(view, nodeMs, ms) {
    const [stride, ...size] = this.grid(view);
    if (!(size[0] * size[1] * nodeMs <= ms)) return false;
    this.stride = stride;
    this.reserve(...size);
    this.markAll();
    this.paint(this.target, size, [0, 0, ...size], view, this.needed, stride);
    this.key = describeView(view);
    this.tiles = [];
    return true;
  }

  // Provides textures of this number of nodes.
  reserve(width, height) {
    const { graphics } = this, { gl } = graphics;
    if (width === this.size[0] && height === this.size[1]) return;
    for (const object of [this.target, this.texture, this.marked, this.needed]) graphics.free(object);
    this.size = [width, height];
    this.texture = graphics.texture(gl.TEXTURE_2D, gl.RGB10_A2, width, height);
    graphics.setLinear();
    this.target = graphics.framebuffer(this.texture);
    this.needed = graphics.texture(gl.TEXTURE_2D, gl.R8, width, height);
    this.marked = graphics.framebuffer(this.needed);
  }

  // Clears the colours of all nodes.
  clearNodes() {
    this.clear(this.target, 0);
  }

  // Sets all components of a target to a value.
  clear(target, value) {
    const { gl } = this.graphics;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.clearColor(value, value, value, value);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  // Marks all nodes as needed.
  markAll() {
    this.clear(this.marked, 1);
  }

  // Marks the nodes from which a pixel that shows the background is interpolated. `splats` is the view's picture of
  // blended splats.
  markNeeded({ width, height }, splats) {
    const { graphics, mask } = this, { gl } = graphics;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.marked);
    gl.viewport(0, 0, ...this.size);
    gl.useProgram(mask.program);
    graphics.bind(mask, { u_splats: splats });
    gl.uniform2i(mask.u_last, width - 1, height - 1);
    gl.uniform1i(mask.u_stride, this.stride);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Draws the missing tiles; for the callbacks see Fields.complete.
  async complete({ goOn, changed }) {
    const { graphics, tiles, view, pace, size, stride } = this;
    if (!tiles.length) return true;
    const isComplete = await pace.run(graphics, tiles.length, (first, last) => {
      for (const tile of tiles.slice(first, last)) this.paint(this.target, size, tile, view, this.needed, stride);
    }, { goOn });
    if (isComplete) this.tiles = [];
    changed();
    return isComplete;
  }
}

// Returns a text that is the same for the same view only.
const describeView = ({ rows, eye, width, height, fx, fy, cx, cy }) =>
  [rows, eye, width, height, fx, fy, cx, cy].join();

// Returns the tiles (x, y, width, height) of a grid, so that neighbours are far apart in the list.
function cutTiles(width, height) {
  const tiles = [];
  for (let y = 0; y < height; y += TILE_SIDE_NODES) {
    for (let x = 0; x < width; x += TILE_SIDE_NODES) {
      tiles.push([x, y, Math.min(TILE_SIDE_NODES, width - x), Math.min(TILE_SIDE_NODES, height - y)]);
    }
  }
  let step = Math.max(1, Math.round(TILE_STEP_RATIO * tiles.length));
  while (greatestDivisor(step, tiles.length) > 1) step++;
  return tiles.map((_, k) => tiles[(k * step) % tiles.length]);
}

// Returns the greatest common divisor (Euclid's algorithm).
const greatestDivisor = (a, b) => (b ? greatestDivisor(b, a % b) : a);
