// Wraps WebGPU. All objects that a DeviceObjects creates are freed together.

import { ContextLostError } from "../graphics.js";

const WANTED_LIMITS = ["maxBufferSize", "maxStorageBufferBindingSize"]; // large models need more than the default
const MIN_BUFFER_BYTES = 32; // of Splat in project.wgsl, the largest element of an array

const lostDevices = new WeakSet();
const errors = new WeakMap(); // device -> its first error since the last call of `takeError`

// Returns a new device, or null if the browser has none. `lost()` is called when the device is lost, unless the page
// has destroyed it.
export async function openDevice(lost) {
  const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
  if (!adapter) return null;
  const requiredLimits = Object.fromEntries(WANTED_LIMITS.map((name) => [name, adapter.limits[name]]));
  const device = await adapter.requestDevice({ requiredLimits });
  device.lost.then(({ reason }) => {
    lostDevices.add(device);
    if (reason !== "destroyed") lost();
  });
  device.addEventListener("uncapturederror", ({ error }) => {
    if (!errors.has(device)) errors.set(device, error);
  });
  return device;
}

export class DeviceObjects {
  constructor(device) {
    this.device = device;
    this.made = new Set(); // buffers and textures
  }

  get lost() {
    return lostDevices.has(this.device);
  }

  // Returns the first error since the last call, for example of memory, or null. Call it after `whenDone`.
  takeError() {
    const error = errors.get(this.device) ?? null;
    errors.delete(this.device);
    return error;
  }

  // Registers a buffer or a texture, so that `dispose` destroys it.
  track(object) {
    this.made.add(object);
    return object;
  }

  free(object) {
    object?.destroy();
    this.made.delete(object);
  }

  dispose() {
    for (const object of this.made) object.destroy();
    this.made.clear();
  }

  // Creates a buffer of zeros.
  buffer(byteLength, usage = GPUBufferUsage.STORAGE) {
    const { COPY_DST, COPY_SRC } = GPUBufferUsage;
    const size = Math.max(MIN_BUFFER_BYTES, Math.ceil(byteLength / 4) * 4);
    return this.track(this.device.createBuffer({ size, usage: usage | COPY_DST | COPY_SRC }));
  }

  // Creates a buffer with the numbers of a typed array.
  upload(numbers, usage) {
    const buffer = this.buffer(numbers.byteLength, usage);
    this.write(buffer, numbers);
    return buffer;
  }

  // Replaces the first numbers of a buffer, for all work that is submitted later.
  write(buffer, numbers) {
    this.device.queue.writeBuffer(buffer, 0, numbers);
  }

  texture(format, [width, height], usage) {
    return this.track(this.device.createTexture({ format, size: [width, height], usage }));
  }

  // Compiles an entry point of a shader for compute passes. Throws an error if the device refuses it.
  computePipeline(name, code, entryPoint = "main") {
    return this.pipeline(name, code, (module) =>
      this.device.createComputePipelineAsync({ layout: "auto", compute: { module, entryPoint } }));
  }

  // Compiles a shader that draws triangles. `target` describes the texture that it draws to.
  drawPipeline(name, code, [vertex, fragment], target) {
    return this.pipeline(name, code, (module) =>
      this.device.createRenderPipelineAsync({
        layout: "auto",
        vertex: { module, entryPoint: vertex },
        fragment: { module, entryPoint: fragment, targets: [target] },
      }));
  }

  async pipeline(name, code, create) {
    try {
      return await create(this.device.createShaderModule({ code }));
    } catch (error) {
      if (this.lost) throw new ContextLostError();
      throw new Error(`The graphics driver refuses ${name}: ${error.message}`);
    }
  }

  // Returns a pipeline's group 0: the resource of each binding, undefined where the shader uses none.
  group(pipeline, resources) {
    const asResource = (object) =>
      object instanceof GPUBuffer ? { buffer: object } : object instanceof GPUTexture ? object.createView() : object;
    const used = resources.map((object, binding) => object && { binding, resource: asResource(object) });
    return this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries: used.filter(Boolean) });
  }

  // Runs a compute pass of `size` workgroups along x and y.
  compute(pipeline, resources, size) {
    const encoder = this.device.createCommandEncoder(), pass = encoder.beginComputePass();
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, this.group(pipeline, resources));
    pass.dispatchWorkgroups(...size);
    pass.end();
    this.device.queue.submit([encoder.finish()]);
  }

  // Waits until the device has finished all work so far.
  async whenDone() {
    await this.device.queue.onSubmittedWorkDone().catch(() => {});
    if (this.lost) throw new ContextLostError();
  }
}
