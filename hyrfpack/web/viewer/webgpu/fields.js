// Evaluates a model on a WebGPU device: like Fields, whose order of work it shares, with buffers instead of textures.

import { TEXTURE_WIDTH } from "../constants.js";
import { Fields } from "../fields.js";
import { DevicePanorama, DeviceSky, countGroups } from "./background.js";
import { DeviceObjects } from "./device.js";
import { RadixSort } from "./radix_sort.js";
import { buildFieldShader, readShader } from "./shaders.js";

const GAUSSIANS_PER_GROUP = 64; // of the shaders' workgroups
const BYTES_PER_VECTOR = 16;
const LEVELS_PER_VECTOR = 4; // of features, two halves a level
const VECTORS_PER_SPLAT = 2; // Splat in project.wgsl

const countFeatureVectors = ({ radiance: { levels } }) => Math.ceil(levels.length / LEVELS_PER_VECTOR);

export class DeviceFields extends Fields {
  // Returns whether a device holds a model that pack.js has packed.
  static fits({ limits: { maxStorageBufferBindingSize, maxUniformBufferBindingSize } }, model) {
    const { height, geometry, radiance, residualDegree = 0 } = model, fields = [geometry, radiance];
    const vectors = Math.max(countFeatureVectors(model), VECTORS_PER_SPLAT, (residualDegree + 1) ** 2);
    const tables = fields.map(({ table }) => table.byteLength);
    const largest = Math.max(BYTES_PER_VECTOR * TEXTURE_WIDTH * height * vectors, ...tables);
    const decoders = fields.map(({ decoder: { numbers } }) => numbers.byteLength);
    return largest <= maxStorageBufferBindingSize && Math.max(...decoders) <= maxUniformBufferBindingSize;
  }

  // `sortPipelines` are from RadixSort.compile.
  constructor(device, model, sortPipelines) {
    super(null, model, new DeviceObjects(device));
    this.sortPipelines = sortPipelines;
  }

  // Whether frames are sorted on the device, so that the worker need not sort.
  get sortsItself() {
    return true;
  }

  async prepare() {
    const { graphics, model, model: { estimate, coarseBackground, count } } = this, { device } = graphics;
    graphics.takeError(); // clears earlier errors
    this.places = graphics.upload(estimate.places);
    this.shapes = graphics.upload(estimate.shapes);
    this.colors = graphics.upload(estimate.colors);
    this.keys = graphics.buffer(4 * count);
    this.splats = graphics.buffer(VECTORS_PER_SPLAT * BYTES_PER_VECTOR * count);
    this.sort = new RadixSort(graphics, this.sortPipelines, this.keys, count);
    model.estimate = null; // frees memory; the worker can estimate them again
    if (!model.background) return;
    const { width, height, rgba } = coarseBackground, { TEXTURE_BINDING, COPY_DST } = GPUTextureUsage;
    const coarse = graphics.texture("rgba8unorm", [width, height], TEXTURE_BINDING | COPY_DST);
    device.queue.writeTexture({ texture: coarse }, rgba, { bytesPerRow: 4 * width }, [width, height]);
    this.panorama = new DevicePanorama(graphics, model, coarse, (...area) => this.drawPanorama(...area));
    model.coarseBackground = null;
  }

  async prepareFields() {
    const { graphics, height } = this, programs = {};
    await graphics.whenDone();
    graphics.takeError();
    this.uploadModel();
    const { sky, ...shaders } = this.shaders(), names = Object.keys(shaders);
    for (const name of names) programs[name] = await graphics.computePipeline(`${name}.wgsl`, shaders[name]);
    this.skyShader = sky;
    this.programs = programs;
    this.pending = new Set(Array.from({ length: this.count ? height : 0 }, (_, row) => row)); // not evaluated yet
    if (this.panorama) {
      const enlarge = await graphics.computePipeline("enlarge.wgsl", readShader("enlarge.wgsl"));
      const wide = { addressModeU: "repeat", magFilter: "linear", minFilter: "linear" };
      this.panorama.begin(enlarge, graphics.device.createSampler(wide));
    }
    await graphics.whenDone();
    this.checkMemory();
    this.isReady = true;
  }

  // Creates the buffers of the fields, of the Gaussians and of what is evaluated for them.
  uploadModel() {
    const { graphics, model, width, height } = this, { UNIFORM } = GPUBufferUsage, capacity = width * height;
    const residuals = (numbers) => (numbers ? graphics.upload(numbers) : graphics.buffer(0));
    const buffersOf = ({ table, levels, decoder: { numbers } }) => [
      graphics.upload(numbers, UNIFORM),
      graphics.upload(table),
      graphics.upload(new Uint32Array(levels.flat()), UNIFORM),
    ];
    this.geometry = buffersOf(model.geometry);
    this.radiance = buffersOf(model.radiance);
    this.gaussians = graphics.upload(model.explicit);
    this.logits = graphics.upload(model.logits);
    this.pixelSizes = graphics.upload(model.pixelSizes);
    this.shapeResiduals = residuals(model.shapeResiduals);
    this.colorResiduals = residuals(model.colorResiduals);
    this.features = graphics.buffer(BYTES_PER_VECTOR * capacity * countFeatureVectors(model));
    this.rowList = graphics.buffer(4 * height);
    this.eye = graphics.buffer(16, UNIFORM);
    this.tile = graphics.buffer(96, UNIFORM); // of panorama.wgsl or sky.wgsl
    for (const name of ["explicit", "logits", "pixelSizes", "shapeResiduals", "colorResiduals"]) model[name] = null;
  }

