// Draws the background as an equirectangular picture: first a coarse one, then finer tiles, those in view first.

import { dot } from "../hyrf/vectors.js";
import { frustumPlanes, intersectsFrustum } from "../hyrf/frustum.js";
import { WorkPacer } from "./graphics.js";
import { BACKGROUND_RADIUS } from "./constants.js";

// Pictures are twice as wide as high. The encoding of directions needs MIN_HEIGHT_TEXELS even with a coarse hash grid.
const COARSE_HEIGHT_TEXELS = 64;
const MIN_HEIGHT_TEXELS = 256;
const MAX_HEIGHT_TEXELS = 1024;
const TILE_SIZE_TEXELS = [64, 32];
const MAX_EAGER_TILE_MS = 5; // devices that draw a tile in this time draw tiles out of view, too

export class Panorama {
  // `paint(framebuffer, size, part)` draws a part (x, y, width, height) of a picture. `finest` is the finest resolution
  // of the hash grid. An arc from pole to pole crosses about pi / 2 times as many cells, and two texels per cell are
  // enough.
  constructor(graphics, finest, paint) {
    Object.assign(this, { graphics, paint });
    this.pace = new WorkPacer();
    this.height = Math.min(MAX_HEIGHT_TEXELS, Math.max(MIN_HEIGHT_TEXELS, Math.ceil(Math.PI * finest)));
  }

  get size() {
    return [2 * this.height, this.height];
  }

  // Creates the texture of a picture.
  picture(height) {
    const { graphics } = this, { gl } = graphics;
    const texture = graphics.texture(gl.TEXTURE_2D, gl.RGBA8, 2 * height, height);
    graphics.setLinear();
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
    return texture;
  }

  // Draws the coarse picture and enlarges it.
  async begin() {
    const { graphics, height } = this, { gl } = graphics, size = [2 * COARSE_HEIGHT_TEXELS, COARSE_HEIGHT_TEXELS];
    const small = this.picture(COARSE_HEIGHT_TEXELS), target = graphics.framebuffer(small);
    const work = (first, last) => this.paint(target, size, [0, first, size[0], last - first]);
    await new WorkPacer().run(graphics, COARSE_HEIGHT_TEXELS, work);
    this.texture = this.picture(height);
    this.target = graphics.framebuffer(this.texture);
    const enlarge = graphics.program("whole.vert", "enlarge.frag");
    gl.viewport(0, 0, ...this.size);
    gl.useProgram(enlarge.program);
    graphics.bind(enlarge, { u_picture: small });
    gl.uniform2f(enlarge.u_size, ...this.size);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    for (const object of [enlarge.program, target, small]) graphics.free(object);
    this.tiles = this.cut();
  }

  // Returns the tiles. Each has its part of the picture, and a ball around that part of the sphere.
  cut() {
    const { height } = this, tiles = [], [wide, high] = TILE_SIZE_TEXELS, angle = Math.PI / height; // per texel
    const radius = (BACKGROUND_RADIUS * angle * Math.hypot(wide, high)) / 2;
    for (let y = 0; y < height; y += high) {
      for (let x = 0; x < 2 * height; x += wide) {
        const longitude = angle * (x + wide / 2) - Math.PI, latitude = Math.PI / 2 - angle * (y + high / 2);
        const [across, ahead] = [Math.sin(longitude), Math.cos(longitude)].map((side) => side * Math.cos(latitude));
        const middle = [across, -Math.sin(latitude), ahead].map((side) => BACKGROUND_RADIUS * side);
        tiles.push({ part: [x, y, Math.min(wide, 2 * height - x), Math.min(high, height - y)], middle, radius });
      }
    }
    return tiles;
  }

  // Draws all tiles that a view shows; for the callbacks see Fields.complete. `done` is called when all tiles are
  // drawn.
  async complete(view, { goOn, changed, done }) {
    const sides = frustumPlanes(view, 0), ahead = ({ middle }) => dot(view.rows[2], middle);
    const make = async (tiles) => {
      const left = new Set(this.tiles);
      const whole = await this.pace.run(this.graphics, tiles.length, (first, last) => {
        for (const tile of tiles.slice(first, last)) {
          this.paint(this.target, this.size, tile.part);
          left.delete(tile);
        }
      }, { goOn });
      if (left.size < this.tiles.length) changed();
      this.tiles = [...left];
      return whole;
    };
    if (!this.tiles.length) return true;
    const seen = this.tiles.filter(({ middle, radius }) => intersectsFrustum(sides, ...middle, radius));
    if (!(await make(seen.sort((a, b) => ahead(b) - ahead(a))))) return false;
    if (this.pace.unit !== null && this.pace.unit < MAX_EAGER_TILE_MS && !(await make(this.tiles))) return false;
    if (!this.tiles.length) done();
    return true;
  }
}
