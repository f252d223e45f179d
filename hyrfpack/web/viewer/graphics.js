// Wraps WebGL 2. All objects that a Graphics creates are freed together.

import { readText } from "./texts.js";

const POLL_INTERVAL_MS = 4;
const NUMBERS_PER_UPLOAD = 1 << 19; // more would keep the page's thread for too long

// The graphics context was lost during an operation. The canvas fires an event when it is restored.
export class ContextLostError extends Error {}

const contextChanges = new WeakMap(); // context -> the number of its losses and restorations
// Returns the number of losses and restorations of a context.
const contextChangesOf = (gl) => contextChanges.get(gl) ?? 0;

// Records that a context was lost or restored, which makes all earlier objects invalid.
export function countContextChange(gl) {
  contextChanges.set(gl, contextChangesOf(gl) + 1);
}

const softwareContexts = new WeakMap(); // context -> whether it draws in software

export class Graphics {
  // `gl` is a WebGL 2 context.
  constructor(gl) {
    this.gl = gl;
    // The first object of a context asks for the name of its device, which would later block the page.
    if (!softwareContexts.has(gl)) softwareContexts.set(gl, /swiftshader|llvmpipe|software/i.test(deviceName(gl)));
    this.made = new Map(); // object -> its kind, which ends the name of the function that deletes it
    this.losses = contextChangesOf(gl);
  }

  // Returns whether the context was lost after this object was created, even if it was restored since.
  get lost() {
    return this.gl.isContextLost() || this.losses !== contextChangesOf(this.gl);
  }

  // Returns whether the device draws in software.
  get isSoftware() {
    return softwareContexts.get(this.gl);
  }

  // Returns the first error since the last call, or null.
  takeError() {
    const { gl } = this, error = gl.getError();
    return error === gl.NO_ERROR ? null : error;
  }

  // Registers an object, so that `dispose` deletes it.
  track(object, kind) {
    this.made.set(object, kind);
    return object;
  }

  // Deletes an object.
  free(object) {
    if (!object) return;
    if (!this.lost) this.gl[`delete${this.made.get(object)}`](object);
    this.made.delete(object);
  }

  // Deletes all objects.
  dispose() {
    for (const object of [...this.made.keys()]) this.free(object);
  }

  // Creates a texture without filtering, or an array of textures if `depth` is given.
  texture(kind, format, width, height, depth) {
    const { gl } = this, texture = this.track(gl.createTexture(), "Texture");
    gl.bindTexture(kind, texture);
    if (depth) gl.texStorage3D(kind, 1, format, width, height, depth);
    else gl.texStorage2D(kind, 1, format, width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, name, gl.CLAMP_TO_EDGE);
    return texture;
  }

  // Sets linear filtering for the bound texture.
  setLinear() {
    const { gl } = this;
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
  }

