// What all ways of drawing a `.hyrf` file in three.js share: the file's model in a worker, its place in the scene, its
// background, its exposure, and the view that the worker evaluates.

import { Matrix3, Object3D, Vector2, Vector3, Vector4 } from "three";
import { logGains } from "hyrf.js/exposure.js";
import { BACKGROUND_RADIUS } from "hyrf.js/fields.js";
import { NEAR_PLANE_LOCAL } from "hyrf.js/frustum.js";
import { openRemoteModel } from "hyrf.js/remote.js";
import { viewpointOf } from "hyrf.js/viewpoint.js";

import { modelFrame, upright, viewOf } from "./placement.js";
import { skyFragment } from "./shaders.js";
import { SkyTextures, wholeMesh } from "./sky.js";

const FIRST_IN_SCENE = -1e9; // `renderOrder` of the background
const AS_PHOTOGRAPHED = "as-photographed", CONSISTENT = "consistent"; // the names in hyrfpack.RenderSettings

/**
 * The model of a file, or all models of a merged file, in the file's world units, rotated so that up is +y. It may be
 * moved, turned and scaled uniformly. Subclasses draw the Gaussians.
 *
 * Events: "change" when a new frame would look different, "complete" when everything that the camera sees is evaluated,
 * "error" with `error` if the worker fails.
 *
 * `userData.hyrf` has {metadata, count, exposure, cameras, up, target, near, far, solid}. `cameras` are for `lookFrom`;
 * `up`, `target`, `near` and `far` are in the file's world units; `solid` is the clear colour (sRGB in [0, 1]), or null
 * if the model has a background.
 */
export class RemoteObject extends Object3D {
  /**
   * Loads a file.
   * @param {import("hyrf.js/remote.js").Source} source the address or the content of the file
   * @param {import("hyrf.js/remote.js").OpenOptions} [options]
   * @returns {Promise<RemoteObject>} an object of the class on which it is called, when the file is decoded. It is
   *   drawn, more and more complete, while it is in a scene that is rendered.
   * @throws {import("hyrf.js").HyrfError} the file cannot be fetched or read; the message is a sentence for the user
   */
  static async load(source, options = {}) {
    let object = null;
    const model = await openRemoteModel(source, {
      ...options,
      onOrder: (order, drawn) => object.receiveOrder(order, drawn),
      onRow: (row) => object.receiveRow(row),
      onTile: (tile) => object.receiveTile(tile),
      onError: (error) => object.dispatchEvent({ type: "error", error }),
    });
    object = new this(model);
    return object;
  }

  /** @param {import("hyrf.js/remote.js").RemoteModel} model */
  constructor(model) {
    super();
    this.name = "hyrf";
    this.model = model;
    /** Whether everything that the camera of the last frame sees is evaluated. */
    this.isComplete = false;
    this.exposureMode = AS_PHOTOGRAPHED;
    const { metadata, config, count, exposure } = model, { scale } = config.frame;
    const { cameras, up, target } = viewpointOf(metadata);
    // That of the part with the smallest unit, in local units; the worker omits what is nearer than a part's own one.
    this.nearPlane = NEAR_PLANE_LOCAL * Math.min(...model.parts.map(({ place }) => place.scale));
    const near = this.nearPlane * scale, far = 2.5 * BACKGROUND_RADIUS * scale;
    const solid = config.background ? null : config.solid;
    this.userData.hyrf = { metadata, count, exposure, cameras, up, target, near, far, solid };
    this.quaternion.copy(upright(up));
    this.frame = modelFrame(config.frame);
    this.add(this.frame);

    this.view = {
      u_rotation: { value: new Matrix3() }, u_translation: { value: new Vector3() }, u_eye: { value: new Vector3() },
      u_intrinsics: { value: new Vector4() }, u_size: { value: new Vector2() }, u_corner: { value: new Vector2() },
      u_gains: { value: new Vector3(1, 1, 1) },
    };
    this.textures = model.sky ? new SkyTextures(model.sky) : null;
    const { fine = null, coarse = null } = this.textures ?? {};
    this.skyUniforms = { ...this.view, u_fine_sky: { value: fine }, u_coarse_sky: { value: coarse } };
    this.sky = wholeMesh(skyFragment, this.skyUniforms, false);
    this.sky.renderOrder = FIRST_IN_SCENE;
    this.sky.onBeforeRender = (...drawn) => this.setView(...drawn);
    this.frame.add(this.sky);
  }

  /**
   * The exposure of files with an exposure map: "as-photographed", that of the photos taken near the camera, or
   * "consistent", that of the model.
   */
  get exposure() {
    return this.exposureMode;
  }

  set exposure(exposure) {
    if (![AS_PHOTOGRAPHED, CONSISTENT].includes(exposure)) {
      throw new Error(`exposure must be ${AS_PHOTOGRAPHED} or ${CONSISTENT}, not ${String(exposure)}.`);
    }
    this.exposureMode = exposure;
    this.dispatchEvent({ type: "change" });
  }

  // Returns the gains of red, green and blue at a place, looking along a direction, both in the local units of a part.
  gains({ exposure }, eye, direction) {
    if (!exposure || this.exposure === CONSISTENT) return [1, 1, 1];
    return logGains(exposure, eye, direction).map(Math.exp);
  }

  receiveTile(tile) {
    this.textures.setTile(tile);
    this.dispatchEvent({ type: "change" });
  }

  // Sets the uniforms for a camera that draws the mesh of a whole picture, and tells the worker where the camera is.
  // Returns the view, or null if the camera cannot show the model.
  setView(renderer, scene, camera, geometry, material) {
    const { u_rotation, u_translation, u_eye, u_intrinsics, u_size, u_corner, u_gains } = this.view;
    const isPerspective = camera.projectionMatrix.elements[11] === -1;
    // Passes that draw the whole scene with another material do not show the model.
    const isOwn = this.isOwn(material), isSky = material === this.sky.material;
    geometry.setDrawRange(0, isOwn && isPerspective && !(isSky && !this.textures) ? 3 : 0);
    if (!isOwn || !isPerspective) return null;
    const { x, y, z: width, w: height } = renderer.getCurrentViewport(new Vector4());
    const { view, eye, unit } = viewOf(camera, this.frame, width, height), { rows, translation } = view;
    u_rotation.value.set(...rows.flat());
    u_translation.value.set(...translation);
    u_eye.value.set(...eye).divideScalar(BACKGROUND_RADIUS);
    u_intrinsics.value.set(view.fx, view.fy, view.cx, view.cy);
    u_size.value.set(width, height);
    u_gains.value.set(...this.gains(this.model, eye, rows[2]));
    u_corner.value.set(x, y);
    this.look(view);
    return { ...view, eye, unit };
  }

  // Returns whether a material is one with which this object covers the picture.
  isOwn(material) {
    return material === this.sky.material;
  }

  // Has the worker evaluate a view, unless it is the latest one.
  async look(view) {
    const text = JSON.stringify(view);
    if (text === this.latestView) return;
    this.latestView = text;
    this.isComplete = false;
    if (!(await this.model.look(view))) return;
    this.isComplete = true;
    this.dispatchEvent({ type: "complete" });
  }

  /** Removes the object from its scene, ends the worker and frees the graphics memory. */
  dispose() {
    this.removeFromParent();
    this.model.close();
    this.textures?.dispose();
    this.sky.geometry.dispose();
    this.sky.material.dispose();
  }
}
