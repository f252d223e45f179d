// Draws the Gaussians of DeviceFields on a WebGPU device: projects, sorts and blends them, and composites them over the
// background. It does what Renderer does with WebGL 2.

import { ALPHA_MIN, REDUCED_ALPHA_MIN, backgroundSphere, isReduced, lowPassVariances } from "../renderer.js";
import { DeviceObjects } from "./device.js";
import { RadixSort } from "./radix_sort.js";
import { readShader } from "./shaders.js";

const SPLATS_FORMAT = "rgba16float";
export const FRAME_FORMAT = "rgba8unorm";
const GROUP_SIZE = 64; // Gaussians of a workgroup
const MAX_GROUPS = 65535; // along one axis, on all devices
const VIEW_BYTES = 128, PICTURE_BYTES = 16, SCENE_BYTES = 128; // the structures of the shaders
const PREMULTIPLIED = { srcFactor: "one", dstFactor: "one-minus-src-alpha" };
const LINEAR = { magFilter: "linear", minFilter: "linear" };

export class Painter {
  constructor(device) {
    const graphics = new DeviceObjects(device), { UNIFORM } = GPUBufferUsage;
    this.graphics = graphics;
    this.view = graphics.buffer(VIEW_BYTES, UNIFORM);
    this.picture = graphics.buffer(PICTURE_BYTES, UNIFORM);
    this.scene = graphics.buffer(SCENE_BYTES, UNIFORM);
    this.place = graphics.buffer(16, UNIFORM);
    this.samplers = [{ ...LINEAR, addressModeU: "repeat" }, LINEAR].map((kind) => device.createSampler(kind));
    this.nothing = graphics.texture(FRAME_FORMAT, [1, 1], GPUTextureUsage.TEXTURE_BINDING);
    this.blended = null; // the texture of blended splats
  }

  async prepare() {
    const { graphics } = this, blend = { color: PREMULTIPLIED, alpha: PREMULTIPLIED };
    const draw = (name, entries, target) => graphics.drawPipeline(name, readShader(name), entries, target);
    this.project = await graphics.computePipeline("project.wgsl", readShader("project.wgsl"));
    this.blend = await draw("blend.wgsl", ["place_corner", "blend"], { format: SPLATS_FORMAT, blend });
    this.resolve = await draw("resolve.wgsl", ["cover", "resolve"], { format: FRAME_FORMAT });
    this.depth = await draw("depth.wgsl", ["cover", "encode"], { format: FRAME_FORMAT });
    this.sortPipelines = await RadixSort.compile(graphics);
  }

  // Blends the splats of a view, at the pixels of `part` (x, y, width, height). Returns their picture, whose first rows
  // and columns are in use. With `pick`, depths are blended instead of colours, see Renderer.pick.
  blendSplats(fields, scene, view, pick = 0, part = [0, 0, view.width, view.height]) {
    const { graphics, graphics: { device } } = this, alphaMin = isReduced(view) ? REDUCED_ALPHA_MIN : ALPHA_MIN;
    graphics.write(this.view, describeView(view, scene, fields, alphaMin, pick));
    graphics.write(this.picture, Float32Array.of(view.width, view.height, alphaMin));
    const encoder = device.createCommandEncoder(), pass = encoder.beginComputePass();
    const { places, shapes, colors, splats, keys, sort } = fields;
    pass.setPipeline(this.project);
    pass.setBindGroup(0, graphics.group(this.project, [this.view, places, shapes, colors, splats, keys]));
    const groups = Math.max(1, Math.ceil(fields.count / GROUP_SIZE)), rows = Math.ceil(groups / MAX_GROUPS);
    pass.dispatchWorkgroups(Math.ceil(groups / rows), rows);
    sort.encode(pass);
    pass.end();
    const blended = this.reserve(view), draw = beginDrawing(encoder, blended);
    draw.setViewport(0, 0, view.width, view.height, 0, 1);
    draw.setScissorRect(...part);
    draw.setPipeline(this.blend);
    draw.setBindGroup(0, graphics.group(this.blend, [this.picture, sort.order, splats]));
    draw.drawIndirect(sort.drawArguments, 0);
    draw.end();
    device.queue.submit([encoder.finish()]);
    return blended;
  }

