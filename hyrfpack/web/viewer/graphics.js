// WebGL 2 in the words that the player needs. What one Graphics has made is freed together.

import { textOf } from "./parts.js";

const POLL = 4; // ms between questions whether the device is done

// The device was taken away in the middle of something; the page is told when it comes back.
export class ContextLost extends Error {}

const losses = new WeakMap(); // context -> how often it was lost or came back
const lossesOf = (gl) => losses.get(gl) ?? 0;

// Nothing that was made on a context until now is of use any more.
export function countLoss(gl) {
  losses.set(gl, lossesOf(gl) + 1);
}

export class Graphics {
  constructor(gl) {
    this.gl = gl;
    this.made = new Map(); // object -> what deletes it
    this.losses = lossesOf(gl);
  }

  // Whether the device was taken away since, even if it is back.
  get lost() {
    return this.gl.isContextLost() || this.losses !== lossesOf(this.gl);
  }

  keep(object, kind) {
    this.made.set(object, kind);
    return object;
  }

  // Delete something, or all.
  free(object) {
    if (!object) return;
    if (!this.lost) this.gl[`delete${this.made.get(object)}`](object);
    this.made.delete(object);
  }

  dispose() {
    for (const object of [...this.made.keys()]) this.free(object);
  }

  texture(kind, format, width, height, depth) {
    const { gl } = this, texture = this.keep(gl.createTexture(), "Texture");
    gl.bindTexture(kind, texture);
    if (depth) gl.texStorage3D(kind, 1, format, width, height, depth);
    else gl.texStorage2D(kind, 1, format, width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, name, gl.CLAMP_TO_EDGE);
    return texture;
  }

  // For the texture that is bound.
  smooth() {
    const { gl } = this;
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
  }

  // A texture for an array of numbers, row after row; the last row may be short. `type`: internal format, format, type,
  // and how many numbers a texel has.
  table([internal, format, type, wide], width, numbers) {
    const { gl } = this, texels = numbers.length / wide, rows = Math.floor(texels / width);
    const texture = this.texture(gl.TEXTURE_2D, internal, width, Math.max(1, Math.ceil(texels / width)));
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, format, type, numbers);
    const rest = texels - rows * width;
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, rows, rest, 1, format, type, numbers.subarray(rows * width * wide));
    return texture;
  }

  // Targets are textures, or [texture array, layer].
  framebuffer(...targets) {
    const { gl } = this, framebuffer = this.keep(gl.createFramebuffer(), "Framebuffer");
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const places = targets.map((_, number) => gl.COLOR_ATTACHMENT0 + number);
    targets.forEach((target, number) => {
      if (Array.isArray(target)) gl.framebufferTextureLayer(gl.FRAMEBUFFER, places[number], target[0], 0, target[1]);
      else gl.framebufferTexture2D(gl.FRAMEBUFFER, places[number], gl.TEXTURE_2D, target, 0);
    });
    gl.drawBuffers(places);
    return framebuffer;
  }

  // Textures by the names of a program's uniforms, from a unit on.
  bind(program, textures, kind = this.gl.TEXTURE_2D, first = 0) {
    const { gl } = this;
    Object.entries(textures).forEach(([name, texture], number) => {
      gl.activeTexture(gl.TEXTURE0 + first + number);
      gl.bindTexture(kind, texture);
      gl.uniform1i(program[name], first + number);
    });
    gl.activeTexture(gl.TEXTURE7); // nothing is bound here by others
  }

  // A program of two texts, and its uniforms by name. It may still be compiling, see `compiled`.
  compile(vertex, fragment) {
    const { gl } = this, program = this.keep(gl.createProgram(), "Program");
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return { program };
  }

  // The uniforms of a program by their names, once it is linked.
  linked(found, what) {
    const { gl } = this, { program } = found, shaders = gl.getAttachedShaders(program) ?? [];
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !this.lost) {
      const logs = shaders.map((shader) => gl.getShaderInfoLog(shader)).join(" ");
      throw new Error(`The graphics driver refuses ${what}: ${gl.getProgramInfoLog(program)} ${logs}`);
    }
    for (const shader of shaders) gl.deleteShader(shader);
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      found[name.replace("[0]", "")] = gl.getUniformLocation(program, name);
    }
    return found;
  }

  // A program of files.
  program(vertex, fragment) {
    return this.linked(this.compile(textOf(vertex), textOf(fragment)), `${vertex} and ${fragment}`);
  }

  // As `linked`, without keeping the page waiting where drivers compile aside.
  async compiled(found, what) {
    const { gl } = this, aside = gl.getExtension("KHR_parallel_shader_compile");
    const pending = () => aside && !gl.getProgramParameter(found.program, aside.COMPLETION_STATUS_KHR);
    while (!this.lost && pending()) await pause();
    if (this.lost) throw new ContextLost();
    return this.linked(found, what);
  }

  // Once the device has done all it was asked for so far.
  async finished() {
    const { gl } = this, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    for (let status = gl.UNSIGNALED; status !== gl.SIGNALED;) {
      await pause();
      if (this.lost || !fence) throw new ContextLost();
      status = gl.getSyncParameter(fence, gl.SYNC_STATUS);
      if (status === null) throw new ContextLost();
    }
    gl.deleteSync(fence);
  }
}

const pause = () => new Promise((resolve) => setTimeout(resolve, POLL));

// Work in slices that take the device about SLICE ms each, so that it can do other things between.
export class Pace {
  static SLICE = 100;

  constructor() {
    this.unit = null; // ms that a unit of the work took lately
  }

  // How many units may be done in so many ms.
  within(ms) {
    return this.unit === null ? 1 : Math.max(1, Math.floor(ms / this.unit));
  }

  // Calls `work(first, last)` for ranges that together are 0 to `count`, each awaited, while `goOn()`; tells `report`
  // the part done. Whether all was done.
  async run(graphics, count, work, { goOn = () => true, report = () => {} } = {}) {
    for (let first = 0; first < count;) {
      if (!goOn()) return false;
      const last = Math.min(count, first + this.within(Pace.SLICE)), began = performance.now();
      work(first, last);
      await graphics.finished();
      const unit = (performance.now() - began) / (last - first);
      this.unit = this.unit === null ? unit : Math.max(unit, this.unit / 4); // at most four times as many next time
      first = last;
      report(first / count);
    }
    return true;
  }
}
