// Evaluates the Gaussians of a further part of a streamed scene. They lie in rows of the textures of the whole scene,
// in its axes and units. Only the numbers that the fields are evaluated at are those of the part.

import { Fields } from "../fields.js";
import { quatOf } from "../../hyrf/rotation.js";

export class PartFields extends Fields {
  // `model` has the fields of the part, `place` is where it lies in the scene, and `whole` the StreamedFields.
  constructor(gl, model, place, whole) {
    const { width, height, count } = whole;
    super(gl, { ...model, width, height, count, background: false, balls: new Float32Array(0) });
    this.whole = whole;
    const { rows, shift, scale } = place;
    this.place = { rows: rows.flat(), quat: quatOf(rows), shift, scale };
  }

  // Uploads the fields, again after `freeTables`, and at first compiles programs, so that rows can be evaluated.
  async prepareFields(model) {
    const { graphics, radiance } = this;
    if (!this.isReady) await this.preparePrograms(model);
    this.geometry = await this.field(model.geometry);
    this.radiance = await this.field(model.radiance);
    graphics.free(radiance?.weights);
    await graphics.whenDone();
    this.checkMemory();
    this.isReady = true;
  }

  async preparePrograms(model) {
    const { gl, whole } = this;
    Fields.check(gl, model);
    for (const name of ["rows", "pending", "explicit", "logits", "pixelSizes", "places", "shapes", "colors"]) {
      this[name] = whole[name];
    }
    Object.assign(this, whole.createResiduals(model.residualDegree));
    this.createFeatures();
    this.programs = await whole.compileOnce(this.shaders({ MOVED: 1 }));
    this.createTargets();
  }

  // Shares the features of the scene if they have enough layers.
  createFeatures() {
    super.createFeatures();
    if (this.layers > this.whole.layers) return;
    this.graphics.free(this.features);
    this.features = this.whole.features;
  }

  use(name, field) {
    const { gl, graphics, place, explicit } = this, p = super.use(name, field);
    gl.uniformMatrix3fv(p.u_place_rows, true, place.rows);
    gl.uniformMatrix3fv(p.u_place_inverse, false, place.rows); // rows read as columns: the inverse
    gl.uniform4fv(p.u_place_quat, place.quat);
    gl.uniform3fv(p.u_place_shift, place.shift);
    gl.uniform1f(p.u_place_scale, place.scale);
    if (name === "features") graphics.bind(p, { u_explicit: explicit }, gl.TEXTURE_2D, 2);
    return p;
  }

  // Does nothing: more levels may arrive.
  freeInputs() {}
}