  // Sets the filters of the texture of an equirectangular picture.
  setPanoramic(texture) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    this.setLinear();
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
  }

  // Creates a texture from an array of numbers, row by row; the last row may be short. The first argument has the
  // internal format, the format, the type, and the number of components per texel. Large arrays are uploaded in pieces.
  async table([internal, format, type, size], width, numbers) {
    const { gl } = this, texels = numbers.length / size, whole = Math.floor(texels / width);
    const texture = this.texture(gl.TEXTURE_2D, internal, width, Math.max(1, Math.ceil(texels / width)));
    const upload = (row, columns, rows) => {
      gl.bindTexture(gl.TEXTURE_2D, texture);
      const part = numbers.subarray(row * width * size, (row * width + columns * rows) * size);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, columns, rows, format, type, part);
    };
    const step = Math.max(1, Math.floor(NUMBERS_PER_UPLOAD / (width * size)));
    for (let row = 0; row < whole; row += step) {
      upload(row, width, Math.min(step, whole - row));
      if (row + step < whole) await this.whenDone();
    }
    if (texels > whole * width) upload(whole, texels - whole * width, 1);
    return texture;
  }

  // Creates a texture array and uploads its layers, one after the other.
  async layers([internal, format, type, size], width, height, numbers) {
    const { gl } = this, step = width * height * size, depth = numbers.length / step;
    const texture = this.texture(gl.TEXTURE_2D_ARRAY, internal, width, height, depth);
    for (let layer = 0; layer < depth; layer++) {
      if (layer) await this.whenDone();
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
      const part = numbers.subarray(layer * step, (layer + 1) * step);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, width, height, 1, format, type, part);
    }
    return texture;
  }

  // Creates a framebuffer. Targets are textures, or [texture array, layer].
  framebuffer(...targets) {
    const { gl } = this, framebuffer = this.track(gl.createFramebuffer(), "Framebuffer");
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const attachments = targets.map((_, index) => gl.COLOR_ATTACHMENT0 + index);
    targets.forEach((target, index) => {
      const place = attachments[index];
      if (Array.isArray(target)) gl.framebufferTextureLayer(gl.FRAMEBUFFER, place, target[0], 0, target[1]);
      else gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, target, 0);
    });
    gl.drawBuffers(attachments);
    return framebuffer;
  }

  // Binds textures to the units from `first` on. `textures` maps names of the program's uniforms to textures.
  bind(program, textures, kind = this.gl.TEXTURE_2D, first = 0) {
    const { gl } = this;
    Object.entries(textures).forEach(([name, texture], index) => {
      gl.activeTexture(gl.TEXTURE0 + first + index);
      gl.bindTexture(kind, texture);
      gl.uniform1i(program[name], first + index);
    });
    gl.activeTexture(gl.TEXTURE7); // no program reads this unit, so that later bindings change no texture in use
  }

  // Starts to compile a program from two texts. `compiled` finishes it.
  compile(vertex, fragment) {
    const { gl } = this, program = this.track(gl.createProgram(), "Program");
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return { program };
  }

  // Adds to a {program} of `compile` the locations of its uniforms by their names. Throws an error, which names the
  // program by `name`, if it does not link.
  link(linked, name) {
    const { gl } = this, { program } = linked, shaders = gl.getAttachedShaders(program) ?? [];
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !this.lost) {
      const logs = shaders.map((shader) => gl.getShaderInfoLog(shader)).join(" ");
      throw new Error(`The graphics driver refuses ${name}: ${gl.getProgramInfoLog(program)} ${logs}`);
    }
    for (const shader of shaders) gl.deleteShader(shader);
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name: uniform } = gl.getActiveUniform(program, k);
      linked[uniform.replace("[0]", "")] = gl.getUniformLocation(program, uniform);
    }
    return linked;
  }

  // Starts to compile a program of two shader files.
  program(vertex, fragment) {
    return this.compile(readText(vertex), readText(fragment));
  }

  // Finishes programs, {name: program}, like `link`. The page is not blocked if the driver compiles in parallel.
  async compiled(programs) {
    const { gl } = this, parallel = gl.getExtension("KHR_parallel_shader_compile");
    for (const compiled of Object.values(programs)) {
      const pending = () => parallel && !gl.getProgramParameter(compiled.program, parallel.COMPLETION_STATUS_KHR);
      while (!this.lost && pending()) await waitForPoll();
    }
    for (const [name, compiled] of Object.entries(programs)) {
      await this.whenDone(); // `link` asks the device, which would block the page while it works
      this.link(compiled, name);
    }
  }

  // Waits until the device has finished all work so far.
  async whenDone() {
    const { gl } = this, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    for (let status = gl.UNSIGNALED; status !== gl.SIGNALED;) {
      await waitForPoll();
      if (this.lost || !fence) throw new ContextLostError();
      status = gl.getSyncParameter(fence, gl.SYNC_STATUS);
      if (status === null) throw new ContextLostError();
    }
    gl.deleteSync(fence);
  }
}

// Returns the name of a context's device.
function deviceName(gl) {
  const name = gl.getParameter(gl.RENDERER);
  // WebKit hides the device's name.
  const debugInfo = name === "WebKit WebGL" ? gl.getExtension("WEBGL_debug_renderer_info") : null;
  return debugInfo ? gl.getParameter(debugInfo.UNMASKED_RENDERER_WEBGL) : name;
}

// Waits until it is worth asking the device again.
const waitForPoll = () => new Promise((resolve) => setTimeout(resolve, POLL_INTERVAL_MS));

// Divides work into slices of about SLICE_MS of device time, so that the device can draw frames between them, and that
// the page never waits long for it.
export class WorkPacer {
  static SLICE_MS = 30;

  constructor() {
    this.unit = null; // recent ms per unit of the work; null before the first slice
  }

  // Returns the number of units of the work, at least one, that take about `ms`.
  within(ms) {
    return this.unit === null ? 1 : Math.max(1, Math.floor(ms / this.unit));
  }

  // Calls `work(first, last)` for consecutive ranges of 0 to `count` while `goOn()` is true, and waits for the device
  // after each. `report` is called with the fraction done, and awaited. Returns whether the work is complete.
  async run(graphics, count, work, { goOn = () => true, report = () => {} } = {}) {
    for (let first = 0; first < count;) {
      if (!goOn()) return false;
      const last = Math.min(count, first + this.within(WorkPacer.SLICE_MS)), began = performance.now();
      work(first, last);
      await graphics.whenDone();
      const unit = (performance.now() - began) / (last - first);
      this.unit = this.unit === null ? unit : Math.max(unit, this.unit / 4); // slices grow at most fourfold
      first = last;
      await report(first / count);
    }
    return true;
  }
}
