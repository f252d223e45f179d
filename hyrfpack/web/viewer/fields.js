// A model on the graphics device: what no view changes is worked out once, colours as the view moves.

import { sidesOf } from "./frustum.js";
import { ContextLost, Graphics, Pace } from "./graphics.js";
import { TEXTURE_WIDTH } from "./layout.js";
import { Panorama } from "./panorama.js";
import { textOf } from "./parts.js";
import { Rows } from "./rows.js";

const WIDEST = 32; // cells of 8 hidden units that a shader can hold
const WEIGHTS_WIDTH = 1024; // of the texture with a decoder's numbers, where no block of uniforms holds them
const UNIT = 6; // that this texture is bound to
const TABLE_SLICE = 1 << 21; // numbers of a table that are sent at a time
const EVEN = 2e-3; // radians that a row of Gaussians may be turned before its colours count as stale
const SHARE = 8; // of the visible rows, one in so many is coloured in a frame while moving

// What keeps a device from working fields out, to end a sentence with; its splats can be drawn all the same.
export class Unfit extends Error {}

export class Fields {
  // Whether a device can hold a model (pack.js) at all; throws Unfit where not.
  static check(gl, { cells, height, geometry, radiance }) {
    const side = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const rows = Math.max(height, ...[geometry, radiance].map(({ table }) => table.length / 2 / TEXTURE_WIDTH));
    if (cells > WIDEST) throw new Unfit("the decoders are too wide for this device.");
    if (rows > side) throw new Unfit("the model is larger than this device's textures.");
  }

  constructor(gl, model) {
    const { count, height, antialiased, cells, balls } = model;
    this.gl = gl;
    this.graphics = new Graphics(gl);
    Object.assign(this, { model, count, height, antialiased, cells });
    this.rows = new Rows(balls);
    this.pace = new Pace();
  }

  // Work out what no view changes. `report` is told the part done, and may throw to end it.
  async prepare(report) {
    const { gl, graphics, model, height } = this, size = [TEXTURE_WIDTH, height];
    Fields.check(gl, model);
    const words = (...more) => graphics.texture(gl.TEXTURE_2D, gl.RGBA32UI, ...size, ...more);
    this.places = words();
    this.shapes = words();
    this.colors = graphics.texture(gl.TEXTURE_2D, gl.RG32UI, ...size);
    this.cached = graphics.texture(gl.TEXTURE_2D_ARRAY, gl.RGBA32UI, ...size, this.cells);
    const floats = [gl.RGBA32F, gl.RGBA, gl.FLOAT, 4];
    const explicit = graphics.table(floats, TEXTURE_WIDTH, model.explicit);
    this.logits = graphics.table(floats, TEXTURE_WIDTH, model.logits);
    model.explicit = model.logits = null; // of no more use: the worker can make them again
    const geometry = await this.field(model.geometry), radiance = await this.field(model.radiance);
    this.demand();

    const forms = this.forms(), programs = {};
    for (const name of Object.keys(forms)) programs[name] = graphics.compile(textOf("whole.vert"), forms[name]);
    for (const name of Object.keys(forms)) await graphics.compiled(programs[name], `${name}.frag`);
    this.programs = programs;

    await this.shape(geometry, explicit, (part) => report(0.5 * part));
    graphics.free(explicit);
    geometry.free();
    graphics.free(programs.geometry.program);
    await this.cache(radiance, (part) => report(0.5 + 0.5 * part));
    graphics.free(programs.first.program);
    this.target = graphics.framebuffer(this.colors);
    this.radiance = radiance;
    if (model.background) {
      this.panorama = new Panorama(graphics, model.finest, (target, area, picture) => this.sky(target, area, picture));
      await this.panorama.begin();
    } else {
      radiance.freeTable();
    }
  }

  // Throws unless what was asked for so far fits into the device's memory.
  demand() {
    const { gl } = this, error = gl.getError();
    if (this.graphics.lost) throw new ContextLost();
    if (error !== gl.NO_ERROR) throw new Unfit("this device's memory does not hold the fields.");
  }

