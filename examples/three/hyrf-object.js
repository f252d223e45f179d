// Shows `.hyrf` files in scenes of three.js with WebGLRenderer. A worker evaluates the model's fields for the camera;
// the page's thread only uploads arrays.

import {
  BufferAttribute, BufferGeometry, DataTexture, Group, LinearFilter, Matrix3, Matrix4, Mesh, Object3D, Quaternion,
  RepeatWrapping, ShaderMaterial, Vector2, Vector3, Vector4,
} from "three";
import { logGains } from "hyrf.js/exposure.js";
import { BACKGROUND_RADIUS } from "hyrf.js/fields.js";
import { CULL_MARGIN_RATIO, NEAR_PLANE_LOCAL } from "hyrf.js/frustum.js";
import { viewFromPlace } from "hyrf.js/places.js";
import { openRemoteModel } from "hyrf.js/remote.js";
import { IDENTITY_QUAT } from "hyrf.js/rotation.js";
import { viewpointOf } from "hyrf.js/viewpoint.js";

import { GaussianPass } from "./gaussian-pass.js";
import { compositeFragment, skyFragment, wholeVertex } from "./shaders.js";

const RGBA_BYTES = 4;
const FIRST_IN_SCENE = -1e9; // `renderOrder` of the background
const AS_PHOTOGRAPHED = "as-photographed", CONSISTENT = "consistent"; // the names in hyrfpack.RenderSettings

/**
 * The model of a file, or all models of a merged file, in the file's world units, rotated so that up is +y. It may be moved, turned and scaled uniformly.
 *
 * Events: "change" when a new frame would look different, "complete" when everything that the camera sees is evaluated,
 * "error" with `error` if the worker fails.
 *
 * `userData.hyrf` has {metadata, count, exposure, cameras, up, target, near, far, solid}. `cameras` are for `lookFrom`;
 * `up`, `target`, `near` and `far` are in the file's world units; `solid` is the clear colour (sRGB in [0, 1]), or null
 * if the model has a background.
 */
