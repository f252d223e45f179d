// Evaluates a model on the graphics device: view-independent numbers once, and colours again when the view moves. Until
// then it draws the worker's estimate (see estimate.js).

import { frustumPlanes } from "../hyrf/frustum.js";
import { ContextLostError, Graphics, WorkPacer } from "./graphics.js";
import { TEXTURE_WIDTH } from "./constants.js";
import { Panorama } from "./panorama.js";
import { Sky } from "./sky.js";
import { readText } from "./texts.js";
import { RowStates } from "../hyrf/row_states.js";

const LEVELS_PER_LAYER = 4; // of features, two halves a level
const MAX_CELLS = 32; // a cell is 8 hidden units; the shaders hold all cells in variables
const WEIGHTS_TEXTURE_WIDTH = 1024; // of the texture for a decoder's numbers if no uniform block is used
const WEIGHTS_TEXTURE_UNIT = 6;
// A view at rest is drawn again after this time while its rows are coloured, and then less often.
const FIRST_REFRESH_MS = 1000;
const MAX_FRESH_TURN_RADIANS = 2e-3; // a larger turn of its viewing direction makes a row's colours stale
const MOVING_SKY_RATIO = 0.4; // while moving, the share of the time for colours in which a background is quick
const MOVING_ROWS_DIVISOR = 8; // while moving, a frame colours at most this part of the visible rows

// The device cannot evaluate fields, but it can draw splats. The message gives the reason, as the end of a sentence.
export class UnsupportedDeviceError extends Error {}
export const MEMORY_REASON = "this device's memory does not hold the fields.";

export class Fields {
  // Throws UnsupportedDeviceError if the device cannot hold a model that pack.js has packed.
  static check(gl, { cells, height, geometry, radiance }) {
    const side = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const tableRows = [geometry, radiance].map(({ table }) => table.length / 2 / TEXTURE_WIDTH);
    const rows = Math.max(height, ...tableRows);
    if (cells > MAX_CELLS) throw new UnsupportedDeviceError("the decoders are too wide for this device.");
    if (rows > side) throw new UnsupportedDeviceError("the model is larger than this device's textures.");
  }

  // `graphics` creates the objects of the device.
  constructor(gl, model, graphics = new Graphics(gl)) {
    const { count, width = TEXTURE_WIDTH, height, antialiased, cells } = model;
    this.gl = gl;
    Object.assign(this, { graphics, model, count, width, height, antialiased, cells });
    this.rows = new RowStates(model.balls);
    this.pace = new WorkPacer();
    this.hasEstimate = Boolean(model.estimate);
    this.isReady = false; // whether rows can be evaluated
  }

  // Uploads what is drawn before any row is evaluated: an estimate of the Gaussians, and a coarse background.
  async prepare() {
    const { gl, graphics, model, model: { coarseBackground } } = this;
    Fields.check(gl, model);
    await this.uploadEstimate();
    if (!model.background) return;
    const bytes = [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, 4];
    const coarse = await graphics.table(bytes, coarseBackground.width, coarseBackground.rgba);
    graphics.setPanoramic(coarse);
    this.panorama = new Panorama(graphics, model, coarse, (...area) => this.drawPanorama(...area));
    model.coarseBackground = null;
  }

