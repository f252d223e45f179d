// Draws a scene on a canvas, with a worker, a renderer and an eye. The player does not depend on the rest of the page.
//
// Events:
//     "progress"   detail: {part: fraction, what: "loading" | "unpacking" | "preparing"}
//     "opened"     detail: the scene of a file that was opened without a scene
//     "count"      detail: the scene, when more Gaussians of its file were loaded
//     "loaded"     a content is ready to be drawn
//     "exposure"   an exposure was chosen, or the scene has got or lost its exposure map
//     "remark"     detail: a remark about the scene, "" for none
//     "frame"      detail: ms per frame while moving
//     "camera"     detail: the index of the scene's camera to which the eye was moved
//     "moved"      a frame was drawn from another viewpoint
//     "failed"     detail: an Error

import { Eye, cameraOf, viewOf } from "./camera.js";
import { AS_PHOTOGRAPHED, EXPOSURES, hasExposureMap, viewExposure } from "./exposure.js";
import { MEMORY_REASON, UnsupportedDeviceError } from "./fields.js";
import { ContextLostError, countContextChange } from "./graphics.js";
import { Loader, StartError, SupersededError } from "./loader.js";
import { Renderer } from "./renderer.js";
import { IDENTITY_QUAT } from "../hyrf/rotation.js";

const SETTLE_MS = 200; // the wait after a movement before the picture is drawn at full resolution
const TARGET_FRAME_MS = 33; // slower frames lower the resolution while moving
const FIRST_PICTURE_MS = 2000; // after this time Gaussians that are ready are shown if there is no estimate
const FIRST_PICTURE_SCALE = 0.35; // of the resolution: slow devices draw it in a quarter of the time
const FIRST_PICTURE_REST_MS = 250; // a slow device does nothing else while the browser shows the first picture
const MAX_FRAME_WAIT_MS = 2000; // other work on a model waits for a frame to be shown, but not in hidden pages
const QUICK_FRAME_MS = 20; // frames that take less are shown at once
const MIN_SCALE = 0.2;
const MAX_PIXEL_RATIO = 2; // device pixels per CSS pixel
const FIRST_STEP_SECONDS = 1 / 60; // for the first frame of a movement, which has no earlier one to measure from
const MAX_STEP_SECONDS = 0.25; // limits the movement of the eye after a long frame
const COLORING_RATIO = 0.25; // the share of a frame that is used for colours while moving
const PROGRESS_RANGES = { loading: [0, 0.3], unpacking: [0.3, 0.6], preparing: [0.6, 1] };

const DEVICE_LOST_TEXT = "The graphics device was lost, or another scene was opened; try again.";
const NO_PICTURE_TEXT = "The picture is too large for this browser; try again in a smaller window.";
const NOT_READY_TEXT = "The scene is not ready for exact pictures yet; wait until it is loaded.";
const DISPOSED_TEXT = "The player was disposed of.";
const NO_ORDER = { order: null, drawn: 0 }; // of contents that sort themselves

