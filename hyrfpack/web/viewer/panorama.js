// The background as a picture of all directions: coarse at once, then finer in tiles, those in view first.

import { dot } from "./camera.js";
import { sidesOf, touches } from "./frustum.js";
import { Pace } from "./graphics.js";
import { SPHERE_RADIUS } from "./layout.js";

const COARSE = 64, LEAST_ROWS = 256, MOST_ROWS = 1024; // encoded directions alone need the least
const TILE = [64, 32]; // texels
const QUICK = 5; // ms a tile: such a device makes also those that are not in view

export class Panorama {
  // `paint(framebuffer, size, part)` draws a part (x, y, width, height) of a picture. `finest`: of the hash grid. The
  // sphere is nearly as large as the grid's cube, pi / 2 cells from pole to pole for each: two pixels a cell will do.
  constructor(graphics, finest, paint) {
    Object.assign(this, { graphics, paint });
    this.pace = new Pace();
    this.height = Math.min(MOST_ROWS, Math.max(LEAST_ROWS, Math.ceil(Math.PI * finest)));
  }

  get size() {
    return [2 * this.height, this.height];
  }

  picture(height) {
    const { graphics } = this, { gl } = graphics;
    const texture = graphics.texture(gl.TEXTURE_2D, gl.RGBA8, 2 * height, height);
    graphics.smooth();
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
    return texture;
  }

  // The coarse picture, enlarged.
  async begin() {
    const { graphics, height } = this, { gl } = graphics, size = [2 * COARSE, COARSE];
    const small = this.picture(COARSE), target = graphics.framebuffer(small);
    const work = (first, last) => this.paint(target, size, [0, first, size[0], last - first]);
    await new Pace().run(graphics, COARSE, work);
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

  // The tiles to be made: their part of the picture, and the ball on the sphere that holds it.
  cut() {
    const { height } = this, tiles = [], [wide, high] = TILE, angle = Math.PI / height; // of a texel
    const radius = (SPHERE_RADIUS * angle * Math.hypot(wide, high)) / 2;
    for (let y = 0; y < height; y += high) {
      for (let x = 0; x < 2 * height; x += wide) {
        const longitude = angle * (x + wide / 2) - Math.PI, latitude = Math.PI / 2 - angle * (y + high / 2);
        const [across, ahead] = [Math.sin(longitude), Math.cos(longitude)].map((side) => side * Math.cos(latitude));
        const middle = [across, -Math.sin(latitude), ahead].map((side) => SPHERE_RADIUS * side);
        tiles.push({ part: [x, y, Math.min(wide, 2 * height - x), Math.min(high, height - y)], middle, radius });
      }
    }
    return tiles;
  }

  // Make all that a view shows, see Fields.complete; `done` is called when there is nothing more to make, ever.
  async complete(view, { goOn, changed, done }) {
    const sides = sidesOf(view, 0), ahead = ({ middle }) => dot(view.rows[2], middle);
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
    const seen = this.tiles.filter(({ middle, radius }) => touches(sides, ...middle, radius));
    if (!(await make(seen.sort((a, b) => ahead(b) - ahead(a))))) return false;
    if (this.pace.unit !== null && this.pace.unit < QUICK && !(await make(this.tiles))) return false;
    if (!this.tiles.length) done();
    return true;
  }
}