  // Builds the shaders of all passes.
  shaders() {
    const { cells, width, height, model } = this, { geometry, radiance, residualDegree } = model;
    const directions = radiance.decoder.places.INPUTS + 4 * cells * radiance.levels.length;
    const constants = ({ levels, decoder: { places } }) => ({
      ...Object.fromEntries(Object.entries(places).map(([name, place]) => [name, `${place}u`])),
      CELLS: `${cells}u`, LEVELS: `${levels.length}u`, DIRECTIONS: `${directions}u`, HARMONICS: model.sh,
      HALF_EXTENT: `vec3f(${[...model.halfExtent]})`, WIDTH: `${width}u`, CAPACITY: `${width * height}u`,
      RESIDUAL_TERMS: `${residualDegree === undefined ? 0 : (residualDegree + 1) ** 2}u`,
      PRODUCT: Boolean(model.product), GROWS: Boolean(model.grows),
    });
    const names = ["features", "colors", ...(model.background ? ["panorama", "sky"] : [])];
    return {
      geometry: buildFieldShader("geometry.wgsl", constants(geometry)),
      ...Object.fromEntries(names.map((name) => [name, buildFieldShader(`${name}.wgsl`, constants(radiance))])),
    };
  }

  // Runs a pass for the Gaussians of rows. `resources` are those of its bindings.
  runRows(name, rows, resources) {
    const { graphics, height, width, count } = this, wide = height === 1 ? count : width;
    graphics.write(this.rowList, Uint32Array.from(rows));
    graphics.compute(this.programs[name], resources, [Math.ceil(wide / GAUSSIANS_PER_GROUP), rows.length]);
  }

  evaluate(rows) {
    const { geometry, radiance: [, ...grid], gaussians, logits, pixelSizes, shapeResiduals, rowList, features } = this;
    const fresh = rows.filter((row) => this.pending.delete(row));
    if (!fresh.length) return;
    const written = [rowList, this.places, this.shapes];
    this.runRows("geometry", fresh, [...geometry, gaussians, logits, pixelSizes, shapeResiduals, ...written]);
    this.runRows("features", fresh, [, ...grid, gaussians, rowList, features]);
    if (!this.pending.size) this.freeInputs();
  }

  // Frees the objects that only `evaluate` needs.
  freeInputs() {
    const { graphics, geometry, pixelSizes, shapeResiduals, radiance: [, table], panorama } = this;
    for (const buffer of [...geometry, pixelSizes, shapeResiduals]) graphics.free(buffer);
    if (!panorama) graphics.free(table);
  }

  color(rows, eye) {
    this.evaluate(rows);
    const { graphics, radiance: [weights], gaussians, logits, features, colorResiduals, rowList, colors } = this;
    if (!rows.length) return;
    graphics.write(this.eye, Float32Array.of(...eye, 0));
    const resources = [weights, , , gaussians, logits, features, colorResiduals, rowList, this.eye, colors];
    this.runRows("colors", rows, resources);
    for (const row of rows) this.rows.colored(row, eye);
  }

  drawPanorama(target, size, part, eye) {
    this.drawTile("panorama", part, [...eye, 0], [target]);
  }

  drawSky(target, size, part, view, needed, stride) {
    const rows = view.rows.flatMap((row) => [...row, 0]);
    this.drawTile("sky", part, [...view.eye, stride, ...rows, view.fx, view.fy, view.cx, view.cy], [needed, target]);
  }

  // Runs a pass for a part (x, y, width, height) of a picture. `numbers` follow the part in its uniforms.
  drawTile(name, [x, y, width, height], numbers, resources) {
    const { graphics, radiance, tile, programs } = this;
    const uniforms = Float32Array.of(0, 0, 0, 0, ...numbers);
    new Uint32Array(uniforms.buffer).set([x, y, width, height]);
    graphics.write(tile, uniforms);
    graphics.compute(programs[name], [...radiance, tile, ...resources], countGroups([width, height]));
  }

  async prepareSky() {
    const { graphics, programs, model: { backgroundSpacing } } = this;
    programs.sky = await graphics.computePipeline("sky.wgsl", this.skyShader);
    const needed = await graphics.computePipeline("needed.wgsl", readShader("needed.wgsl"));
    this.sky = new DeviceSky(graphics, needed, backgroundSpacing, (...area) => this.drawSky(...area));
  }
}