  // Uploads the estimate of the Gaussians.
  async uploadEstimate() {
    const { gl, graphics, model, model: { estimate } } = this;
    const words = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, 4];
    const pairs = [gl.RG32UI, gl.RG_INTEGER, gl.UNSIGNED_INT, 2];
    this.places = await graphics.table(words, TEXTURE_WIDTH, estimate.places);
    this.shapes = await graphics.table(words, TEXTURE_WIDTH, estimate.shapes);
    this.colors = await graphics.table(pairs, TEXTURE_WIDTH, estimate.colors);
    model.estimate = null; // frees memory; the worker can estimate them again
  }

  // Uploads the model and compiles programs, so that rows can be evaluated.
  async prepareFields() {
    const { graphics, model, height } = this;
    await graphics.whenDone();
    graphics.takeError(); // clears earlier errors
    this.createFeatures();
    const { sky, ...shaders } = this.shaders(), programs = {}, vertexText = readText("whole.vert");
    for (const name of Object.keys(shaders)) {
      programs[name] = graphics.compile(vertexText, shaders[name]);
      await graphics.whenDone(); // the device takes in texts slowly
    }
    programs.enlarge = graphics.program("whole.vert", "enlarge.frag");
    Object.assign(this, { programs, skyShader: sky });

    await this.uploadGaussians();
    this.geometry = await this.field(model.geometry);
    this.radiance = await this.field(model.radiance);
    await graphics.compiled(programs);

    this.createTargets();
    this.pending = new Set(Array.from({ length: this.count ? height : 0 }, (_, row) => row)); // not evaluated yet
    this.panorama?.begin(programs.enlarge);
    await graphics.whenDone();
    this.checkMemory();
    this.isReady = true;
  }

  // Creates the textures of hash features.
  createFeatures() {
    const { gl, graphics, model, width, height } = this;
    this.layers = Math.ceil(model.radiance.levels.length / LEVELS_PER_LAYER);
    this.features = graphics.texture(gl.TEXTURE_2D_ARRAY, gl.RGBA32UI, width, height, this.layers);
  }

  // Uploads the numbers of the Gaussians that `evaluate` reads.
  async uploadGaussians() {
    const { gl, graphics, model, width, height } = this, floats = [gl.RGBA32F, gl.RGBA, gl.FLOAT, 4];
    this.explicit = await graphics.table(floats, TEXTURE_WIDTH, model.explicit);
    this.logits = await graphics.table(floats, TEXTURE_WIDTH, model.logits);
    this.pixelSizes = await graphics.table([gl.R32F, gl.RED, gl.FLOAT, 1], TEXTURE_WIDTH, model.pixelSizes);
    if (model.shapeResiduals) {
      const halves = [gl.RGBA16F, gl.RGBA, gl.FLOAT, 4];
      this.shapeResiduals = await graphics.layers(floats, width, height, model.shapeResiduals);
      this.colorResiduals = await graphics.layers(halves, width, height, model.colorResiduals);
      model.shapeResiduals = model.colorResiduals = null;
    }
    model.explicit = model.logits = model.pixelSizes = null; // frees memory; the worker can decode them again
  }

  // Prepares the background of views at rest, which the first picture does without.
  async prepareSky() {
    const { graphics, programs, model: { backgroundSpacing } } = this;
    const sky = graphics.compile(readText("whole.vert"), this.skyShader);
    const needed = graphics.program("whole.vert", "needed.frag");
    await graphics.compiled({ sky, needed });
    Object.assign(programs, { sky, needed });
    this.sky = new Sky(graphics, needed, backgroundSpacing, (...area) => this.drawSky(...area));
  }

  // Throws an error if the device's memory was too small for the objects so far.
  checkMemory() {
    const error = this.graphics.takeError();
    if (this.graphics.lost) throw new ContextLostError();
    if (error) throw new UnsupportedDeviceError(MEMORY_REASON);
  }

  // Uploads a field's table and decoder.
  async field(source) {
    const { gl, graphics } = this, { levels, decoder: { numbers, places } } = source;
    const table = await graphics.table([gl.RG32F, gl.RG, gl.FLOAT, 2], TEXTURE_WIDTH, source.table);
    source.table = null; // frees memory; the worker can decode it again
    const block = this.fitsBlock(numbers), floats = [gl.RGBA32F, gl.RGBA, gl.FLOAT, 4];
    const weights = block
      ? graphics.track(gl.createBuffer(), "Buffer")
      : await graphics.table(floats, WEIGHTS_TEXTURE_WIDTH, numbers);
    if (block) {
      gl.bindBuffer(gl.UNIFORM_BUFFER, weights);
      gl.bufferData(gl.UNIFORM_BUFFER, numbers, gl.STATIC_DRAW);
    }
    return { table, levels: new Uint32Array(levels.flat()), block, weights, places };
  }

  // Returns whether shaders read a decoder's numbers from a uniform block. Graphics devices read a uniform block far
  // faster than a texture; software renderers read a texture faster.
  fitsBlock({ byteLength }) {
    const { gl, graphics } = this;
    return byteLength <= gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE) && !graphics.isSoftware;
  }

  // Builds the fragment shaders of all passes. `constants` are for those that evaluate Gaussians.
  shaders(constants = {}) {
    const { gl, cells, layers, model: { geometry, radiance, sh, background, residualDegree } } = this;
    // Some devices cannot draw to as many targets as they report, because they limit the bytes per pixel.
    this.targets = Math.min(layers, gl.getParameter(gl.MAX_DRAW_BUFFERS), gl.getParameter(gl.MAX_COLOR_ATTACHMENTS));
    while (this.targets > 1 && !this.supports(this.targets)) this.targets >>= 1;
    const common = ({ levels, decoder: { numbers, places } }) => ({
      CELLS: cells, LEVELS: levels.length,
      BIAS_1: places.BIAS_1, INPUTS: places.INPUTS, WEIGHTS: places.WEIGHTS,
      ...(this.fitsBlock(numbers) ? { IN_BLOCK: 1 } : {}),
    });
    const deep = (field) => {
      const { BIAS_2, MATRIX_2, BIAS_3, MATRIX_3 } = field.decoder.places;
      return { ...common(field), BIAS_2, MATRIX_2, BIAS_3, MATRIX_3 };
    };
    const placed = { PLACES: 1, ...constants };
    const directions = radiance.decoder.places.INPUTS + 4 * cells * radiance.levels.length;
    const turned = { DIRECTIONS: directions, ...(sh ? { HARMONICS: 1 } : {}), ...constants };
    const residuals = residualDegree === undefined ? {} : { RESIDUAL_TERMS: (residualDegree + 1) ** 2 };
    const shaders = {
      geometry: buildFieldShader("geometry.frag", { ...deep(geometry), ...placed, ...residuals }),
      features: buildFieldShader("features.frag", { ...common(radiance), ...placed, CELLS: this.targets }),
      colors: buildFieldShader("colors.frag", { ...deep(radiance), ...turned, ...residuals }),
    };
    if (!background) return shaders;
    const backgroundConstants = { ...deep(radiance), ...placed, ...turned, BACKGROUND: 1 };
    for (const name of ["panorama", "sky"]) shaders[name] = buildFieldShader(`${name}.frag`, backgroundConstants);
    return shaders;
  }

  // Returns whether the device can draw to `count` layers in one pass.
  supports(count) {
    const { gl, graphics } = this;
    const framebuffer = graphics.framebuffer(...Array.from({ length: count }, (_, k) => [this.features, k]));
    const isComplete = gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE;
    graphics.free(framebuffer);
    return isComplete;
  }

  // Selects the program of a pass and binds the field's buffers.
  use(name, field) {
    const { gl, graphics, model } = this, p = this.programs[name];
    gl.useProgram(p.program);
    if (field.block) gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, field.weights);
    else graphics.bind(p, { u_weights: field.weights }, gl.TEXTURE_2D, WEIGHTS_TEXTURE_UNIT);
    if (p.u_levels) {
      graphics.bind(p, { u_table: field.table });
      gl.uniform4uiv(p.u_levels, field.levels);
      gl.uniform3fv(p.u_half_extent, model.halfExtent);
    }
    return p;
  }

  // Draws a pass to rows of its target. Adjacent rows are drawn together.
  passes(target, rows) {
    const wide = this.height === 1 ? this.count : this.width, sorted = [...rows].sort((a, b) => a - b);
    for (let k = 0, start = 0; k < sorted.length; k++) {
      if (sorted[k + 1] === sorted[k] + 1) continue;
      this.area(target, [this.width, this.height], [0, sorted[start], wide, k + 1 - start]);
      start = k + 1;
    }
  }

  // Draws a pass to a part (x, y, width, height in pixels) of its target.
  area(target, size, part) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, ...size);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...part);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  // Evaluates what no view changes: positions, opacities, scales, rotations and hash features of the Gaussians of rows.
  evaluate(rows) {
    const { gl, graphics, model, geometry, targets } = this;
    const fresh = rows.filter((row) => this.pending.delete(row));
    if (!fresh.length) return;
    const p = this.use("geometry", geometry);
    const { explicit, logits, pixelSizes } = this;
    graphics.bind(p, { u_explicit: explicit, u_logits: logits, u_pixel_sizes: pixelSizes }, gl.TEXTURE_2D, 1);
    if (this.shapeResiduals) graphics.bind(p, { u_residuals: this.shapeResiduals }, gl.TEXTURE_2D_ARRAY, 4);
    gl.uniform1i(p.u_product, model.product);
    gl.uniform1i(p.u_grows, model.grows);
    this.passes(this.geometryTarget, fresh);
    const q = this.use("features", this.radiance);
    graphics.bind(q, { u_places: this.places }, gl.TEXTURE_2D, 1);
    this.featureTargets.forEach((target, number) => {
      gl.uniform1i(q.u_first, number * targets);
      this.passes(target, fresh);
    });
    if (!this.pending.size) this.freeInputs();
  }

  // Creates the targets of `evaluate`.
  createTargets() {
    const { graphics, layers, targets } = this;
    this.target = graphics.framebuffer(this.colors);
    this.geometryTarget = graphics.framebuffer(this.places, this.shapes);
    this.featureTargets = Array.from({ length: Math.ceil(layers / targets) }, (_, number) => {
      const start = number * targets, count = Math.min(targets, layers - start);
      return graphics.framebuffer(...Array.from({ length: count }, (_, k) => [this.features, start + k]));
    });
  }

  // Frees the objects that only `evaluate` needs.
  freeInputs() {
    const { geometry, features } = this.programs, { explicit, pixelSizes, shapeResiduals } = this;
    const targets = [this.geometryTarget, ...this.featureTargets];
    this.freeTables(explicit, pixelSizes, shapeResiduals, ...targets, geometry.program, features.program);
  }

  // Frees what only `evaluate` needs of the fields, and other objects.
  freeTables(...others) {
    const { graphics, geometry, radiance, panorama } = this;
    if (!panorama) others.push(radiance.table);
    for (const object of [geometry.table, geometry.weights, ...others]) graphics.free(object);
  }

  // Draws a part (x, y, width, height in pixels) of a panorama.
  drawPanorama(target, size, part, eye) {
    const { gl } = this, p = this.use("panorama", this.radiance);
    gl.uniform2f(p.u_size, ...size);
    gl.uniform3fv(p.u_eye, eye);
    this.area(target, size, part);
  }

  // Draws a part of a grid of `size` nodes of the background of a view, where `needed` is 1. They are `stride` pixels
  // apart.
  drawSky(target, size, part, view, needed, stride) {
    const { gl, graphics } = this, p = this.use("sky", this.radiance);
    graphics.bind(p, { u_needed: needed }, gl.TEXTURE_2D, 1);
    gl.uniform1f(p.u_stride, stride);
    gl.uniform3fv(p.u_eye, view.eye);
    gl.uniformMatrix3fv(p.u_world, false, view.rows.flat()); // rows read as columns: transposed
    gl.uniform4f(p.u_intrinsics, view.fx, view.fy, view.cx, view.cy);
    this.area(target, size, part);
  }

  // Evaluates the colours of rows, and what else is missing of them.
  color(rows, eye) {
    this.evaluate(rows);
    const { gl, graphics } = this, p = this.use("colors", this.radiance);
    graphics.bind(p, { u_places: this.places, u_logits: this.logits });
    graphics.bind(p, { u_features: this.features }, gl.TEXTURE_2D_ARRAY, 2);
    if (this.colorResiduals) graphics.bind(p, { u_residuals: this.colorResiduals }, gl.TEXTURE_2D_ARRAY, 3);
    gl.uniform3fv(p.u_eye, eye);
    for (const row of rows) this.rows.colored(row, eye);
    this.passes(this.target, rows);
  }

  // Colours, while the view moves, rows without colours and then the stalest rows, for about `ms`. Then evaluates the
  // background as at rest if that is quick and `follows`, or else draws the panorama for about `ms`.
  recolor(view, margin, ms, follows) {
    if (!this.isReady) return;
    const { visible, rows } = this.rows.stale(frustumPlanes(view, margin), view.eye, MAX_FRESH_TURN_RADIANS);
    const maxRows = Math.min(this.pace.within(ms), Math.ceil(visible / MOVING_ROWS_DIVISOR));
    if (rows.length) this.color(rows.slice(0, maxRows), view.eye);
    const { panorama, sky } = this;
    if (follows && sky?.follow(view, panorama.texelMs, MOVING_SKY_RATIO * ms)) return;
    panorama?.advance(view, ms);
  }

  // Colours all stale rows in view while `goOn()` is true. If `exact`, any turn of the viewing direction makes colours
  // stale. `report` is called with the fraction done. Returns {rows: their number, done: whether all were coloured}.
  async coloured(view, margin, { goOn, report, exact = false }) {
    const { rows } = this.rows.stale(frustumPlanes(view, margin), view.eye, exact ? 0 : MAX_FRESH_TURN_RADIANS);
    return { rows: rows.length, done: await this.coloring(rows, view.eye, { goOn, report }) };
  }

  // Colours rows in slices while `goOn()` is true. Returns whether all were coloured.
  coloring(rows, eye, { goOn, report }) {
    const work = (first, last) => this.color(rows.slice(first, last), eye);
    return this.pace.run(this.graphics, rows.length, work, { goOn, report });
  }

  // Completes the picture of a still view while `goOn()` is true: colours all rows in view, and evaluates the
  // background. `blend(view)` blends the splats of a view and returns their picture. `changed` is called when the
  // picture has improved, and returns a promise that resolves when it is shown. Returns whether it is complete.
  async complete(view, margin, { blend, goOn = () => true, changed = () => {}, exact = false }) {
    if (!this.isReady) return false;
    let shownAt = performance.now(), pause = FIRST_REFRESH_MS;
    const report = async () => {
      if (performance.now() < shownAt + pause) return;
      await changed(); // a browser that shows a canvas waits for all work on it
      [shownAt, pause] = [performance.now(), 2 * pause];
    };
    let { rows, done } = await this.coloured(view, margin, { goOn, report, exact });
    if (done && this.panorama) { // a frame is drawn only afterwards, because showing it would wait for this work
      if (!this.sky) await this.prepareSky();
      this.sky.begin(view, blend);
      done = await this.sky.complete({ goOn, changed });
    }
    if (rows) changed();
    return done;
  }

  // Evaluates, while `goOn()` is true, what other views will need: the panorama, and colours of rows out of view.
  async lookAhead(view, goOn) {
    await this.panorama?.complete(view, goOn);
    await this.coloring(this.rows.fresh(), view.eye, { goOn });
  }

  dispose() {
    this.graphics.dispose();
  }
}

// Builds the shader of a pass from constants, field.glsl and the pass' own text. Lines that begin with EACH are
// repeated for each cell of hidden units.
function buildFieldShader(name, constants) {
  const lines = Object.entries(constants).map(([key, value]) => `#define ${key} ${value}`);
  const cells = Array.from({ length: constants.CELLS }, (_, cell) => cell);
  const text = `${readText("field.glsl")}\n${readText(name)}`;
  const whole = text.replace(/^EACH (.*)$/gm, (_, line) => cells.map((cell) => line.replaceAll("$", cell)).join("\n"));
  return ["#version 300 es", ...lines, whole].join("\n");
}
