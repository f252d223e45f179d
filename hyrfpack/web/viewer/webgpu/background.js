// The background of a model as textures of a WebGPU device: like Panorama and Sky, whose order of work it shares.

import { Panorama } from "../panorama.js";
import { Sky } from "../sky.js";

const SKY_FORMAT = "rgba16float";
const GROUP_SIDE_TEXELS = 8; // of the shaders' workgroups

export const countGroups = (sides) => sides.map((side) => Math.ceil(side / GROUP_SIDE_TEXELS));

export class DevicePanorama extends Panorama {
  // Creates the texture of the whole picture, and fills it with the coarse one. `sampler` interpolates it.
  begin(pipeline, sampler) {
    const { graphics, texture: coarse, size } = this, { STORAGE_BINDING, TEXTURE_BINDING } = GPUTextureUsage;
    this.texture = this.target = graphics.texture(SKY_FORMAT, size, STORAGE_BINDING | TEXTURE_BINDING);
    graphics.compute(pipeline, [coarse, sampler, this.texture], countGroups(size));
    graphics.free(coarse);
    this.tiles = this.cut();
  }
}

export class DeviceSky extends Sky {
  // Provides textures of this number of nodes.
  reserve(...size) {
    if (size.every((side, axis) => side === this.size[axis])) return;
    this.size = size;
    this.graphics.free(this.needed);
    this.needed = this.createTexture("r32float");
    this.clearNodes();
  }

  // Replaces the texture by a new one, which is transparent.
  clearNodes() {
    this.graphics.free(this.texture);
    this.texture = this.target = this.createTexture(SKY_FORMAT);
  }

  createTexture(format) {
    const { STORAGE_BINDING, TEXTURE_BINDING } = GPUTextureUsage;
    return this.graphics.texture(format, this.size, STORAGE_BINDING | TEXTURE_BINDING);
  }

  markNeeded({ width, height }, splats) {
    this.mark(splats, [width - 1, height - 1, this.stride, 0]);
  }

  markAll() {
    this.mark(this.target, [-1, -1, this.stride, 1]);
  }

  // Runs needed.wgsl, whose uniforms are `grid`.
  mark(splats, grid) {
    const { graphics, mask, size } = this;
    this.uniforms ??= graphics.buffer(16, GPUBufferUsage.UNIFORM);
    graphics.write(this.uniforms, Int32Array.from(grid));
    graphics.compute(mask, [this.uniforms, splats, this.needed], countGroups(size));
  }
}
