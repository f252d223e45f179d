// Shows `.hyrf` files in scenes of three.js with WebGLRenderer. A worker evaluates the model's fields for the camera;
// the page's thread only uploads arrays.

import { Vector3 } from "three";
import { CULL_MARGIN_RATIO } from "hyrf.js/frustum.js";
import { viewFromPlace } from "hyrf.js/places.js";

import { GaussianPass } from "./gaussian-pass.js";
import { RemoteObject } from "./remote-object.js";
import { compositeFragment } from "./shaders.js";
import { wholeMesh } from "./sky.js";

/** A file's model, drawn by this example's own shaders as `hyrfpack render` draws it. */
export class HyrfObject extends RemoteObject {
  /** @param {import("hyrf.js/remote.js").RemoteModel} model */
  constructor(model) {
    super(model);
    this.shapeView = {
      ...this.view, u_depth: { value: new Vector3() },
      u_near: { value: this.nearPlane }, u_margin: { value: CULL_MARGIN_RATIO },
      u_antialiased: { value: model.config.antialiased },
    };
    this.gaussians = new GaussianPass(model.rowCount, this.shapeView);
    const uniforms = { ...this.skyUniforms, u_blended: { value: null }, u_has_sky: { value: Boolean(model.sky) } };
    // Gaussians of a merged file are exposed one by one, because each part has its own exposure.
    if (model.parts.length > 1) uniforms.u_gains = { value: new Vector3(1, 1, 1) };
    this.composite = wholeMesh(compositeFragment, uniforms, true);
    this.composite.onBeforeRender = (...drawn) => this.drawGaussians(...drawn);
    this.frame.add(this.gaussians.mesh, this.composite);
  }

  receiveOrder(order, drawn) {
    this.model.reuse(this.gaussians.setOrder(order, drawn));
    this.dispatchEvent({ type: "change" });
  }

  receiveRow(row) {
    this.gaussians.setRow(row);
    this.dispatchEvent({ type: "change" });
  }

  isOwn(material) {
    return super.isOwn(material) || material === this.composite.material;
  }

  drawGaussians(renderer, scene, camera, geometry, material) {
    const view = this.setView(renderer, scene, camera, geometry, material);
    if (!view) return;
    const { elements: p } = camera.projectionMatrix;
    this.shapeView.u_depth.value.set(p[10], p[14], view.unit);
    if (this.model.parts.length > 1) this.exposeParts(view);
    this.gaussians.render(renderer, scene, camera, view.width, view.height);
    material.uniforms.u_blended.value = this.gaussians.target.texture;
  }

  // Sets the exposures of the parts of a merged file for a view.
  exposeParts(view) {
    for (const part of this.model.parts) {
      const { eye, rows } = viewFromPlace(view, part.place);
      this.gaussians.setGains(part.firstRow, part.rowCount, this.gains(part, eye, rows[2]));
    }
  }

  dispose() {
    super.dispose();
    this.gaussians.dispose();
    this.composite.geometry.dispose();
    this.composite.material.dispose();
  }
}
