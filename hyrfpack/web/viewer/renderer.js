// Draws splats with WebGL 2 in three passes: project (one fragment per splat), blend (one quad per splat, farthest
// first) and resolve (composite over the background, and apply the gains of the exposure).

import { Graphics } from "./graphics.js";
import { BACKGROUND_RADIUS, TEXTURE_WIDTH } from "./constants.js";
import { Fields } from "./fields.js";
import { MergedFields } from "./merged_fields.js";
import { Splats } from "./splats.js";
import { viewFromPlace } from "../hyrf/places.js";

const MAX_READ_SIDE_PIXELS = 8192; // the limit of pictures that are read back
const QUADS_PER_INSTANCE = 1024; // drivers are slow with many small instances
const MAX_ABS_LOG_GAIN = 8; // in files
const LOW_PASS_VARIANCE = 0.3; // px^2, as in hyrfpack render
export const ALPHA_MIN = 1 / 255; // splats are not drawn where their alpha is less, as in hyrfpack render
export const REDUCED_ALPHA_MIN = 1 / 72; // of a picture at a part of the resolution
const ROWS_PER_COLUMN = 2; // a picture at a part of the resolution keeps this many times as many rows as columns
const WARM_UP_VIEW = {
  width: 1, height: 1, fx: 1, fy: 1, cx: 0.5, cy: 0.5,
  rows: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], eye: [0, 0, 0], translation: [0, 0, 0],
};

export class Renderer {
  // Throws an Error with a message for the user if the browser has no WebGL 2.
  constructor(canvas) {
    const contextOptions = { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" };
    const gl = canvas.getContext("webgl2", contextOptions);
    if (!gl) throw new Error("This page needs WebGL 2, which this browser lacks; enable it or use another browser.");
    this.gl = gl;
    this.graphics = new Graphics(gl);
    const side = gl.getParameter(gl.MAX_TEXTURE_SIZE), sides = gl.getParameter(gl.MAX_VIEWPORT_DIMS) ?? [0, 0];
    this.largest = [...sides].map((limit) => Math.min(limit, side)); // the maximum width and height of a picture
    // Thousands of splats are blended, and 8 bits would round the faint ones to zero.
    this.fine = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    gl.getExtension("WEBGL_provoking_vertex")?.provokingVertexWEBGL(0x8e4d); // the first vertex: fast on all devices
    this.project = this.graphics.program("whole.vert", "project.frag");
    this.blend = this.graphics.program("blend.vert", "blend.frag");
    this.resolve = this.graphics.program("whole.vert", "resolve.frag");
    this.ready = null; // a promise that resolves when the programs are compiled
    this.surfaces = { colors: null, logs: null }; // of blended splats, {texture, target, size}
    this.frame = null; // the picture of the last frame, {texture, target, size}
    this.finished = false; // whether `frame` must be copied to the canvas

    // Two triangles for each of the quads of one instance.
    const corner = (k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6];
    const corners = Uint32Array.from({ length: 6 * QUADS_PER_INSTANCE }, (_, k) => corner(k));
    this.quads = this.graphics.track(gl.createVertexArray(), "VertexArray");
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.graphics.track(gl.createBuffer(), "Buffer"));
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null); // the other passes need no vertices

