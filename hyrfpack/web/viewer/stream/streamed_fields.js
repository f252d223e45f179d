// Evaluates and draws the chunks of a scene folder. They lie in the rows of one set of textures, so that all of them
// are sorted and blended together. One level of a chunk fades into another over several frames. Each part of the scene
// has fields of its own; those of the first part are this object.

import { SHAPE_RESIDUALS } from "../../hyrf/residuals.js";
import { Fields } from "../fields.js";
import { readText } from "../texts.js";
import { PartFields } from "./part_fields.js";
import { eachRun } from "./row_pool.js";

const FADE_MS = 400;
// Limits of the part of a fade that one frame adds. Slow devices, too, show fades in several steps, and never stop
// within a fade.
const MAX_FADE_STEP = 1 / 3, MIN_FADE_STEP = 1 / 20;
const MAX_FADE_STEP_RMS = 10 ** (-30 / 20); // the change between two frames of fades: a PSNR of 30 dB
// A picture changes by up to 1.7 times as much in a step as in equal steps, and by up to twice as much as predicted.
const FADE_RMS_RATIO = 1.7 * 2;
const MAX_FRAME_WAIT_MS = 5000; // where no frames are drawn for this time, as in a hidden page, fades end at once
const POLL_MS = 30;
const MAX_BATCH_ROWS = 256; // of levels that are evaluated together: the first of them waits for the last

export class StreamedFields extends Fields {
  // `model` has the fields of the first part and the size of the textures. `parts` are further parts, {part: number,
  // model, place}. `chunks` are the levels that are drawn at once. `events` is a StreamLoader.
  constructor(gl, model, parts, chunks, events) {
    super(gl, { ...model, balls: new Float32Array(4 * model.height).fill(NaN) });
    Object.assign(this, { firstParts: parts, chunks, events });
    // Number of a further part -> its PartFields.
    this.further = new Map(parts.map(({ part, model, place }) => [part, new PartFields(gl, model, place, this)]));
    this.ready = new Map(); // number of a further part -> the promise that it is ready, of whether it can be drawn
    this.residuals = new Map(); // degree -> the textures of the residuals of all parts of this degree
    this.compiled = new Map(); // text of shaders -> the promise of their programs, which equal parts share
    this.rowWeights = new Float32Array(2 * this.height); // of each row, its weight and the number of its part
    this.usedHeight = 1; // rows from here on were never used
    this.fades = new Map(); // number of a chunk -> the last `swap` of it, its `part`, and whether it `isSorted`
    this.fadedAt = 0; // when the fades last went on
    this.arrivals = []; // levels that are to be uploaded
    this.isUploading = false;
    this.isDisposed = false;
  }

  // Creates the textures of the Gaussians, and uploads those of the first levels.
  async uploadGaussians() {
    const { gl, graphics, width, height } = this;
    const create = (format) => graphics.texture(gl.TEXTURE_2D, format, width, height);
    [this.explicit, this.logits, this.pixelSizes] = [gl.RGBA32F, gl.RGBA32F, gl.R32F].map(create);
    Object.assign(this, this.createResiduals(this.model.residualDegree));
    this.weights = graphics.texture(gl.TEXTURE_2D, gl.RG32F, 1, height);
    for (const chunk of this.chunks) {
      this.upload(chunk);
      this.setWeights(chunk.rows, 1);
      await graphics.whenDone();
    }
    this.uploadWeights();
  }

  // Returns the textures of the residuals of a degree, which are created once; none if it is undefined.
  createResiduals(degree) {
    const { gl, graphics, width, height, residuals } = this;
    if (degree === undefined) return {};
    if (!residuals.has(degree)) {
      const create = (format, depth) => graphics.texture(gl.TEXTURE_2D_ARRAY, format, width, height, depth);
      const shapeResiduals = create(gl.RGBA32F, Math.ceil(SHAPE_RESIDUALS / 3));
      residuals.set(degree, { shapeResiduals, colorResiduals: create(gl.RGBA16F, (degree + 1) ** 2) });
    }
    return residuals.get(degree);
  }

  // Creates textures without an estimate: Gaussians that are not evaluated are transparent.
  async uploadEstimate() {
    const { gl, graphics, width, height } = this;
    const create = (format) => graphics.texture(gl.TEXTURE_2D, format, width, height);
    [this.places, this.shapes, this.colors] = [gl.RGBA32UI, gl.RGBA32UI, gl.RG32UI].map(create);
  }

  async prepare(eye) {
    this.eye = eye;
    await super.prepare();
  }

