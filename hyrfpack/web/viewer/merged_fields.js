// Evaluates the models of a merged file, each in its own axes and units. They are drawn in one order of depth.

import { Fields } from "./fields.js";
import { Graphics } from "./graphics.js";
import { viewFromPlace } from "../hyrf/places.js";

export class MergedFields {
  // `models` are packed by pack.js; the first is the scene, which alone has a background. Each has its `place`.
  constructor(gl, models) {
    this.graphics = new Graphics(gl);
    this.height = 0; // rows of Gaussians
    this.parts = models.map((model) => {
      const part = { fields: new Fields(gl, model), place: model.place, firstRow: this.height };
      this.height += model.height;
      return part;
    });
  }

  get hasEstimate() {
    return true;
  }

  get isReady() {
    return this.parts.every(({ fields }) => fields.isReady);
  }

  get panorama() {
    return this.parts[0].fields.panorama;
  }

  get sky() {
    return this.parts[0].fields.sky;
  }

  // For these methods see Fields.

  async prepare() {
    for (const { fields } of this.parts) await fields.prepare();
  }

  async prepareFields() {
    for (const { fields } of this.parts) await fields.prepareFields();
  }

  recolor(view, margin, ms, follows) {
    for (const { fields, place } of this.parts) {
      fields.recolor(viewFromPlace(view, place), margin, ms / this.parts.length, follows);
    }
  }

  async coloured(view, margin, { report = () => {}, ...options }) {
    let rows = 0, done = true;
    for (const [number, { fields, place }] of this.parts.entries()) {
      const reportPart = (fraction) => report((number + fraction) / this.parts.length);
      const result = await fields.coloured(viewFromPlace(view, place), margin, { ...options, report: reportPart });
      rows += result.rows;
      done &&= result.done;
    }
    return { rows, done };
  }

  // The scene is the last part, because its background needs the picture of all.
  async complete(view, margin, options) {
    for (const { fields, place } of [...this.parts].reverse()) {
      if (!(await fields.complete(viewFromPlace(view, place), margin, options))) return false;
    }
    return true;
  }

  async lookAhead(view, goOn) {
    for (const { fields, place } of this.parts) await fields.lookAhead(viewFromPlace(view, place), goOn);
  }

  dispose() {
    for (const { fields } of this.parts) fields.dispose();
    this.graphics.dispose();
  }
}
