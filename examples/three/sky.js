// The background of a `.hyrf` file in three.js.

import {
  BufferAttribute, BufferGeometry, DataTexture, LinearFilter, Mesh, RepeatWrapping, ShaderMaterial,
} from "three";

import { wholeVertex } from "./shaders.js";

const RGBA_BYTES = 4;

/** The textures of the fine and of the coarse picture of the background. */
export class SkyTextures {
  /** @param {import("hyrf.js/view_evaluator.js").SkySize} size */
  constructor({ width, height, coarseWidth, coarseHeight }) {
    this.fine = skyTexture(width, height);
    this.coarse = skyTexture(coarseWidth, coarseHeight);
  }

  /** @param {import("hyrf.js/view_evaluator.js").SkyTile} tile */
  setTile({ isCoarse, x, y, width, height, pixels }) {
    const texture = isCoarse ? this.coarse : this.fine, { data, width: whole } = texture.image;
    for (let row = 0; row < height; row++) {
      const start = RGBA_BYTES * ((y + row) * whole + x);
      data.set(pixels.subarray(RGBA_BYTES * row * width, RGBA_BYTES * (row + 1) * width), start);
      texture.addUpdateRange(start, RGBA_BYTES * width);
    }
    texture.needsUpdate = true;
  }

  dispose() {
    this.fine.dispose();
    this.coarse.dispose();
  }
}

function skyTexture(width, height) {
  const texture = new DataTexture(new Uint8Array(RGBA_BYTES * width * height), width, height);
  texture.wrapS = RepeatWrapping;
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

/**
 * Makes a mesh that covers the picture.
 * @param {string} fragmentShader
 * @param {Record<string, {value: unknown}>} uniforms
 * @param {boolean} transparent
 */
export function wholeMesh(fragmentShader, uniforms, transparent) {
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