  // Composites the blended splats over the background, to a texture of the view's size. `whole` is the view at its full
  // resolution.
  composite(fields, scene, view, target, { gains }, whole = view) {
    const { graphics, samplers } = this, panorama = fields.panorama?.texture, sky = fields.sky?.of(whole);
    graphics.write(this.scene, describeScene(view, scene, gains, Boolean(panorama), sky?.stride ?? 0, whole));
    const pictures = [this.blended, panorama ?? this.nothing, sky?.texture ?? this.nothing];
    this.drawTo(target, this.resolve, [this.scene, ...pictures, ...samplers]);
  }

  // Draws the mean depth at a pixel of blended depths to a texture of one pixel, see depth.wgsl.
  drawDepth(place, target) {
    this.graphics.write(this.place, Uint32Array.from(place));
    this.drawTo(target, this.depth, [this.place, this.blended]);
  }

  // Draws one triangle that covers a texture.
  drawTo(target, pipeline, resources) {
    const { graphics, graphics: { device } } = this, encoder = device.createCommandEncoder();
    const draw = beginDrawing(encoder, target);
    draw.setPipeline(pipeline);
    draw.setBindGroup(0, graphics.group(pipeline, resources));
    draw.draw(3);
    draw.end();
    device.queue.submit([encoder.finish()]);
  }

  // Returns a texture of at least a view's size for blended splats.
  reserve({ width, height }) {
    const { graphics, blended } = this, [w, h] = [blended?.width ?? 0, blended?.height ?? 0];
    if (width <= w && height <= h) return blended;
    const { RENDER_ATTACHMENT, TEXTURE_BINDING } = GPUTextureUsage, size = [Math.max(w, width), Math.max(h, height)];
    graphics.free(blended);
    return (this.blended = graphics.texture(SPLATS_FORMAT, size, RENDER_ATTACHMENT | TEXTURE_BINDING));
  }

  // Creates a texture for a finished picture.
  frame(width, height) {
    const { RENDER_ATTACHMENT, COPY_SRC } = GPUTextureUsage;
    return this.graphics.texture(FRAME_FORMAT, [width, height], RENDER_ATTACHMENT | COPY_SRC);
  }

  // Frees the texture of `reserve`.
  release() {
    this.graphics.free(this.blended);
    this.blended = null;
  }
}

function beginDrawing(encoder, texture) {
  const target = { view: texture.createView(), loadOp: "clear", storeOp: "store", clearValue: [0, 0, 0, 0] };
  return encoder.beginRenderPass({ colorAttachments: [target] });
}

// Returns the structure View of project.wgsl.
function describeView(view, { near, tolerance }, { count, antialiased }, alphaMin, pick) {
  const { rows, translation, width, height, fx, fy, cx, cy } = view, [across, down] = view.scales ?? [1, 1];
  const numbers = new Float32Array(VIEW_BYTES / 4), focal = Math.max(fx / across, fy / down);
  numbers.set([
    ...rows.flatMap((row, axis) => [...row, translation[axis]]), fx, fy, cx, cy, width, height, near, tolerance,
    ...lowPassVariances([across, down]), focal, pick, alphaMin, Number(antialiased),
  ]);
  new Uint32Array(numbers.buffer)[28] = count;
  return numbers;
}

// Returns the structure Scene of resolve.wgsl.
function describeScene({ rows, eye, width, height, fx, fy, cx, cy }, scene, gains, isPictured, stride, whole) {
  const { center, radius } = backgroundSphere(scene), from = eye.map((value, axis) => (value - center[axis]) / radius);
  return Float32Array.of(
    ...rows.flatMap((row) => [...row, 0]), fx, fy, cx, cy, ...from, Number(isPictured),
    ...scene.solid, 0.5 - 0.5 / Math.max(1, stride), ...gains, 0,
    (stride * width) / whole.width, (stride * height) / whole.height, 0, 0,
  );
}