    this.unused = { u_colors: this.graphics.texture(gl.TEXTURE_2D, gl.RG32UI, 1, 1) };
    this.noLayers = { u_harmonics: this.graphics.texture(gl.TEXTURE_2D_ARRAY, gl.RGBA32UI, 1, 1, 1) };
    this.plain = this.graphics.texture(gl.TEXTURE_2D, gl.RGBA8, 1, 1);
    this.content = null;
    this.fence = null; // is signalled when the last frame is drawn
    this.isSorted = false; // whether the content has got an order
    this.drawn = 0;
  }

  // Finishes the programs. Throws an Error if the driver refuses them.
  prepare() {
    const { project, blend, resolve } = this;
    return (this.ready ??= this.graphics.compiled({ project, blend, resolve }).then(() => this.warmUp()));
  }

  // Draws a picture of one splat, because drivers finish programs only when they first draw.
  warmUp() {
    const { gl } = this, graphics = new Graphics(gl);
    const [places, shapes, colors] = [gl.RGBA32UI, gl.RGBA32UI, gl.RG32UI].map((format) =>
      graphics.texture(gl.TEXTURE_2D, format, 1, 1));
    const content = { graphics, width: 1, height: 1, count: 1, antialiased: false, places, shapes, colors };
    const picture = { width: 1, height: 1, rgba: new Uint8Array(4) };
    this.show(this.stage(content, { kind: "hyrf", near: 0, tolerance: 0, solid: [0, 0, 0] }, picture));
    this.sorted(new Uint32Array(1), 1);
    this.draw(WARM_UP_VIEW, 1, {});
    graphics.dispose();
    Object.assign(this, { content: null, finished: false });
  }

  // Returns an object that evaluates the models of a content, or holds its splats.
  makeContent({ models, splats }) {
    if (!models) return new Splats(this.gl, splats);
    return models.length > 1 ? new MergedFields(this.gl, models) : new Fields(this.gl, models[0]);
  }

  // Draws with another interface of the device from now on, if there is one. Returns whether that is a change, after
  // which contents must be made again.
  fallBack() {
    return false;
  }

  // Creates all objects for drawing a content (`Splats` or `Fields`), which `show` uses. They are freed with the
  // content. `picture` is the background's picture (see `background`), or null.
  stage(content, scene, picture) {
    const { gl } = this, { graphics, width = TEXTURE_WIDTH, height } = content, size = [width, height];
    const order = graphics.texture(gl.TEXTURE_2D, gl.R32UI, ...size);
    const shapes = graphics.texture(gl.TEXTURE_2D, gl.RGBA32UI, ...size);
    const appearances = graphics.texture(gl.TEXTURE_2D, gl.RGBA32UI, ...size);
    const projection = graphics.framebuffer(shapes, appearances);
    const background = picture ? this.background(graphics, picture) : null;
    return { content, scene, order, shapes, appearances, projection, tableSize: size, picture: background };
  }

  // Selects a staged content for drawing, once it has got an order. Returns the previous one, or null.
  show(staged) {
    const { content } = this;
    Object.assign(this, staged, { isSorted: false, drawn: 0 });
    return content;
  }

  // Creates the texture of an equirectangular picture: an image, or {width, height, rgba}.
  background(graphics, picture) {
    const { gl } = this;
    const size = [picture.naturalWidth ?? picture.width, picture.naturalHeight ?? picture.height];
    const texture = graphics.texture(gl.TEXTURE_2D, gl.RGBA8, ...size);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    if (picture.rgba) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ...size, gl.RGBA, gl.UNSIGNED_BYTE, picture.rgba);
    else gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    graphics.setPanoramic(texture);
    return texture;
  }

  // Uploads an order: indices of splats, farthest first, of which the first `drawn` are drawn. It fills whole rows of
  // the texture.
  sorted(order, drawn) {
    const { gl, tableSize: [width] } = this, rows = Math.ceil(drawn / width);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    this.isSorted = true;
    this.drawn = drawn;
  }

  // Draws a frame of a view at `scale` times its resolution. `exposure` is from exposure.js. `present` shows it, once
  // `busy` is false: the browser waits for the device to show a canvas, and would keep the page waiting. With twice as
  // many rows, the picture is much nearer to the reduced picture at full resolution, because a pixel where several
  // small splats meet is not what their mean opacities make of it.
  draw(view, scale, exposure) {
    const { gl } = this, reduced = reduceView(view, scale);
    this.blendAll(reduced, exposure);
    this.over(reduced, this.frameTarget(reduced.width, reduced.height), exposure, view);
    gl.deleteSync(this.fence);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.finished = true;
  }

  // Copies the last frame to the canvas. Returns whether there was one that the canvas did not show.
  present() {
    if (!this.finished) return false;
    const { gl, frame: { target, size: [width, height] } } = this;
    const { drawingBufferWidth: w, drawingBufferHeight: h } = gl;
    const filter = width === w && height === h ? gl.NEAREST : gl.LINEAR;
    this.finished = false;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, target);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, h, w, 0, gl.COLOR_BUFFER_BIT, filter); // row 0 is on top
    return true;
  }

  // Returns a target of this size for frames.
  frameTarget(width, height) {
    const { gl, graphics, frame } = this;
    if (frame?.size[0] === width && frame.size[1] === height) return frame.target;
    for (const object of [frame?.target, frame?.texture]) graphics.free(object);
    const texture = graphics.texture(gl.TEXTURE_2D, gl.RGBA8, width, height);
    this.frame = { texture, target: graphics.framebuffer(texture), size: [width, height] };
    return this.frame.target;
  }

  // Draws a view at once. Returns a promise of its RGB bytes, top row first. Throws an Error with a message for the
  // user on failure. Before, the device should have nothing to do, because the page waits for it here.
  async read(view, exposure) {
    const { gl, graphics } = this, { width, height } = view;
    this.check(view);
    gl.getError(); // clears earlier errors
    const texture = graphics.texture(gl.TEXTURE_2D, gl.RGBA8, width, height);
    const target = graphics.framebuffer(texture);
    this.paint(view, { texture, target }, exposure);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    const rgba = new Uint8Array(4 * width * height), buffer = graphics.track(gl.createBuffer(), "Buffer");
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, rgba.length, gl.STREAM_READ);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, 0);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    await graphics.whenDone();
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, rgba);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    const refused = gl.getError() !== gl.NO_ERROR && !gl.isContextLost();
    for (const object of [target, texture, buffer]) graphics.free(object);
    if (width > gl.drawingBufferWidth || height > gl.drawingBufferHeight) this.release();
    if (refused) throw new Error(`The device cannot draw a picture of ${width} x ${height}; ask for a smaller one.`);
    return rgba.filter((_, place) => (place & 3) !== 3);
  }

  // Draws a view to a {texture, target} of its size.
  paint(view, { target }, exposure) {
    this.blendAll(view, exposure);
    this.over(view, target, exposure);
  }

  // Throws an Error with a message for the user if a view's picture is too large.
  check({ width, height }) {
    const [wide, high] = this.largest.map((side) => Math.min(side, MAX_READ_SIDE_PIXELS));
    if (width <= wide && height <= high) return;
    throw new Error(`Pictures here are ${wide} x ${high} pixels at most; ask for a smaller one.`);
  }

  // Returns the mean depth of the splats at a pixel, or null if there are none. Depths z are blended as z / (z +
  // scale), so `scale` should be a typical depth.
  pick(view, x, y, scale) {
    const { gl } = this;
    const place = [Math.floor(x), Math.floor(y), 1, 1];
    this.splats(view, { pick: scale }, place);
    const pixel = this.fine ? new Float32Array(4) : new Uint8Array(4);
    gl.readPixels(...place, gl.RGBA, this.fine ? gl.FLOAT : gl.UNSIGNED_BYTE, pixel);
    const [value, , , alpha] = pixel;
    const mean = value / alpha; // z / (z + scale)
    return alpha > (this.fine ? 0.1 : 25) && mean < 1 ? (scale * mean) / (1 - mean) : null;
  }

  // Returns whether the last frame is still being drawn.
  busy() {
    const { gl } = this;
    if (!this.fence) return false;
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED && !gl.isContextLost()) return true;
    gl.deleteSync(this.fence);
    this.fence = null;
    return false;
  }

  // Blends the splats of a view and, if its parts have exposures of their own, their log gains.
  blendAll(view, { partLogs }) {
    if (partLogs) this.splats(view, { partLogs });
    this.splats(view);
  }

  // Blends the splats of a view at the pixels of `part` (x, y, width, height). With `pick`, the `scale` of the method
  // `pick`, depths are blended instead of colours; with `partLogs`, log gains of each part of the scene.
  splats(view, paint = {}, part = [0, 0, view.width, view.height]) {
    const { gl, graphics, blend } = this, { width, height } = view;
    this.projections(view, paint);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.reserve(paint.partLogs ? "logs" : "colors", width, height).target);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...part);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(blend.program);
    graphics.bind(blend, { u_order: this.order, u_shapes: this.shapes, u_projected: this.appearances });
    gl.uniform2f(blend.u_size, width, height);
    gl.uniform1f(blend.u_alpha_min, isReduced(view) ? REDUCED_ALPHA_MIN : ALPHA_MIN);
    gl.uniform1i(blend.u_drawn, this.drawn);
    gl.uniform1i(blend.u_quads, QUADS_PER_INSTANCE);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.quads);
    const instances = Math.ceil(this.drawn / QUADS_PER_INSTANCE);
    if (instances) gl.drawElementsInstanced(gl.TRIANGLES, 6 * QUADS_PER_INSTANCE, gl.UNSIGNED_INT, 0, instances);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
  }

  // Blends the splats of a view. Returns their picture, whose first rows and columns are in use.
  blended(view) {
    this.splats(view);
    return this.surfaces.colors.texture;
  }

  // Projects all splats of a view. For `paint` see `splats`.
  projections(view, paint) {
    const { content } = this;
    const flats = paint.partLogs?.map((logs) => logs.map(encodeLog)) ?? [];
    if (!content.parts) {
      this.projectPart(content, view, 0, { pick: paint.pick ?? 0, flats });
      return;
    }
    for (const [number, { fields, place, firstRow }] of content.parts.entries()) {
      const pick = (paint.pick ?? 0) / place.scale;
      this.projectPart(fields, viewFromPlace(view, place), firstRow, { pick, flats: flats.slice(number, number + 1) });
    }
  }

  // Projects the splats of a content to the rows from `firstRow` on. `flats` has the colour of each of its parts
  // instead of their own, if it has any.
  projectPart(content, view, firstRow, { pick, flats }) {
    const { gl, graphics, project: p, scene } = this, { colors, harmonics } = content;
    const [across, down] = view.scales ?? [1, 1];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projection);
    gl.viewport(0, firstRow, this.tableSize[0], content.usedHeight ?? content.height);
    gl.useProgram(p.program);
    gl.uniform1i(p.u_first_row, firstRow);
    gl.uniform1i(p.u_flat, flats.length);
    if (flats.length) gl.uniform3fv(p.u_flats, flats.flat());
    const colored = colors ? { u_colors: colors } : this.unused;
    graphics.bind(p, { u_places: content.places, u_shapes: content.shapes, ...colored });
    graphics.bind(p, harmonics ? { u_harmonics: harmonics } : this.noLayers, gl.TEXTURE_2D_ARRAY, 3);
    graphics.bind(p, { u_weights: content.weights ?? this.plain }, gl.TEXTURE_2D, 4);
    gl.uniform1i(p.u_weighted, content.weights ? 1 : 0);
    gl.uniform1i(p.u_colored, colors ? 1 : 0);
    gl.uniform1i(p.u_degree, content.degree ?? 0);
    gl.uniform1f(p.u_range, content.range ?? 1);
    gl.uniform1i(p.u_count, content.count);
    gl.uniform1i(p.u_antialiased, content.antialiased);
    gl.uniform4fv(p.u_low_pass, lowPassVariances([across, down]));
    gl.uniform1f(p.u_focal, Math.max(view.fx / across, view.fy / down));
    gl.uniformMatrix3fv(p.u_rotation, true, view.rows.flat());
    gl.uniform3fv(p.u_translation, view.translation);
    gl.uniform3fv(p.u_eye, view.eye);
    gl.uniform4f(p.u_intrinsics, view.fx, view.fy, view.cx, view.cy);
    gl.uniform2f(p.u_size, view.width, view.height);
    gl.uniform1f(p.u_near, scene.near);
    gl.uniform1f(p.u_tolerance, scene.tolerance);
    gl.uniform1f(p.u_pick, pick);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Composites the blended splats over the background, to a target of the view's size. `whole` is the view at its full
  // resolution.
  over(view, target, { gains = [1, 1, 1], partLogs }, whole = view) {
    const { gl, graphics, resolve: r, scene, content } = this, picture = content.panorama?.texture ?? this.picture;
    const sky = content.sky?.of(whole), stride = sky?.stride ?? 0;
    const { center, radius } = backgroundSphere(scene);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, view.width, view.height);
    gl.useProgram(r.program);
    const backgrounds = { u_background: picture ?? this.plain, u_sky: sky?.texture ?? this.plain };
    const { colors, logs } = this.surfaces;
    graphics.bind(r, { u_splats: colors.texture, ...backgrounds, u_logs: partLogs ? logs.texture : this.plain });
    gl.uniform4f(r.u_log_behind, ...(partLogs?.[0].map(encodeLog) ?? [0, 0, 0]), partLogs ? 1 : 0);
    gl.uniform1i(r.u_pictured, picture ? 1 : 0);
    gl.uniform2f(r.u_stride, (stride * view.width) / whole.width, (stride * view.height) / whole.height);
    gl.uniform1f(r.u_origin, 0.5 - 0.5 / Math.max(1, stride));
    gl.uniform3fv(r.u_from, view.eye.map((value, axis) => (value - center[axis]) / radius));
    gl.uniform3fv(r.u_solid, scene.solid);
    gl.uniform3fv(r.u_gains, gains);
    gl.uniformMatrix3fv(r.u_world, false, view.rows.flat()); // rows read as columns: transposed
    gl.uniform4f(r.u_intrinsics, view.fx, view.fy, view.cx, view.cy);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Returns a target, {texture, target}, of at least this size for blended "colors" or "logs".
  reserve(name, width, height) {
    const { gl, graphics } = this, surface = this.surfaces[name], [w, h] = surface?.size ?? [0, 0];
    if (width <= w && height <= h) return surface;
    this.free(name);
    const size = [Math.max(w, width), Math.max(h, height)];
    const texture = graphics.texture(gl.TEXTURE_2D, this.fine ? gl.RGBA16F : gl.RGBA8, ...size);
    graphics.setLinear();
    return (this.surfaces[name] = { texture, target: graphics.framebuffer(texture), size });
  }

  // Frees the targets of `reserve`.
  release() {
    for (const name of Object.keys(this.surfaces)) this.free(name);
  }

  // Frees the target of blended "colors" or "logs".
  free(name) {
    for (const object of [this.surfaces[name]?.texture, this.surfaces[name]?.target]) this.graphics.free(object);
    this.surfaces[name] = null;
  }

  // Frees what outlives a lost WebGL context.
  releaseDevice() {}

  dispose() {
    this.content?.dispose();
    this.graphics.dispose();
    this.gl.deleteSync(this.fence);
    this.content = this.fence = null;
  }
}