export class Player extends EventTarget {
  // A player without a scene gets one from `open`. `workerAddress` is that of the worker's script, or null for the
  // embedded one. `streaming` is the module stream/stream_loader.js of players that open scene folders, else null, and
  // `maxGaussians` their budget, null for the default one. `rendererClass` draws, Renderer or WebgpuRenderer. Throws an
  // Error with a message for the user if the browser cannot draw.
  constructor(canvas, {
    scene = null, workerAddress = null, streaming = null, maxGaussians = null, rendererClass = Renderer,
  } = {}) {
    super();
    Object.assign(this, { canvas, workerAddress, streaming, maxGaussians, rendererClass });
    this.renderer = this.createRenderer();
    this.renderer.prepare().catch(() => {}); // while the file loads; `install` reports errors
    this.loader = null; // the loader of the file that is drawn
    this.next = null; // the loader of the file that is being loaded
    this.previous = null; // the loader of the file before, in case the next one cannot be shown
    this.waiters = []; // functions that are called when `previous` changes
    this.scene = null;
    this.cameras = [];
    this.eye = null;
    this.movers = []; // {active: whether it moves the eye, advance(seconds): moves it, returns whether it moved}
    this.resolution = 1; // a fraction of the canvas' size that the user chose
    this.automatic = true; // whether slow frames lower the resolution while moving
    this.mode = AS_PHOTOGRAPHED; // the exposure
    this.frames = 0; // the number of frames drawn so far
    // The times of the first picture and of the first complete one, in ms since the page was opened.
    this.times = { first: null, complete: null };
    this.movedAt = -Infinity; // the time of the last movement
    this.moves = 0; // the number of changes of the view or the content
    this.before = null; // the time of the last frame, if a mover was active then
    this.began = null; // the start of the frame that is being drawn
    this.took = null; // the running mean of ms per frame
    this.coarse = 1; // the factor of the resolution while moving
    this.scheduled = false;
    this.paused = false; // whether no frames are drawn
    this.drawnMoves = 0; // `moves` at the last frame
    this.loaded = false;
    this.whole = false; // whether all layers of the file are loaded
    this.stale = true; // whether the picture must be drawn again
    this.blank = true; // whether the canvas shows nothing
    this.quick = false; // whether the last frame took the device hardly any time
    this.unsorted = true; // whether the splats must be sorted for the view
    this.idle = false; // whether the picture is complete
    this.onIdle = []; // {resolve, reject} of the promises of `settled`
    this.failure = null; // the error for which there is no picture and none will come
    this.queue = Promise.resolve(); // resolves when all queued work has ended
    this.onShown = []; // functions that resolve the promises of `whenShown`
    this.showing = false; // whether `show` completes a picture, whose background frames must not replace
    if (scene) this.setScene(initialView(scene));

    this.aborter = new AbortController();
    const { signal } = this.aborter;
    canvas.addEventListener("webglcontextlost", (event) => this.onLost(event), { signal });
    canvas.addEventListener("webglcontextrestored", () => this.onRestored(), { signal });
    for (const event of ["resize", "visibilitychange"]) addEventListener(event, () => this.wake(), { signal });
    this.observer = new ResizeObserver(() => this.schedule());
    this.observer.observe(canvas);
    this.watchPixelRatio();
  }

  // Draws again when the window gets another pixel ratio, as on another screen: its size may be the same in CSS pixels.
  watchPixelRatio() {
    const query = matchMedia(`(resolution: ${devicePixelRatio}dppx)`), { signal } = this.aborter;
    const follow = () => {
      this.watchPixelRatio();
      this.wake();
    };
    query.addEventListener("change", follow, { signal, once: true });
  }

  // Creates a renderer of the player's class for its canvas.
  createRenderer() {
    return new this.rendererClass(this.canvas, () => this.onDeviceLost());
  }

