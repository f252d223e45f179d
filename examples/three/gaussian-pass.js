// Draws Gaussians, sorted by depth, into a picture of their own with the depths of the scene's opaque objects. The
// picture has half floats, because 8 bits would round faint Gaussians to zero.

import {
  BufferAttribute, Color, DataTexture, DoubleSide, FloatType, HalfFloatType, InstancedBufferGeometry, Mesh,
  NearestFilter, RGBAFormat, RedIntegerFormat, ShaderMaterial, UnsignedByteType, UnsignedIntType, WebGLRenderTarget,
} from "three";

import { GAUSSIANS_PER_ROW, gaussianFragment, gaussianVertex } from "./shaders.js";

const QUADS_PER_INSTANCE = 256; // drivers are slow with many small instances
const FLOATS_PER_TEXEL = 4;
const TEXELS_PER_SHAPE = 3;

export class GaussianPass {
  /**
   * @param {number} rowCount the number of rows of Gaussians
   * @param {Record<string, {value: unknown}>} viewUniforms the uniforms of the view, which the caller sets
   */
  constructor(rowCount, viewUniforms) {
    const rows = Math.max(1, rowCount);
    this.gains = new DataTexture(new Float32Array(FLOATS_PER_TEXEL * rows).fill(1), 1, rows, RGBAFormat, FloatType);
    this.gains.needsUpdate = true;
    this.shapes = dataTexture(Float32Array, TEXELS_PER_SHAPE * rows, RGBAFormat, FloatType);
    this.colors = dataTexture(Float32Array, rows, RGBAFormat, FloatType);
    // Four Gaussians a texel, because three.js updates parts of textures of four components only.
    this.pixelSizes = dataTexture(Float32Array, rows, RGBAFormat, FloatType, GAUSSIANS_PER_ROW / FLOATS_PER_TEXEL);
    this.order = dataTexture(Uint32Array, rows, RedIntegerFormat, UnsignedIntType);
    this.uniforms = {
      ...viewUniforms,
      u_order: { value: this.order },
      u_shapes: { value: this.shapes },
      u_colors: { value: this.colors },
      u_pixel_sizes: { value: this.pixelSizes },
      u_row_gains: { value: this.gains },
      u_drawn: { value: 0 },
      u_quads: { value: QUADS_PER_INSTANCE },
    };
    const material = new ShaderMaterial({
      vertexShader: gaussianVertex, fragmentShader: gaussianFragment, uniforms: this.uniforms,
      transparent: true, premultipliedAlpha: true, depthTest: true, depthWrite: false, toneMapped: false,
      side: DoubleSide, forceSinglePass: true, // quads may be mirrored
    });
    const corner = (k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6];
    const geometry = new InstancedBufferGeometry();
    const corners = Uint16Array.from({ length: 6 * QUADS_PER_INSTANCE }, (_, k) => corner(k));
    geometry.setIndex(new BufferAttribute(corners, 1));
    geometry.instanceCount = 0;
    this.mesh = new Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.raycast = () => {};
    material.visible = false; // except while `render` draws
    this.target = null;
  }

  /** Takes the order of a view: indices of Gaussians, of which the first `drawn` are valid. Returns the old array. */
  setOrder(order, drawn) {
    if (!order.length) return order;
    const { image } = this.order, earlier = image.data;
    image.data = order;
    this.order.needsUpdate = true;
    this.uniforms.u_drawn.value = drawn;
    this.mesh.geometry.instanceCount = Math.ceil(drawn / QUADS_PER_INSTANCE);
    return earlier;
  }

  /** Takes the shapes, pixel sizes and colours of a row of Gaussians. */
  setRow({ row, shapes, pixelSizes, colors }) {
    if (shapes) writeRows(this.shapes, TEXELS_PER_SHAPE * row, shapes);
    if (pixelSizes) writeRows(this.pixelSizes, row, pixelSizes);
    writeRows(this.colors, row, colors);
  }

  /** Sets the gains of red, green and blue of rows of Gaussians. */
  setGains(firstRow, rowCount, gains) {
    const { data } = this.gains.image;
    for (let row = firstRow; row < firstRow + rowCount; row++) data.set(gains, FLOATS_PER_TEXEL * row);
    this.gains.needsUpdate = true;
  }

