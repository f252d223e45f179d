// Holds splats with harmonics on the graphics device, made from the arrays of pack.js.

import { Graphics } from "./graphics.js";
import { TEXTURE_WIDTH } from "./constants.js";

export class Splats {
  constructor(gl, { count, height, degree, range, antialiased, places, shapes, harmonics }) {
    const graphics = new Graphics(gl), words = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, 4];
    Object.assign(this, { graphics, count, height, degree, range, antialiased });
    this.places = graphics.table(words, TEXTURE_WIDTH, places);
    this.shapes = graphics.table(words, TEXTURE_WIDTH, shapes);
    const size = degree ? [TEXTURE_WIDTH, height, degree] : [1, 1, 1];
    this.harmonics = graphics.texture(gl.TEXTURE_2D_ARRAY, gl.RGBA32UI, ...size);
    if (degree) gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, 0, ...size, gl.RGBA_INTEGER, gl.UNSIGNED_INT, harmonics);
  }

  // Does nothing: unlike Fields, splats do not change with the view.
  recolor() {}

  async complete() {
    return true;
  }

  async lookAhead() {}

  dispose() {
    this.graphics.dispose();
  }
}