  // Dispatches an event.
  emit(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // Frees the worker and all objects of the graphics device. The canvas becomes blank.
  dispose() {
    this.aborter.abort();
    this.observer.disconnect();
    this.loaded = false;
    for (const loader of [this.loader, this.next, this.previous]) loader?.dispose();
    this.next = null;
    this.giveUp(new Error(DISPOSED_TEXT));
    this.renderer.dispose();
    this.renderer.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  // ---- loading

  // Loads the file of the scene that the player was created with, from an async iterable of its bytes, which may have
  // their `length`. `picture` is an <img> of the background, or null. If another file is opened meanwhile, the player
  // shows that one.
  async load(stream, picture = null) {
    try {
      await this.receive({ scene: this.scene, stream, picture });
    } catch (error) {
      if (error instanceof SupersededError) return;
      if (error instanceof StartError) throw error;
      throw new Error(`The scene cannot be shown; if this page is truncated, fetch it again (${error.message}).`);
    }
  }

  // Opens a file, {name, stream, address}; `address` is needed for manifests of scene folders. `views` has its
  // {cameras, up, target} if they are known. `update` is true for a newer version of the scene that is shown: then the
  // eye stays, and only errors are reported. `origin` is what the page knows of the file; its loader keeps it.
  async open(file) {
    try {
      await this.receive(file);
    } catch (error) {
      const isForUser = error instanceof StartError || error instanceof SupersededError;
      throw isForUser ? error : new Error(`${file.name} cannot be opened: ${error.message}`);
    }
  }

  // Loads a file and shows it.
  async receive({
    name = "", scene = null, views = null, stream, address = null, picture = null, update = false, origin = null,
  }) {
    const isStreamed = address !== null && this.streaming?.isManifest(address);
    let loader = null;
    try {
      loader = new (isStreamed ? this.streaming.StreamLoader : Loader)({
        content: (content) => this.install(loader, content),
        progress: ({ what, part }) => this.progress(loader, what, part),
        failed: (error, isReported) => this.breakDown(loader, error, isReported),
        workerAddress: this.workerAddress,
        player: this,
      });
      // The page's own file is kept, and shown if this one fails.
      if (this.loader || this.previous) this.next?.dispose();
      else this.previous = this.next;
      Object.assign(loader, { picture, part: 0, scene, remark: "", update, origin });
      this.next = loader;
      this.failure = null;
      await loader.read({ name, scene, views, plain: scene?.plain ?? false, stream, address });
    } catch (error) {
      stream.cancel?.();
      if (loader && this.loader === loader) {
        this.whole = true; // no more of the file will arrive
        this.redraw();
      } else if (loader) {
        this.discard(loader);
      }
      if (!this.loader || this.loader.failure) this.giveUp(error);
      throw error;
    }
  }

  // Rejects the promises of a complete picture if none is shown and no load is left that could show one. If another
  // load has replaced this one, that one resolves or rejects them.
  giveUp(error) {
    if (this.loaded || this.next || error instanceof SupersededError) return;
    this.failure = error;
    for (const { reject } of this.onIdle.splice(0)) reject(error);
  }

  // Stops drawing a file whose worker has failed. What the canvas shows stays there.
  breakDown(loader, error, isReported) {
    if (loader === this.loader) {
      this.loaded = this.idle = false;
      this.giveUp(error);
    }
    if (!isReported) this.emit("failed", error);
  }

  // Discards a loader whose file cannot be shown.
  discard(loader) {
    loader.dispose();
    if (loader === this.next) [this.next, this.previous] = [this.previous, null];
    else if (loader === this.previous) this.previous = null;
    for (const resolve of this.waiters.splice(0)) resolve();
  }

  // Reports progress, but only of the file that was opened last.
  progress(loader, what, part) {
    const [first, last] = PROGRESS_RANGES[what];
    loader.part = Math.max(loader.part, first + (last - first) * part);
    if (loader === (this.next ?? this.loader) && !loader.update) this.emit("progress", { what, part: loader.part });
  }

  // Returns whether the player still uses a loader, whose worker has not failed.
  wanted(loader) {
    return !loader.failure && [this.loader, this.next, this.previous].includes(loader);
  }

  // Waits until a loader may show its content. Throws SupersededError if the player no longer uses it, also after a
  // failure of its worker, which `breakDown` has reported.
  async waitFor(loader) {
    while (loader === this.previous) await new Promise((resolve) => this.waiters.push(resolve));
    if (!this.wanted(loader)) throw new SupersededError();
  }

  // Shows a content that the worker has read instead of the old one. The first picture of a model is an estimate, or
  // what can be evaluated soon, but a picture is replaced by complete ones only. Returns whether the content is shown.
  async install(loader, message) {
    const { scene, models, picture } = message, initial = loader.scene ? null : initialView(scene);
    let content = null, staged = null, isEstimate = false;
    try {
      await this.waitFor(loader);
      await this.renderer.prepare();
      await loader.picture?.decode();
      this.renderer.graphics.takeError(); // clears earlier errors
      content = this.makeContent(loader, message);
      const view = this.view(loader.update && sameAxes(this.scene, scene) ? this.eye : initial?.eye);
      await content.prepare(view.eye);
      isEstimate = Boolean(models && content.hasEstimate && !this.loaded);
      if (models && !isEstimate) {
        await content.prepareFields();
        const end = this.loaded ? Infinity : performance.now() + FIRST_PICTURE_MS;
        await content.coloured(view, scene.tolerance, {
          goOn: () => this.wanted(loader) && performance.now() < end,
          report: (part) => message.whole && this.progress(loader, "preparing", part),
        });
      }
      staged = this.renderer.stage(content, scene, picture ?? loader.picture);
      await this.check(loader, content, models);
      if (!loader.isLatest(message)) throw new SupersededError();
      this.showContent(loader, message, staged, initial);
      return !isEstimate || Boolean(await this.enqueue(() => this.prepareFields(loader, content)));
    } catch (error) {
      this.refuse(loader, content, models, error);
      return false;
    }
  }

  // Returns an object that draws a content.
  makeContent(loader, message) {
    return loader.makeContent(this.renderer.gl, message) ?? this.renderer.makeContent(message);
  }

  // Prepares the fields of a model whose estimate is shown. Returns true.
  async prepareFields(loader, content) {
    await this.whenShown();
    await this.waitFor(loader);
    await content.prepareFields();
    await this.waitFor(loader);
    return true;
  }

  // Throws an Error if the graphics device does not hold a content, or if the player no longer uses it.
  async check(loader, { graphics }, models) {
    await graphics.whenDone(); // otherwise asking for errors would block the page
    await this.waitFor(loader);
    const error = graphics.takeError();
    if (graphics.lost) throw new ContextLostError();
    if (error && models) throw new UnsupportedDeviceError(MEMORY_REASON);
    if (error) throw new Error("It does not fit into the memory of the graphics device.");
  }

  // Asks for harmonics instead of a model that the device cannot draw. Throws the error if there is nothing else.
  refuse(loader, content, models, error) {
    const isShown = content === this.renderer.content;
    if (!isShown) content?.dispose();
    // After a lost context, `onRestored` decodes the file again. A lost device answers any question about it by null.
    if (content?.graphics.lost || error instanceof ContextLostError || error instanceof SupersededError) return;
    if (content?.sortsItself && this.renderer.fallBack()) return this.makeContentsAgain();
    if (!models || models.length > 1) { // merged models have no harmonics
      if (isShown) [this.loaded, this.loader] = [false, null]; // what the canvas shows stays there
      throw error;
    }
    const isUnsupported = error instanceof UnsupportedDeviceError;
    const reason = isUnsupported ? error.message : "this device's driver refuses the fields.";
    loader.remark = `Drawn with harmonics: ${reason}`;
    loader.again(true);
  }

  // Shows a staged content instead of the old one.
  showContent(loader, { number, whole, scene }, staged, initial) {
    const keepsEye = loader.update && sameAxes(this.scene, scene);
    if (keepsEye) Object.assign(this, { scene, cameras: initial?.cameras ?? this.cameras });
    else if (initial) this.setScene(initial);
    const before = this.renderer.show(staged);
    if (before) this.enqueue(() => before.dispose()); // after all work on it
    loader.use(number);
    if (loader === this.next) {
      for (const other of [this.loader, this.previous]) other?.dispose();
      this.loader = loader;
      this.next = this.previous = null;
      for (const resolve of this.waiters.splice(0)) resolve();
    }
    this.scene = scene;
    this.whole = whole || loader.broken;
    this.loaded = true;
    this.emit("exposure");
    this.moves++;
    this.stale = this.unsorted = true;
    if (initial && !keepsEye) this.emit("opened", scene);
    else if (!initial && scene.count !== loader.scene.count) this.emit("count", scene);
    loader.scene = scene;
    this.emit("remark", loader.remark);
    if (this.whole) this.progress(loader, "preparing", 1);
    if (!keepsEye) this.emit("loaded");
    this.resize();
    this.sort();
  }

  // Replaces the scene and moves the eye to its first camera.
  setScene({ scene, cameras, eye }) {
    this.scene = scene;
    this.cameras = cameras;
    this.eye = this.eye ? Object.assign(this.eye, eye) : eye; // the same object, because others refer to it
    this.choose(0);
  }

  // Handles a lost graphics context. Browsers drop contexts of background pages, and when a driver restarts.
  onLost(event) {
    event.preventDefault(); // otherwise the browser never restores the context
    countContextChange(this.renderer.gl);
    this.stopDrawing();
  }

  // Handles the restored context, whose objects are all lost.
  onRestored() {
    countContextChange(this.renderer.gl);
    this.renderer.releaseDevice();
    this.makeContentsAgain(() => (this.renderer = this.createRenderer()));
  }

  // Handles a lost WebGPU device. WebGL draws from now on.
  onDeviceLost() {
    this.stopDrawing();
    if (!this.lost) this.makeContentsAgain();
  }

  // Draws nothing until the device is back, and says so.
  stopDrawing() {
    this.loaded = false;
    this.idle = false; // the picture is incomplete until the device is restored
    this.emit("remark", "The graphics device was lost; drawing resumes when it is back.");
  }

  // Decodes the files again and draws them, after `prepare` if it succeeds.
  async makeContentsAgain(prepare = () => {}) {
    try {
      prepare();
      this.coarse = 1;
      for (const loader of [this.loader, this.next, this.previous]) loader?.again(false);
      if (this.loader) await this.loader.expect(); // showing the content also updates the remark
      else this.emit("remark", "");
    } catch (error) {
      if (error instanceof SupersededError) return;
      this.giveUp(error);
      this.emit("failed", error);
    }
  }

  // ---- drawing

  // Returns the exposure, "as-photographed" or "consistent" (see exposure.js).
  get exposure() {
    return this.mode;
  }

  set exposure(exposure) {
    if (!EXPOSURES.includes(exposure)) {
      throw new Error(`The exposure must be ${EXPOSURES.join(" or ")}, not ${exposure}.`);
    }
    this.mode = exposure;
    this.emit("exposure");
    this.redraw();
  }

  // Returns whether the scene has an exposure map. Without one, both exposures are the same.
  get hasExposureMap() {
    return this.scene !== null && hasExposureMap(this.scene);
  }

  // Returns the exposure of a view, as Renderer.draw takes it.
  exposureOf(view) {
    return viewExposure(this.scene, view, this.exposure);
  }

  // Returns the factor of the resolution of the next frame, in (0, 1].
  get scale() {
    if (this.isNew) return FIRST_PICTURE_SCALE * this.resolution;
    return this.moving && this.automatic ? Math.max(MIN_SCALE, this.resolution * this.coarse) : this.resolution;
  }

  // Returns whether there is no picture yet or, on slow devices, only since a moment, or one whose fields are being
  // prepared: that asks the device many questions, which would block the page while a large frame is drawn.
  get isNew() {
    const { times: { first }, renderer: { content } } = this;
    if (first === null) return true;
    return !this.quick && (performance.now() < first + FIRST_PICTURE_REST_MS || content.isReady === false);
  }

  // Returns whether a mover moves the eye.
  get driven() {
    return this.movers.some((mover) => mover.active);
  }

  // Returns whether the eye moves, or has moved in the last SETTLE_MS.
  get moving() {
    return this.driven || performance.now() - this.movedAt < SETTLE_MS;
  }

  // Returns a promise that resolves when the picture is complete: at full resolution, with the order and colours of
  // this view, and with the background. It is rejected if the scene cannot be shown, and there is no other.
  get settled() {
    if (this.failure) return Promise.reject(this.failure);
    if (this.idle && !this.lost) return Promise.resolve();
    return new Promise((resolve, reject) => this.onIdle.push({ resolve, reject }));
  }

  // Returns whether the graphics context is lost, which the browser reports only later by an event.
  get lost() {
    return this.renderer.gl.isContextLost();
  }

  // Sets the canvas to the window's size. A change blanks the canvas, so it must be redrawn in the same frame.
  resize() {
    const { clientWidth, clientHeight } = this.canvas, [wide, high] = this.renderer.largest;
    const dense = Math.min(devicePixelRatio, MAX_PIXEL_RATIO, wide / clientWidth, high / clientHeight);
    const [width, height] = [clientWidth, clientHeight].map((side) => Math.max(1, Math.round(side * dense)));
    if (this.canvas.width === width && this.canvas.height === height) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    this.blank = true;
    this.moves++;
    this.idle = false;
    this.stale = this.unsorted = true;
  }

  // Requests a frame after the eye has moved.
  changed() {
    this.movedAt = performance.now();
    this.moves++;
    this.unsorted = true;
    this.redraw();
  }

  // Requests a new picture of the same view.
  redraw() {
    this.idle = false;
    this.stale = true;
    this.schedule();
  }

  // Stops drawing until `resume`. Loading goes on.
  pause() {
    this.paused = true;
  }

  // Draws again after `pause`.
  resume() {
    this.paused = false;
    this.wake();
  }

  // Requests an animation frame. The time since the last one moves nothing, and does not count as that of a slow frame:
  // paused and hidden pages get none.
  wake() {
    this.before = this.began = null;
    this.schedule();
  }

  // Requests an animation frame.
  schedule() {
    if (this.scheduled || !this.loaded || this.paused) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  // Shows the last frame if it is complete, and then advances. The work of the next frame waits until the browser has
  // shown this one, because it would wait for that work.
  frame(now) {
    if (this.loaded && !this.paused && this.renderer.busy()) requestAnimationFrame((later) => this.frame(later));
    else if (this.present()) setTimeout(() => this.advance(now));
    else this.advance(now);
  }

  // Copies the last frame to the canvas. Returns whether there was one.
  present() {
    if (!this.loaded || !this.renderer.present()) return false;
    this.blank = false;
    this.times.first ??= performance.now();
    for (const resolve of this.onShown.splice(0)) setTimeout(resolve); // once the browser has copied the canvas
    return true;
  }

  // Waits until the canvas shows another frame.
  whenShown() {
    return new Promise((resolve) => {
      this.onShown.push(resolve);
      setTimeout(resolve, MAX_FRAME_WAIT_MS);
    });
  }

  // Moves the eye, and draws a frame if the picture has changed.
  advance(now) {
    this.scheduled = false;
    if (!this.loaded || this.paused) return;
    this.resize();
    if (this.began !== null) this.measure(now - this.began);
    this.began = null;
    const seconds = this.before === null ? FIRST_STEP_SECONDS : Math.min(MAX_STEP_SECONDS, (now - this.before) / 1000);
    if (this.movers.map((mover) => mover.advance(seconds)).some(Boolean)) this.changed();
    this.before = this.driven ? now : null;
    this.sort();
    if (this.renderer.content.fade?.()) this.stale = true;
    const moving = this.moving, scale = this.scale;
    if (this.renderer.isSorted && (this.stale || this.shown !== scale)) {
      const view = this.view(), { content } = this.renderer;
      const frameMs = Math.max(TARGET_FRAME_MS, this.took ?? 0);
      if (moving) content.recolor(view, this.scene.tolerance, COLORING_RATIO * frameMs, !this.showing);
      this.renderer.draw(view, scale, this.exposureOf(view));
      if (this.quick || (this.blank && this.times.first !== null)) this.present();
      this.frames++;
      this.began = now;
      this.stale = false;
      this.shown = scale;
      if (this.drawnMoves !== this.moves) this.emit("moved");
      this.drawnMoves = this.moves;
    }
    // Without an order, the background would be evaluated where splats will hide it.
    if (moving || this.began !== null || this.loader.busy || this.isNew) return this.schedule();
    this.took = null;
    this.finish();
  }

  // Adapts the resolution to the time that a frame took, in ms, including the wait for the screen.
  measure(took) {
    this.quick = took < QUICK_FRAME_MS;
    this.took = 0.8 * (this.took ?? took) + 0.2 * took;
    if (!this.moving) return;
    this.emit("frame", this.took);
    if (this.automatic) {
      const target = this.coarse * Math.min(1.15, Math.sqrt(TARGET_FRAME_MS / took));
      // Small changes of the resolution would be visible as jitter, and save little time.
      const isOffTarget = took > 1.3 * TARGET_FRAME_MS || took < 0.7 * TARGET_FRAME_MS;
      if (isOffTarget) this.coarse = Math.min(1, Math.max(MIN_SCALE, target));
    }
  }

  // Completes the picture while the eye stands still.
  async finish() {
    if (this.finishing || this.idle) return;
    this.finishing = true;
    const { moves } = this, { content } = this.renderer;
    const goOn = () => this.loaded && !this.paused && this.moves === moves && this.renderer.content === content;
    const changed = () => {
      this.redraw();
      return this.whenShown();
    };
    const options = { goOn, changed, blend: (view) => this.renderer.blended(view) };
    const work = () => content.complete(this.view(), this.scene.tolerance, options);
    const whole = await this.enqueue(work).catch((error) => {
      this.emit("failed", error);
      return true;
    });
    this.finishing = false;
    if (!whole || !goOn() || this.lost || this.stale || this.unsorted || this.loader.busy) return this.schedule();
    if (!this.whole) return;
    this.idle = true;
    this.times.complete ??= performance.now();
    for (const { resolve } of this.onIdle.splice(0)) resolve();
    this.enqueue(() => content.lookAhead(this.view(), goOn)).catch((error) => this.emit("failed", error));
  }

  // Runs work on the content after all earlier work on it. Returns a promise of its result, or of null if the context
  // was lost.
  enqueue(work) {
    const result = this.queue.then(work).catch((error) => {
      if (!(error instanceof ContextLostError)) throw error;
      return null;
    });
    this.queue = result.catch(() => {});
    return result;
  }

  // Returns the view of an eye for a picture of the canvas' size.
  view(eye = this.eye) {
    return eye.view(this.canvas.width, this.canvas.height);
  }

  // Returns the camera of the window's picture, in world units.
  get viewed() {
    return cameraOf(this.view(), this.scene);
  }

  // Sorts the splats for the current view.
  async sort() {
    if (!this.unsorted || !this.loaded || this.loader.busy) return;
    this.unsorted = false;
    const { content } = this.renderer, order = this.findOrder(this.view());
    const sorted = order === NO_ORDER ? order : await order; // frames need not wait for the device's own order
    if (sorted && content === this.renderer.content) this.setOrder(sorted);
    else this.unsorted = true;
    this.redraw();
  }

  // Returns the order of the splats for a view, or a promise of it, see Loader.sort.
  findOrder(view) {
    return this.renderer.content.sortsItself ? NO_ORDER : this.loader.sort(view, this.scene);
  }

  // Uploads an order.
  setOrder({ order, drawn }) {
    if (this.loaded) this.renderer.sorted(order, drawn);
    this.loader.reuse(order);
  }

  // Draws only the Gaussians that selections keep (see selection.js). Returns a promise of the numbers that are left
  // after each.
  async select(selections) {
    const counts = await this.loader.ask({ select: selections });
    const sky = this.renderer.content?.sky; // there is no content after the graphics device was lost
    if (sky) sky.key = null; // another part of the background may be visible
    this.changed();
    return counts;
  }

  // ---- cameras

  // Moves the eye to one of the scene's cameras.
  choose(number) {
    this.camera = number;
    this.eye.setView(this.cameras[number]);
    this.emit("camera", number);
    this.changed();
  }

  // Returns the visible point (page's units) at a position of the canvas (CSS pixels), or null if there is none,
  // such as outside of the canvas.
  findPoint(x, y) {
    const { width, height, clientWidth, clientHeight } = this.canvas;
    if (!this.loaded || !(x >= 0 && y >= 0 && x < clientWidth && y < clientHeight)) return null;
    const view = this.view();
    const [across, down] = [(x * width) / clientWidth, (y * height) / clientHeight];
    const depth = this.renderer.pick(view, across, down, this.eye.depth);
    this.redraw(); // the pick has changed the projection
    const [right, below] = [(across - view.cx) / view.fx, (down - view.cy) / view.fy];
    return depth === null ? null : this.eye.point(right, below, depth);
  }

  // Makes the visible point at a position of the canvas, in CSS pixels, the target. Returns whether there is a point.
  pick(x, y) {
    const point = this.findPoint(x, y);
    if (point) this.eye.target = point;
    this.changed();
    return point !== null;
  }

  // Returns a promise of a picture file (Blob) of the canvas at full size. `type` and `quality` are those of toBlob.
  async capture(type = "image/png", quality = undefined) {
    const view = this.view();
    await this.sortFor(view); // the last order may be that of a picture of `preview` or `show`
    this.renderer.draw(view, this.resolution, this.exposureOf(view));
    this.present();
    const picture = await new Promise((resolve) => this.canvas.toBlob(resolve, type, quality));
    if (!picture) throw new Error(NO_PICTURE_TEXT);
    return picture;
  }

  // Sorts a content for a view, for a picture that is drawn at once. Throws ContextLostError if that is impossible.
  async sortFor(view, content = this.renderer.content) {
    const sorted = this.loaded ? await this.findOrder(view) : null;
    if (!sorted || !this.loaded || content !== this.renderer.content) {
      throw this.failure ?? new ContextLostError(DEVICE_LOST_TEXT);
    }
    this.setOrder(sorted);
  }

  // Draws small pictures of views while the window's picture is complete. Gaussians keep the colours of the window's
  // view, because new ones would take long. Returns the RGB bytes of each picture, top row first, or null if another
  // picture is wanted meanwhile.
  async preview(views) {
    const { moves } = this, { content } = this.renderer, pictures = [];
    const isWanted = () => this.idle && this.loaded && this.moves === moves && content === this.renderer.content;
    await this.enqueue(() => this.renderer.graphics.whenDone()); // for `read`
    const draw = async (view) => {
      const sorted = isWanted() ? await this.findOrder(view) : null;
      if (!sorted || !isWanted()) return;
      this.unsorted = true;
      this.setOrder(sorted);
      const picture = this.renderer.read(view, this.exposureOf(view));
      this.renderer.isSorted = false; // frames of the window wait for their own order
      pictures.push(await picture);
    };
    for (const view of views) await this.enqueue(() => draw(view));
    this.sort(); // for the window's view
    return pictures.length === views.length ? pictures : null;
  }

  // Moves the eye to a camera in world units and draws its picture. Returns its RGB bytes, top row first. Throws an
  // Error with a message for the user if that is impossible. An invalid camera does not move the eye.
  async show(camera) {
    if (!this.loaded) throw this.failure ?? new Error(DEVICE_LOST_TEXT);
    const view = viewOf(camera, this.scene), { content } = this.renderer;
    this.renderer.check(view);
    this.eye.setView(view);
    this.changed();
    const draw = async () => {
      await this.sortFor(view, content);
      const options = { exact: true, blend: (seen) => this.renderer.blended(seen) };
      const isExact = await content.complete(view, this.scene.tolerance, options);
      await this.renderer.graphics.whenDone(); // for `read`
      await this.sortFor(view, content); // meanwhile frames of the window may have got another order
      if (!isExact) throw new Error(NOT_READY_TEXT); // the content is an estimate
      return this.renderer.read(view, this.exposureOf(view));
    };
    const picture = await this.enqueue(() => {
      this.showing = true;
      return draw().finally(() => {
        this.showing = false;
        this.unsorted = true;
        this.redraw();
      });
    });
    if (!picture) throw new Error(DEVICE_LOST_TEXT);
    return picture;
  }
}

// Returns whether two scenes have the same origin, unit and axes, so that an eye of one is valid in the other.
function sameAxes(before, after) {
  const numbersOf = ({ center, unit, rotation = IDENTITY_QUAT }) => [...center, unit, ...rotation];
  return Boolean(before) && numbersOf(before).every((value, k) => value === numbersOf(after)[k]);
}

// Returns the views and the first eye of a scene. Throws an Error if a camera is invalid.
function initialView(scene) {
  const cameras = scene.cameras.map((camera) => viewOf(camera, scene)), eye = new Eye(scene, cameras);
  eye.setView(cameras[0]);
  return { scene, cameras, eye };
}