  async prepareFields() {
    await super.prepareFields();
    this.isReady = false;
    this.pending = new Set(this.chunks.flatMap(({ rows }) => rows));
    this.chunks = null; // frees memory
    for (const part of this.firstParts) this.addPart(part);
    await Promise.all(this.ready.values());
    this.isReady = true;
  }

  // Prepares the fields of a further part, or uploads their tables again; without a model, frees these. The part's
  // levels are drawn once it is ready.
  addPart({ part, model, place }) {
    const fields = this.further.get(part) ?? new PartFields(this.gl, model, place, this);
    this.further.set(part, fields);
    this.ready.set(part, this.preparePart(part, fields, model));
  }

  // Returns whether a part can be drawn, as it could before. Its tables are freed after rows that were never in view
  // are evaluated.
  async preparePart(part, fields, model) {
    try {
      if ((await this.ready.get(part)) === false) return false;
      if (model) await fields.prepareFields(model);
      else if (await this.coloring([...this.pending], this.eye, { goOn: () => !this.isDisposed })) fields.freeTables();
      return true;
    } catch (error) {
      if (!this.graphics.lost) this.events.post({ unusable: { part, reason: error.message } });
      return false;
    }
  }

  // Returns the programs of shaders, which are compiled once.
  compileOnce(shaders) {
    const { graphics, compiled } = this, key = Object.values(shaders).join();
    if (!compiled.has(key)) {
      const programs = {}, vertexText = readText("whole.vert");
      for (const name of Object.keys(shaders)) programs[name] = graphics.compile(vertexText, shaders[name]);
      compiled.set(key, graphics.compiled(programs).then(() => programs));
    }
    return compiled.get(key);
  }

  // Evaluates the colours of rows by the fields of their parts.
  color(rows, eye) {
    const partOf = (row) => this.rowWeights[2 * row + 1];
    for (const part of new Set(rows.map(partOf))) {
      const own = rows.filter((row) => partOf(row) === part), fields = this.further.get(part);
      if (!fields) super.color(own, eye);
      else if (fields.isReady) fields.color(own, eye);
      else for (const row of own) this.rows.colored(row, eye); // it cannot be drawn
    }
  }

