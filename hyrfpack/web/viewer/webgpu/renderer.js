// Draws scenes of one model with WebGPU and all others with WebGL 2, which also shows the pictures of WebGPU: a canvas
// cannot change from one to the other, but another file or a lost device may require it.

import { ContextLostError } from "../graphics.js";
import { Renderer, reduceView } from "../renderer.js";
import { openDevice } from "./device.js";
import { DeviceFields } from "./fields.js";
import { FRAME_FORMAT, Painter } from "./painter.js";

const MAX_DEPTH_CODE = 2 ** 24 - 1; // of depth.wgsl

export class WebgpuRenderer extends Renderer {
  // `lost()` is called when WebGPU can draw no longer, and its contents must be made again.
  constructor(canvas, lost) {
    super(canvas);
    this.notifyLost = lost;
    this.device = this.painter = null; // while WebGPU cannot draw
    this.deviceFrame = null; // the texture of the last frame
    this.framesInWork = 0;
    this.isReleased = false; // whether WebGPU will draw no longer
  }

  // Opens the device, too.
  prepare() {
    return (this.opened ??= Promise.all([super.prepare(), this.open().catch(() => this.fallBack())]));
  }

  async open() {
    const device = await openDevice(() => this.handleLoss());
    if (!device || this.isReleased) return device?.destroy();
    this.device = device;
    const painter = new Painter(device);
    await painter.prepare();
    if (this.isReleased) return;
    this.largest = this.largest.map((side) => Math.min(side, device.limits.maxTextureDimension2D));
    this.surface = new OffscreenCanvas(1, 1);
    this.surfaceContext = this.surface.getContext("webgpu");
    const usage = GPUTextureUsage.COPY_DST;
    this.surfaceContext.configure({ device, format: FRAME_FORMAT, usage, alphaMode: "opaque" });
    this.painter = painter;
  }

  // Draws with WebGL 2 from now on. Returns whether WebGPU was in use.
  fallBack() {
    const wasInUse = this.painter !== null;
    this.releaseDevice();
    return wasInUse;
  }

  // Lets WebGL draw what WebGPU has drawn.
  handleLoss() {
    if (this.fallBack()) this.notifyLost();
  }

  // The rule that chooses: WebGPU draws a single model that the device holds.
  makeContent(message) {
    const { device, painter } = this, [model, ...others] = message.models ?? [];
    const isDrawn = painter && model && !others.length && DeviceFields.fits(device, model);
    return isDrawn ? new DeviceFields(device, model, painter.sortPipelines) : super.makeContent(message);
  }

  // Returns whether the content is drawn with WebGPU.
  get isOnDevice() {
    return this.content instanceof DeviceFields;
  }

  stage(content, scene, picture) {
    return content instanceof DeviceFields ? { content, scene } : super.stage(content, scene, picture);
  }

  // Takes no order for contents that the device sorts.
  sorted(order, drawn) {
    if (this.isOnDevice) this.isSorted = true;
    else super.sorted(order, drawn);
  }

  draw(view, scale, exposure) {
    if (!this.isOnDevice) return super.draw(view, scale, exposure);
    const { painter } = this, reduced = reduceView(view, scale), { width, height } = reduced;
    if (!painter) return; // the canvas keeps its picture until WebGL draws
    if (this.deviceFrame?.width !== width || this.deviceFrame.height !== height) {
      painter.graphics.free(this.deviceFrame);
      this.deviceFrame = painter.frame(width, height);
    }
    this.paintOnDevice(reduced, this.deviceFrame, exposure, view);
    this.finished = true;
    this.framesInWork++;
    this.endFrame(painter.graphics);
  }

  // Waits until the device has drawn a frame. A device that fails to is used no longer.
  async endFrame(graphics) {
    await graphics.whenDone().catch(() => {});
    this.framesInWork--;
    if (graphics.takeError()) this.handleLoss();
  }

  // Draws a view to a texture of its size.
  paintOnDevice(view, target, exposure, whole) {
    const { content, scene, painter } = this;
    painter.blendSplats(content, scene, view);
    painter.composite(content, scene, view, target, exposure, whole);
  }

  present() {
    const { gl, deviceFrame } = this;
    if (this.finished && this.isOnDevice) {
      if (!this.painter) return (this.finished = false);
      this.frameTarget(deviceFrame.width, deviceFrame.height);
      this.toWebgl(deviceFrame, this.frame.texture);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.clear(gl.COLOR_BUFFER_BIT); // else Chromium clears the canvas only after the copy, because nothing was drawn
    }
    return super.present();
  }

  // Copies a texture of the device to a WebGL texture of its size.
  toWebgl(source, texture) {
    const { gl, device, surface, surfaceContext } = this, { width, height } = source;
    if (surface.width !== width || surface.height !== height) Object.assign(surface, { width, height });
    const encoder = device.createCommandEncoder();
    encoder.copyTextureToTexture({ texture: source }, { texture: surfaceContext.getCurrentTexture() }, [width, height]);
    device.queue.submit([encoder.finish()]);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, surface);
  }

  paint(view, picture, exposure) {
    if (!this.isOnDevice) return super.paint(view, picture, exposure);
    const { painter } = this;
    if (!painter) throw new ContextLostError();
    const target = painter.frame(view.width, view.height);
    this.paintOnDevice(view, target, exposure);
    this.toWebgl(target, picture.texture);
    painter.graphics.free(target);
  }

  pick(view, x, y, scale) {
    if (!this.isOnDevice) return super.pick(view, x, y, scale);
    const { gl, graphics, painter } = this, place = [Math.floor(x), Math.floor(y)], code = new Uint8Array(4);
    if (!painter) return null;
    const texture = graphics.texture(gl.TEXTURE_2D, gl.RGBA8, 1, 1), target = graphics.framebuffer(texture);
    const depth = painter.frame(1, 1);
    painter.blendSplats(this.content, this.scene, view, scale, [...place, 1, 1]);
    painter.drawDepth(place, depth);
    this.toWebgl(depth, texture);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, code);
    for (const object of [target, texture]) graphics.free(object);
    painter.graphics.free(depth);
    const share = ((code[0] << 16) | (code[1] << 8) | code[2]) / MAX_DEPTH_CODE; // z / (z + scale)
    return share > 0 && share < 1 ? (scale * share) / (1 - share) : null;
  }

  busy() {
    return this.isOnDevice ? this.framesInWork > 0 : super.busy();
  }

  blended(view) {
    if (!this.isOnDevice) return super.blended(view);
    if (!this.painter) throw new ContextLostError();
    return this.painter.blendSplats(this.content, this.scene, view);
  }

  release() {
    super.release();
    this.painter?.release();
  }

  releaseDevice() {
    this.isReleased = true;
    this.device?.destroy(); // and all of its objects
    this.device = this.painter = null;
  }

  dispose() {
    super.dispose();
    this.releaseDevice();
  }
}