// Returns the background sphere in the page's units. The radius is Infinity if the scene has none.
export function backgroundSphere({ kind, sphere, center, unit }) {
  if (kind === "hyrf") return { center: [0, 0, 0], radius: BACKGROUND_RADIUS };
  if (!sphere) return { center: [0, 0, 0], radius: Infinity };
  return { center: sphere.center.map((value, axis) => (value - center[axis]) / unit), radius: sphere.radius / unit };
}

// Returns a log gain as a colour in [0, 1], which targets of 8 bits can hold, too. resolve.frag decodes it.
const encodeLog = (log) => (log + MAX_ABS_LOG_GAIN) / (2 * MAX_ABS_LOG_GAIN);

// Returns the variances of the low-pass filter at `scales` times the full resolution along x and y, in pixels of that
// resolution: those of the full resolution, and the sums of these and the variances of the mean over 1 / scale pixels,
// which make a picture at this resolution nearly equal to the reduced picture at full resolution.
export function lowPassVariances(scales) {
  const full = scales.map((scale) => LOW_PASS_VARIANCE * scale ** 2);
  return [...full, ...full.map((variance, axis) => variance + (1 - scales[axis] ** 2) / 12)];
}

// Returns whether a view is one of `reduceView` with fewer pixels than at its full resolution.
export const isReduced = ({ scales }) => scales !== undefined && Math.min(...scales) < 1;

// Returns a view at about `scale` times its resolution, with more rows than columns.
export function reduceView(view, scale) {
  const [across, down] = [scale, Math.min(1, ROWS_PER_COLUMN * scale)];
  const width = Math.max(1, Math.round(view.width * across)), height = Math.max(1, Math.round(view.height * down));
  const [x, y] = [width / view.width, height / view.height];
  return { ...view, width, height, fx: view.fx * x, fy: view.fy * y, cx: view.cx * x, cy: view.cy * y, scales: [x, y] };
}