  // Uploads the Gaussians of a level to its rows.
  upload(level) {
    const { part, rows, explicit, logits, pixelSizes, balls } = level;
    const { gl, width } = this, floats = [[this.explicit, gl.RGBA, 4, explicit], [this.logits, gl.RGBA, 4, logits]];
    for (const [texture, format, size, numbers] of [...floats, [this.pixelSizes, gl.RED, 1, pixelSizes]]) {
      gl.bindTexture(gl.TEXTURE_2D, texture);
      eachRun(rows, (first, count, place) => {
        const part = numbers.subarray(place * width * size, (place + count) * width * size);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, width, count, format, gl.FLOAT, part);
      });
    }
    this.uploadResiduals(level);
    rows.forEach((row, place) => this.rows.replace(row, balls.subarray(4 * place, 4 * place + 4)));
    for (const row of rows) this.rowWeights[2 * row + 1] = part;
    this.usedHeight = Math.max(this.usedHeight, rows.at(-1) + 1);
  }

  // Uploads the residuals of a level, if it has any.
  uploadResiduals({ part, rows, shapeResiduals, colorResiduals }) {
    if (!shapeResiduals) return;
    const { gl, width } = this, layer = 4 * width * rows.length;
    const { model } = this.further.get(part) ?? this, textures = this.createResiduals(model.residualDegree);
    const pairs = [[textures.shapeResiduals, shapeResiduals], [textures.colorResiduals, colorResiduals]];
    for (const [texture, numbers] of pairs) {
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
      for (let start = 0, k = 0; start < numbers.length; start += layer, k++) {
        eachRun(rows, (first, count, place) => {
          const piece = numbers.subarray(start + 4 * width * place, start + 4 * width * (place + count));
          gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, first, k, width, count, 1, gl.RGBA, gl.FLOAT, piece);
        });
      }
    }
  }

  // Uploads a level that has arrived, and evaluates it, after those before it. Levels that arrive in the meantime are
  // evaluated together, because on slow devices each wait for the device is also a wait for frames.
  async arrive(arrival) {
    this.arrivals.push(arrival);
    if (this.isUploading) return;
    this.isUploading = true;
    const goOn = () => !this.isDisposed && !this.graphics.lost;
    while (this.arrivals.length && goOn()) {
      const batch = await this.whenReady(this.takeArrivals()), rows = batch.flatMap((level) => level.rows);
      for (const level of batch) this.upload(level);
      for (const row of rows) this.pending.add(row);
      if (!(await this.coloring(rows, this.eye, { goOn }))) continue;
      for (const { number, chunk, level } of batch) this.events.post({ uploaded: { number, chunk, level } });
    }
    this.isUploading = false;
  }

  // Waits for the parts that levels belong to. Returns the levels whose part can be drawn.
  async whenReady(levels) {
    const areReady = await Promise.all(levels.map(({ part }) => this.ready.get(part)));
    return levels.filter((_, place) => areReady[place] !== false);
  }

  // Returns the first levels that have arrived: one, or several of at most MAX_BATCH_ROWS rows.
  takeArrivals() {
    let rows = 0;
    const end = this.arrivals.findIndex((level) => (rows += level.rows.length) > MAX_BATCH_ROWS);
    return this.arrivals.splice(0, end < 0 ? Infinity : Math.max(1, end));
  }

  // Starts to fade from one level to another one.
  swap(swap) {
    if (!this.fades.size) this.fadedAt = performance.now();
    this.fades.set(swap.chunk, { ...swap, part: 0, isSorted: false });
  }

  // Lets the fades begin whose new levels are in the order that has arrived.
  receiveOrder() {
    for (const fade of this.fades.values()) fade.isSorted = true;
  }

  // Continues the fades by a frame, by at most `largestStep`. Returns whether the picture has changed.
  fade(largestStep) {
    const fades = [...this.fades.values()].filter(({ isSorted }) => isSorted), now = performance.now();
    if (!fades.length) return false;
    const step = Math.min(largestStep ?? largestFadeStep(fades), Math.max(now - this.fadedAt, 1) / FADE_MS);
    this.fadedAt = now;
    for (const fade of fades) {
      fade.part = Math.min(1, fade.part + step);
      const weight = smoothStep(fade.part);
      this.setWeights(fade.from, 1 - weight);
      this.setWeights(fade.to, weight);
      if (fade.part === 1) this.endFade(fade);
    }
    this.uploadWeights();
    if (this.sky) this.sky.key = null; // another part of the background may be visible
    return true;
  }

  endFade({ number, chunk }) {
    this.fades.delete(chunk);
    this.events.post({ faded: { number, chunk } });
  }

  setWeights(rows, weight) {
    for (const row of rows) this.rowWeights[2 * row] = weight;
  }

  uploadWeights() {
    const { gl, rowWeights, usedHeight } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.weights);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 1, usedHeight, gl.RG, gl.FLOAT, rowWeights.subarray(0, 2 * usedHeight));
  }

  // For these methods see Fields.

  recolor(view, margin, ms, follows) {
    if (follows) this.look(view, true);
    super.recolor(view, margin, ms, follows);
  }

  // Waits until the levels that suit the view are drawn. Meanwhile frames may have looked at another view.
  async complete(view, margin, options) {
    const { goOn = () => true, changed = () => {}, exact = false } = options;
    const isDone = () => this.events.isComplete(this.look(view)) && !this.isUploading && !this.fades.size;
    while (!isDone()) {
      const { rows } = await this.coloured(view, margin, { goOn, exact });
      if (rows) changed();
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
      if (!goOn() || this.isDisposed || this.events.failure) return false;
      if (this.fades.size && performance.now() > this.fadedAt + MAX_FRAME_WAIT_MS) this.endFades();
    }
    return super.complete(view, margin, options);
  }

  // Ends all fades at once.
  endFades() {
    this.receiveOrder();
    this.fadedAt = 0;
    this.fade(1);
    this.events.redraw();
  }

  // Chooses levels for a view, at most a few times a second if it `isMoving`. Returns the number of the choice.
  look(view, isMoving = false) {
    this.eye = view.eye;
    return this.events.look(view, isMoving);
  }

  // Rows out of view were coloured when they arrived.
  async lookAhead(view, goOn) {
    await this.panorama?.complete(view, goOn);
  }

  // Does nothing: more levels may arrive.
  freeInputs() {}

  dispose() {
    this.isDisposed = true;
    for (const fields of this.further.values()) fields.dispose();
    super.dispose();
  }
}

// Returns the largest step of fades that changes the picture by no more than MAX_FADE_STEP_RMS, by their predicted
// errors.
function largestFadeStep(fades) {
  const rms = Math.sqrt(fades.reduce((sum, { mse }) => sum + mse, 0));
  return Math.min(MAX_FADE_STEP, Math.max(MIN_FADE_STEP, MAX_FADE_STEP_RMS / (FADE_RMS_RATIO * rms)));
}

// Returns the weight of the new level at a part of a fade. It rises slowly at both ends, where a small weight of opaque
// Gaussians before others changes the picture most.
const smoothStep = (part) => part ** 3 * (10 - 15 * part + 6 * part ** 2);
