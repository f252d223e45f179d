// Shows `.hyrf` files among the splats of Spark (@sparkjsdev/spark), sorted together with them. A worker evaluates the
// model's fields for the camera; the page's thread writes the results into the arrays of a SplatMesh.

import { Color, Quaternion, Vector3 } from "three";
import { ExtSplats, SplatMesh } from "@sparkjsdev/spark";
import { viewFromPlace } from "hyrf.js/places.js";
import { quatOf } from "hyrf.js/rotation.js";
import { FLOATS_PER_COLOR, FLOATS_PER_SHAPE, GAUSSIANS_PER_ROW } from "hyrf.js/view_evaluator.js";

import { RemoteObject } from "./remote-object.js";

const WORDS_PER_SPLAT = 4; // in each of Spark's two arrays
const LOW_PASS = 0.3; // px^2
const LEAST_ALPHA = 1 / 255;
const SAMPLING_VARIANCE = 0.4; // px^2 of the photos

/**
 * Returns the options with which a SparkRenderer draws a model most like `hyrfpack render`. They apply to all splats of
 * its scene.
 * @param {HyrfSplats} object
 */
export function sparkOptions({ model: { config } }) {
  return {
    accumExtSplats: true, // half floats instead of bytes
    sortRadial: false, // by depth
    maxStdDev: Math.sqrt(2 * Math.log(1 / LEAST_ALPHA)),
    ...(config.antialiased ? { blurAmount: LOW_PASS } : { preBlurAmount: LOW_PASS, blurAmount: 0 }),
  };
}

/** A file's model, drawn by the SparkRenderer of the scene. The exposure applies to each Gaussian by itself. */
export class HyrfSplats extends RemoteObject {
  /** @param {import("hyrf.js/remote.js").RemoteModel} model */
  constructor(model) {
    super(model);
    const count = GAUSSIANS_PER_ROW * model.rowCount, words = WORDS_PER_SPLAT * count;
    this.rows = Array.from({ length: model.rowCount }, () => ({ shapes: null, colors: null, gains: [1, 1, 1] }));
    this.latest = null; // the view of the latest frame
    this.splats = new ExtSplats({ extArrays: [new Uint32Array(words), new Uint32Array(words)], numSplats: count });
    this.mesh = new SplatMesh({ extSplats: this.splats });
    this.frame.add(this.mesh);
  }

  setView(...drawn) {
    const view = super.setView(...drawn);
    if (!view) return null;
    this.latest = view;
    this.exposeParts(view);
    return view;
  }

  // Sets the exposures of all parts for a view.
  exposeParts(view) {
    for (const part of this.model.parts) {
      const { eye, rows } = viewFromPlace(view, part.place), gains = this.gains(part, eye, rows[2]);
      for (let row = part.firstRow; row < part.firstRow + part.rowCount; row++) {
        if (gains.every((gain, k) => gain === this.rows[row].gains[k])) continue;
        this.rows[row].gains = gains;
        this.writeRow(row);
      }
    }
  }

  receiveOrder(order) {
    this.model.reuse(order); // Spark sorts by itself
  }

  receiveRow({ row, shapes, pixelSizes, colors }) {
    if (shapes) this.rows[row].shapes = splatShapes(shapes, pixelSizes);
    this.rows[row].colors = colors;
    this.writeRow(row);
    this.dispatchEvent({ type: "change" });
  }

  // Writes a row of Gaussians into Spark's arrays, as the latest view sees them.
  writeRow(row) {
    const { shapes, colors, gains } = this.rows[row], { antialiased } = this.model.config;
    if (!shapes) return;
    const color = new Color(), scales = new Vector3();
    shapes.forEach(({ center, axes, quaternion, pixelSize }, i) => {
      const [red, green, blue, opacity] = colors.subarray(FLOATS_PER_COLOR * i, FLOATS_PER_COLOR * (i + 1));
      const kept = keptSquares(axes, pixelSize, depthPerPixel(this.latest, center));
      scales.set(...axes.map((axis, k) => axis / Math.sqrt(kept[k])));
      // Of the two longest axes.
      const share = antialiased ? Math.sqrt((kept[0] * kept[1] * kept[2]) / Math.min(...kept)) : 1;
      color.setRGB(exposed(red, gains[0]), exposed(green, gains[1]), exposed(blue, gains[2])); // as displayed
      this.splats.setSplat(GAUSSIANS_PER_ROW * row + i, center, scales, quaternion, share * opacity, color);
    });
    for (const texture of this.splats.textures) texture.needsUpdate = true;
    this.mesh.updateVersion();
  }

  dispose() {
    super.dispose();
    this.mesh.dispose();
  }
}

// Returns the displayed value of a colour with a gain, where a value above 1 is white. A gain of 1 changes nothing.
function exposed(value, gain) {
  if (gain === 1) return value;
  const shown = Math.min(value, 1);
  return (gain * shown) / (1 + (gain - 1) * shown);
}

// Returns the length in local units that a pixel of a view covers at a place; 0 for places behind the camera.
function depthPerPixel({ rows, translation, fx, fy }, { x, y, z }) {
  return Math.max(0, rows[2][0] * x + rows[2][1] * y + rows[2][2] * z + translation[2]) / Math.max(fx, fy);
}

// Returns what is left of the squares of three axes in those that are drawn. A variance is added so that no detail is
// finer than the photos' pixels, unless the picture's own pixels are larger.
function keptSquares(axes, pixelSize, ownSize) {
  const added = Math.max(0, SAMPLING_VARIANCE * (pixelSize ** 2 - ownSize ** 2));
  return axes.map((axis) => (added ? Math.max(axis ** 2, 1e-30) / (Math.max(axis ** 2, 1e-30) + added) : 1));
}

// Returns places, lengths of axes and rotations of Gaussians, given their positions and their axes.
function splatShapes(shapes, pixelSizes) {
  return Array.from(pixelSizes, (pixelSize, i) => {
    const [center, ...vectors] = [0, 3, 6, 9].map((k) => {
      return Array.from(shapes.subarray(FLOATS_PER_SHAPE * i + k, FLOATS_PER_SHAPE * i + k + 3));
    });
    const axes = vectors.map((vector) => Math.hypot(...vector));
    const [a, b] = vectors.map((vector, k) => vector.map((value) => value / (axes[k] || 1)));
    const c = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const [w, ...vector] = quatOf([0, 1, 2].map((k) => [a[k], b[k], c[k]]));
    return { center: new Vector3(...center), axes, quaternion: new Quaternion(...vector, w), pixelSize };
  });
}