export class HyrfObject extends Object3D {
  /**
   * Loads a file.
   * @param {import("hyrf.js/remote.js").Source} source the address or the content of the file
   * @param {import("hyrf.js/remote.js").OpenOptions} [options]
   * @returns {Promise<HyrfObject>} when the file is decoded. It is drawn, more and more complete, while it is in a
   *   scene that is rendered.
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
    object = new HyrfObject(model);
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
    const { metadata, config, count, exposure } = model, { center, scale, rotation = IDENTITY_QUAT } = config.frame;
    const { cameras, up, target } = viewpointOf(metadata);
    const near = NEAR_PLANE_LOCAL * scale, far = 2.5 * BACKGROUND_RADIUS * scale;
    const solid = config.background ? null : config.solid;
    this.userData.hyrf = { metadata, count, exposure, cameras, up, target, near, far, solid };
    this.quaternion.copy(new Quaternion().setFromUnitVectors(new Vector3(...up), new Vector3(0, 1, 0)));

    this.view = {
      u_rotation: { value: new Matrix3() }, u_translation: { value: new Vector3() }, u_eye: { value: new Vector3() },
      u_intrinsics: { value: new Vector4() }, u_size: { value: new Vector2() }, u_corner: { value: new Vector2() },
      u_depth: { value: new Vector3() },
      u_near: { value: NEAR_PLANE_LOCAL }, u_margin: { value: CULL_MARGIN_RATIO },
      u_antialiased: { value: config.antialiased }, u_gains: { value: new Vector3(1, 1, 1) },
    };
    const [fine, coarse] = model.sky ? skyTextures(model.sky) : [null, null];
    const skyUniforms = { ...this.view, u_fine_sky: { value: fine }, u_coarse_sky: { value: coarse } };
    const [w, ...vector] = rotation;
    this.frame = new Group(); // has the model's local units and axes
    this.frame.position.set(...center);
    this.frame.quaternion.set(...vector, w).normalize();
    this.frame.scale.setScalar(scale);
    this.add(this.frame);
    this.gaussians = new GaussianPass(model.rowCount, this.view);
    const compositeUniforms = { ...skyUniforms, u_blended: { value: null }, u_has_sky: { value: Boolean(model.sky) } };
    // Gaussians of a merged file are exposed one by one, because each part has its own exposure.
    if (model.parts.length > 1) compositeUniforms.u_gains = { value: new Vector3(1, 1, 1) };
    this.composite = wholeMesh(compositeFragment, compositeUniforms, true);
    this.composite.onBeforeRender = (...drawn) => this.drawGaussians(...drawn);
    this.frame.add(this.gaussians.mesh, this.composite);
    if (model.sky) {
      this.skies = [fine, coarse];
      this.sky = wholeMesh(skyFragment, skyUniforms, false);
      this.sky.renderOrder = FIRST_IN_SCENE;
      this.sky.onBeforeRender = (...drawn) => this.setView(...drawn);
      this.frame.add(this.sky);
    }
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

  receiveOrder(order, drawn) {
    this.model.reuse(this.gaussians.setOrder(order, drawn));
    this.dispatchEvent({ type: "change" });
  }

  receiveRow(row) {
    this.gaussians.setRow(row);
    this.dispatchEvent({ type: "change" });
  }

  receiveTile({ isCoarse, x, y, width, height, pixels }) {
    const texture = this.skies[Number(isCoarse)], { data, width: whole } = texture.image;
    for (let row = 0; row < height; row++) {
      const start = RGBA_BYTES * ((y + row) * whole + x);
      data.set(pixels.subarray(RGBA_BYTES * row * width, RGBA_BYTES * (row + 1) * width), start);
      texture.addUpdateRange(start, RGBA_BYTES * width);
    }
    texture.needsUpdate = true;
    this.dispatchEvent({ type: "change" });
  }

  // Sets the uniforms for a camera and tells the worker where it is. Returns whether the camera can show the model.
  setView(renderer, scene, camera, geometry, material) {
    const { u_rotation, u_translation, u_eye, u_intrinsics, u_size, u_corner, u_depth } = this.view;
    const { elements: p } = camera.projectionMatrix, isPerspective = p[11] === -1;
    // Passes that draw the whole scene with another material do not show the model.
    const isOwn = [this.composite.material, this.sky?.material].includes(material);
    geometry.setDrawRange(0, isOwn && isPerspective ? 3 : 0);
    if (!isOwn || !isPerspective) return false;
    const pose = new Matrix4().multiplyMatrices(camera.matrixWorldInverse, this.frame.matrixWorld);
    const { elements: e } = pose;
    const unit = Math.cbrt(Math.abs(pose.determinant()));
    const rows = [0, 1, 2].map((k) => [e[k], e[4 + k], e[8 + k]].map((value) => (k ? -value : value) / unit));
    const translation = [e[12], -e[13], -e[14]].map((value) => value / unit);
    const { x, y, z: width, w: height } = renderer.getCurrentViewport(new Vector4());
    const view = {
      rows, translation, width, height,
      fx: (p[0] * width) / 2, fy: (p[5] * height) / 2, cx: ((1 - p[8]) * width) / 2, cy: ((1 + p[9]) * height) / 2,
    };
    const eye = [0, 1, 2].map((k) => -rows.reduce((sum, row, axis) => sum + row[k] * translation[axis], 0));
    u_rotation.value.set(...rows.flat());
    u_translation.value.set(...translation);
    u_eye.value.set(...eye).divideScalar(BACKGROUND_RADIUS);
    u_intrinsics.value.set(view.fx, view.fy, view.cx, view.cy);
    u_size.value.set(width, height);
    this.view.u_gains.value.set(...this.gains(this.model, eye, rows[2]));
    if (this.model.parts.length > 1) this.exposeParts({ ...view, eye });
    u_corner.value.set(x, y);
    u_depth.value.set(p[10], p[14], unit);
    this.look(view);
    return true;
  }

  // Sets the exposures of the parts of a merged file for a view.
  exposeParts(view) {
    for (const part of this.model.parts) {
      const { eye, rows } = viewFromPlace(view, part.place);
      this.gaussians.setGains(part.firstRow, part.rowCount, this.gains(part, eye, rows[2]));
    }
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

  drawGaussians(renderer, scene, camera, geometry, material) {
    if (!this.setView(renderer, scene, camera, geometry, material)) return;
    const { x: width, y: height } = this.view.u_size.value;
    this.gaussians.render(renderer, scene, camera, width, height);
    material.uniforms.u_blended.value = this.gaussians.target.texture;
  }

  /** Removes the object from its scene, ends the worker and frees the graphics memory. */
  dispose() {
    this.removeFromParent();
    this.model.close();
    this.gaussians.dispose();
    for (const mesh of [this.composite, this.sky]) {
      mesh?.geometry.dispose();
      mesh?.material.dispose();
    }
    for (const texture of this.skies ?? []) texture.dispose();
  }
}

// Makes a mesh that covers the picture.
function wholeMesh(fragmentShader, uniforms, transparent) {
  const geometry = new BufferGeometry();
  geometry.setIndex(new BufferAttribute(new Uint16Array([0, 1, 2]), 1));
  const material = new ShaderMaterial({
    vertexShader: wholeVertex, fragmentShader, uniforms, transparent, premultipliedAlpha: true,
    depthTest: false, depthWrite: false, toneMapped: false,
  });
  const mesh = new Mesh(geometry, material);
  mesh.frustumCulled = false;
  mesh.raycast = () => {};
  return mesh;
}

// Returns the textures of the fine and of the coarse picture of the background.
const skyTextures = ({ width, height, coarseWidth, coarseHeight }) =>
  [skyTexture(width, height), skyTexture(coarseWidth, coarseHeight)];

function skyTexture(width, height) {
  const texture = new DataTexture(new Uint8Array(RGBA_BYTES * width * height), width, height);
  texture.wrapS = RepeatWrapping;
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.needsUpdate = true;
  return texture;
}
