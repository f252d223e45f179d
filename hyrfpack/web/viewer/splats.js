// Holds splats with harmonics on the graphics device, made from the arrays of pack.js.

import { Graphics } from "./graphics.js";
import { TEXTURE_WIDTH } from "./constants.js";

export class Splats {
  constructor(gl, splats) {
    const { count, height, degree, range, antialiased } = splats;
    this.graphics = new Graphics(gl);
    Object.assign(this, { splats, count, height, degree, range, antialiased });
  }

  // Uploads the splats.
  async prepare() {
    const { graphics, height, degree, splats: { places, shapes, harmonics } } = this, { gl } = graphics;
    const words = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, 4];
    this.places = await graphics.table(words, TEXTURE_WIDTH, places);
    this.shapes = await graphics.table(words, TEXTURE_WIDTH, shapes);
    const size = degree ? [TEXTURE_WIDTH, height, degree] : [1, 1, 1], layer = 4 * TEXTURE_WIDTH * height;
    this.harmonics = graphics.texture(gl.TEXTURE_2D_ARRAY, gl.RGBA32UI, ...size);
    for (let k = 0; k < degree; k++) {
      const numbers = harmonics.subarray(k * layer, (k + 1) * layer), layerSize = [TEXTURE_WIDTH, height, 1];
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.harmonics);
      gl.texSubImage3D(
        gl.TEXTURE_2D_ARRAY, 0, 0, 0, k, ...layerSize, gl.RGBA_INTEGER, gl.UNSIGNED_INT, numbers,
      );
      await graphics.whenDone();
    }
    this.splats = null; // frees memory
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