  /**
   * Draws the Gaussians into `target.texture`, premultiplied. Must be called while the renderer draws `scene`.
   * @param {import("three").WebGLRenderer} renderer
   * @param {import("three").Object3D} scene
   * @param {import("three").Camera} camera
   * @param {number} width of the picture in pixels
   * @param {number} height
   */
  render(renderer, scene, camera, width, height) {
    this.target ??= makeTarget(renderer);
    this.target.setSize(width, height);
    const restores = [prepareMaterials(scene, this.mesh.material), prepareScene(scene), prepareRenderer(renderer)];
    try {
      renderer.setRenderTarget(this.target);
      renderer.render(scene, camera);
    } finally {
      for (const restore of restores) restore();
    }
  }

  dispose() {
    const { shapes, colors, pixelSizes, gains, order, target, mesh: { geometry, material } } = this;
    for (const part of [shapes, colors, pixelSizes, gains, order, target, geometry, material]) part?.dispose();
  }
}

function dataTexture(Numbers, rows, format, type, width = GAUSSIANS_PER_ROW) {
  const numbers = new Numbers((format === RGBAFormat ? FLOATS_PER_TEXEL : 1) * width * rows);
  const texture = new DataTexture(numbers, width, rows, format, type);
  texture.needsUpdate = true;
  return texture;
}

// Overwrites rows of a texture of floats from the start of the row `first` on. Only these are uploaded.
function writeRows(texture, first, numbers) {
  const length = FLOATS_PER_TEXEL * texture.image.width, start = first * length;
  texture.image.data.set(numbers, start);
  for (let at = 0; at < numbers.length; at += length) {
    texture.addUpdateRange(start + at, Math.min(length, numbers.length - at));
  }
  texture.needsUpdate = true;
}

function makeTarget(renderer) {
  const { extensions } = renderer;
  const isFine = extensions.has("EXT_color_buffer_float") || extensions.has("EXT_color_buffer_half_float");
  return new WebGLRenderTarget(1, 1, {
    type: isFine ? HalfFloatType : UnsignedByteType, minFilter: NearestFilter, magFilter: NearestFilter,
  });
}

// The following functions change what `renderer.render` does, and return functions that undo it.

// Lets opaque objects write their depths only, and hides all others but the Gaussians.
function prepareMaterials(scene, gaussians) {
  const earlier = new Map();
  scene.traverseVisible(({ material: materials }) => {
    for (const material of [materials ?? []].flat()) {
      if (!earlier.has(material)) earlier.set(material, [material.visible, material.colorWrite]);
    }
  });
  for (const material of earlier.keys()) {
    if (material.transparent || material.transmission > 0 || !material.depthWrite) material.visible = false;
    material.colorWrite = false;
  }
  gaussians.visible = gaussians.colorWrite = true;
  return () => earlier.forEach(([visible, colorWrite], material) => Object.assign(material, { visible, colorWrite }));
}

function prepareScene(scene) {
  const { background, overrideMaterial, matrixWorldAutoUpdate } = scene;
  Object.assign(scene, { background: null, overrideMaterial: null, matrixWorldAutoUpdate: false });
  return () => Object.assign(scene, { background, overrideMaterial, matrixWorldAutoUpdate });
}

function prepareRenderer(renderer) {
  const target = renderer.getRenderTarget(), color = renderer.getClearColor(new Color());
  const alpha = renderer.getClearAlpha(), { autoClear } = renderer, { autoReset } = renderer.info;
  const shadows = renderer.shadowMap.autoUpdate, xr = renderer.xr.enabled;
  renderer.setClearColor(0, 0);
  renderer.autoClear = true;
  renderer.info.autoReset = renderer.shadowMap.autoUpdate = renderer.xr.enabled = false;
  renderer.state.buffers.depth.setMask(true); // else the depths would not be cleared
  return () => {
    renderer.setClearColor(color, alpha);
    Object.assign(renderer, { autoClear });
    renderer.info.autoReset = autoReset;
    renderer.shadowMap.autoUpdate = shadows;
    renderer.xr.enabled = xr;
    renderer.setRenderTarget(target);
  };
}