  // A field's table and decoder on the device.
  async field({ table, levels, decoder: { numbers, places } }) {
    const { gl, graphics } = this, wide = 2 * TEXTURE_WIDTH, rows = Math.ceil(table.length / wide);
    const texture = graphics.texture(gl.TEXTURE_2D, gl.RG32F, TEXTURE_WIDTH, rows);
    for (let at = 0; at < table.length;) {
      const left = table.length - at, high = Math.floor(Math.min(left, TABLE_SLICE) / wide);
      const size = high ? [TEXTURE_WIDTH, high] : [left / 2, 1]; // the last row may be short
      gl.bindTexture(gl.TEXTURE_2D, texture);
      const part = table.subarray(at, at + 2 * size[0] * size[1]);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, at / wide, ...size, gl.RG, gl.FLOAT, part);
      at += part.length;
      if (at < table.length) await graphics.finished();
    }
    const block = this.fitsBlock(numbers), floats = [gl.RGBA32F, gl.RGBA, gl.FLOAT, 4];
    const weights = block ? graphics.keep(gl.createBuffer(), "Buffer") : graphics.table(floats, WEIGHTS_WIDTH, numbers);
    if (block) {
      gl.bindBuffer(gl.UNIFORM_BUFFER, weights);
      gl.bufferData(gl.UNIFORM_BUFFER, numbers, gl.STATIC_DRAW);
    }
    const freeTable = () => graphics.free(texture);
    const free = () => [texture, weights].forEach((object) => graphics.free(object));
    return { table: texture, levels: new Uint32Array(levels.flat()), block, weights, places, freeTable, free };
  }

  // Whether shaders shall find a decoder's numbers in a block of uniforms: a device reads that far faster than a
  // texture, a processor that stands in for one the other way round.
  fitsBlock({ byteLength }) {
    const { gl } = this, said = gl.getParameter(gl.RENDERER);
    const names = said === "WebKit WebGL" ? gl.getExtension("WEBGL_debug_renderer_info") : null; // it says no more there
    const name = names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : said;
    return byteLength <= gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE) && !/swiftshader|llvmpipe|software/i.test(name);
  }

  // The texts of the passes.
  forms() {
    const { gl, cells, model: { geometry, radiance, sh, background } } = this;
    // Some devices hold fewer bytes a pixel than they offer targets.
    this.targets = Math.min(cells, gl.getParameter(gl.MAX_DRAW_BUFFERS), gl.getParameter(gl.MAX_COLOR_ATTACHMENTS));
    while (this.targets > 1 && !this.bears(this.targets)) this.targets >>= 1;
    const common = ({ decoder: { numbers, places } }) => ({
      CELLS: cells,
      BIAS_1: places.BIAS_1, INPUTS: places.INPUTS, WEIGHTS: places.WEIGHTS,
      ...(this.fitsBlock(numbers) ? { IN_BLOCK: 1 } : {}),
    });
    const deep = (field) => {
      const { BIAS_2, MATRIX_2, BIAS_3, MATRIX_3 } = field.decoder.places;
      return { ...common(field), BIAS_2, MATRIX_2, BIAS_3, MATRIX_3 };
    };
    const placed = ({ levels }) => ({ PLACES: 1, LEVELS: levels.length });
    const directions = radiance.decoder.places.INPUTS + 4 * cells * radiance.levels.length;
    const turned = { DIRECTIONS: directions, ...(sh ? { HARMONICS: 1 } : {}) };
    const parted = { CELLS: this.targets, ALL_CELLS: cells };
    const forms = {
      geometry: fieldShader("geometry.frag", { ...deep(geometry), ...placed(geometry) }),
      first: fieldShader("first.frag", { ...common(radiance), ...placed(radiance), ...parted }),
      colors: fieldShader("colors.frag", { ...deep(radiance), ...turned }),
    };
    if (!background) return forms;
    return { ...forms, panorama: fieldShader("panorama.frag", { ...deep(radiance), ...placed(radiance), ...turned }) };
  }

  // Whether so many layers can be drawn to at once.
  bears(count) {
    const { gl, graphics } = this;
    const framebuffer = graphics.framebuffer(...Array.from({ length: count }, (_, k) => [this.cached, k]));
    const whole = gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE;
    graphics.free(framebuffer);
    return whole;
  }

  // Take a pass into use.
  use(name, field) {
    const { gl, graphics, model } = this, p = this.programs[name];
    gl.useProgram(p.program);
    if (field.block) gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, field.weights);
    else graphics.bind(p, { u_weights: field.weights }, gl.TEXTURE_2D, UNIT);
    if (p.u_levels) {
      graphics.bind(p, { u_table: field.table });
      gl.uniform4uiv(p.u_levels, field.levels);
      gl.uniform3fv(p.u_half_extent, model.halfExtent);
    }
    return p;
  }

  // Draw a pass to rows of its target.
  pass(target, first, last) {
    const wide = this.height === 1 ? this.count : TEXTURE_WIDTH;
    this.area(target, [TEXTURE_WIDTH, this.height], [0, first, wide, last - first]);
  }

  // Draw a pass to a part of its target: x, y, width, height.
  area(target, size, part) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, ...size);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...part);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  async shape(field, explicit, report) {
    const { gl, graphics, model } = this, target = graphics.framebuffer(this.places, this.shapes);
    await new Pace().run(graphics, this.count ? this.height : 0, (first, last) => {
      const p = this.use("geometry", field);
      graphics.bind(p, { u_explicit: explicit, u_logits: this.logits }, gl.TEXTURE_2D, 1);
      gl.uniform1i(p.u_product, model.product);
      gl.uniform1i(p.u_grows, model.grows);
      this.pass(target, first, last);
    }, { report });
    graphics.free(target);
  }

  async cache(field, report) {
    const { gl, graphics, cells, targets } = this, pace = new Pace(), passes = Math.ceil(cells / targets);
    for (let number = 0; number < passes; number++) {
      const start = number * targets, layers = Math.min(targets, cells - start);
      const target = graphics.framebuffer(...Array.from({ length: layers }, (_, k) => [this.cached, start + k]));
      await pace.run(graphics, this.count ? this.height : 0, (first, last) => {
        const p = this.use("first", field);
        graphics.bind(p, { u_places: this.places }, gl.TEXTURE_2D, 1);
        gl.uniform1i(p.u_first, start);
        this.pass(target, first, last);
      }, { report: (part) => report((number + part) / passes) });
      graphics.free(target);
    }
  }

  // A part of a picture of the background.
  sky(target, size, part) {
    const { gl } = this, p = this.use("panorama", this.radiance);
    gl.uniform2f(p.u_size, ...size);
    this.area(target, size, part);
  }

  // Colour rows, runs of them at once.
  color(rows, eye) {
    const { gl, graphics } = this, p = this.use("colors", this.radiance);
    graphics.bind(p, { u_places: this.places, u_logits: this.logits });
    graphics.bind(p, { u_cached: this.cached }, gl.TEXTURE_2D_ARRAY, 2);
    gl.uniform3fv(p.u_eye, eye);
    const sorted = [...rows].sort((a, b) => a - b);
    for (let k = 0, start = 0; k < sorted.length; k++) {
      this.rows.colored(sorted[k], eye);
      if (sorted[k + 1] === sorted[k] + 1) continue;
      this.pass(this.target, sorted[start], sorted[k] + 1);
      start = k + 1;
    }
  }

  // While moving: colour the rows that need it most, for about so many ms; all that never were.
  recolor(view, margin, ms) {
    const { visible, rows, fresh } = this.rows.stale(sidesOf(view, margin), view.eye, EVEN);
    const most = Math.max(fresh, Math.min(this.pace.within(ms), Math.ceil(visible / SHARE)));
    if (rows.length) this.color(rows.slice(0, most), view.eye);
  }

  // Colour all that is in view, while `goOn()`. `exact`: for this very viewpoint. {rows: how many, done: whether all}.
  async coloured(view, margin, { goOn, exact = false } = {}) {
    const { rows } = this.rows.stale(sidesOf(view, margin), view.eye, exact ? 0 : EVEN);
    return { rows: rows.length, done: await this.coloring(rows, view.eye, goOn) };
  }

  coloring(rows, eye, goOn) {
    const work = (first, last) => this.color(rows.slice(first, last), eye);
    return this.pace.run(this.graphics, rows.length, work, { goOn });
  }

  // Standing still: all that is in view, and then what never was coloured, while `goOn()`; `changed` is called when
  // there is more to see. Whether it is complete.
  async complete(view, margin, { goOn, changed = () => {}, exact = false }) {
    const { rows, done } = await this.coloured(view, margin, { goOn, exact });
    if (rows) changed();
    if (!done) return false;
    const how = { goOn, changed, done: () => this.finishSky() };
    if (this.panorama && !(await this.panorama.complete(view, how))) return false;
    return this.coloring(this.rows.fresh(), view.eye, goOn);
  }

  finishSky() {
    this.radiance.freeTable();
    this.graphics.free(this.programs.panorama.program);
  }

  dispose() {
    this.graphics.dispose();
  }
}

// The text of a pass: constants, field.glsl with its lines repeated for each cell, and the pass itself.
function fieldShader(name, constants) {
  const lines = Object.entries(constants).map(([key, value]) => `#define ${key} ${value}`);
  const cells = Array.from({ length: constants.CELLS }, (_, cell) => cell);
  const text = `${textOf("field.glsl")}\n${textOf(name)}`;
  const whole = text.replace(/^EACH (.*)$/gm, (_, line) => cells.map((cell) => line.replaceAll("$", cell)).join("\n"));
  return ["#version 300 es", ...lines, whole].join("\n");
}
