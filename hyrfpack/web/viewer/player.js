// What draws: scene, worker, renderer and eye put together on a canvas. It knows no other part of the page.
//
// Events: "progress" (detail: {part: 0 to 1, what: "loading" | "unpacking" | "preparing"}), "opened" (detail: the scene
// of a file that came without one), "counted" (detail: the same, when more of the file is there), "loaded" (there is
// something to see), "exposed" (the exposure was chosen, or may have got or lost its map), "said" (detail: a sentence
// for the corner, "" for none), "drawn" (detail: ms a frame while moving), "stood" (detail: number of the camera),
// "failed" (detail: Error). Movers, see `movers`, move the eye from frame to frame.

import { Eye, cameraOf, viewOf } from "./camera.js";
import { AS_PHOTOGRAPHED, EXPOSURES, viewGains } from "./exposure.js";
import { Fields, Unfit } from "./fields.js";
import { ContextLost, countLoss } from "./graphics.js";
import { Loader, Superseded } from "./loader.js";
import { Renderer } from "./renderer.js";
import { Splats } from "./splats.js";

const SETTLED = 200; // ms after the last move until the picture is drawn at full resolution
const FRAME = 33; // ms that a frame may take while moving before it is drawn coarser
const COARSEST = 0.2;
const DENSEST = 2; // device pixels a CSS pixel
const FIRST_STEP = 1 / 60, LONGEST_STEP = 0.25; // s that a mover may move in one frame
const COLORING = 0.25; // of a frame, for colours while moving
const SHARES = { loading: [0, 0.3], unpacking: [0.3, 0.6], preparing: [0.6, 1] }; // of the progress bar

const TAKEN = "The graphics device was taken away, or another scene opened, meanwhile; try again.";

export class Player extends EventTarget {
  // Without a scene, `open` brings one. Throws an Error with a sentence where the browser cannot draw.
  constructor(canvas, scene = null) {
    super();
    this.canvas = canvas;
    this.renderer = new Renderer(canvas);
    this.loader = null; // of what is drawn
    this.next = null; // of what is being loaded
    this.earlier = null; // of what was being loaded before, for the case that the next cannot be shown
    this.waiters = []; // of the earlier one, called when it is so no more
    this.scene = null;
    this.cameras = [];
    this.eye = null;
    this.movers = []; // {active, advance(seconds)}: whether it holds the eye now; move it and tell whether it moved
    this.resolution = 1; // of the canvas, chosen by a person
    this.automatic = true; // coarser while moving, if slow
    this.chosenExposure = AS_PHOTOGRAPHED;
    this.frames = 0; // drawn so far
    this.times = { first: null, complete: null }; // ms since the page was opened: something, everything was seen
    this.moved = -Infinity; // when
    this.moves = 0;
    this.before = null; // when the last frame was that a mover held
    this.began = null; // when the frame that is being drawn was begun
    this.took = null; // ms a frame, lately
    this.coarse = 1; // times the chosen resolution, while moving
    this.scheduled = false;
    this.loaded = false;
    this.whole = false; // no more layers of the file will come
    this.stale = true; // the canvas does not show the view
    this.unsorted = true; // the order is not that of the view
    this.calm = false; // there is nothing more to do
    this.calmed = []; // who waits for that
    this.turn = Promise.resolve(); // of those that complete the picture, one after the other
    if (scene) this.enter(beginning(scene));

    this.listening = new AbortController();
    const { signal } = this.listening;
    canvas.addEventListener("webglcontextlost", (event) => this.lose(event), { signal });
    canvas.addEventListener("webglcontextrestored", () => this.restore(), { signal });
    addEventListener("resize", () => this.wake(), { signal }); // also to a screen of other density
    this.observer = new ResizeObserver(() => this.wake());
    this.observer.observe(canvas);
  }

  tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // Free all that the device and the worker hold. The canvas shows nothing any more.
  dispose() {
    this.listening.abort();
    this.observer.disconnect();
    this.loaded = false;
    for (const loader of [this.loader, this.next, this.earlier]) loader?.dispose();
    this.renderer.dispose();
    this.renderer.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  // ---- loading

  // The file of the scene that the player was made with: an async iterable of its bytes, which may know their `length`.
  // `picture`: of its background, an <img>, or none. Another file may be shown instead, if one is opened meanwhile.
  async load(stream, picture = null) {
    try {
      await this.receive({ scene: this.scene, stream, picture });
    } catch (error) {
      const { message } = error;
      if (error instanceof Superseded) return;
      throw new Error(`The scene cannot be unpacked; if this page is not whole, fetch it again (${message}).`);
    }
  }

  // Any file: {name, stream}, and `stage` where it is known from where to look: {cameras, up, target}. `update`: it is
  // the scene that is shown, as it is now; the eye stays where it is, and nothing is told of it but what is wrong.
  async open({ name, stream, stage = null, update = false }) {
    try {
      await this.receive({ name, stream, stage, picture: null, update });
    } catch ({ message }) {
      throw new Error(`${name} cannot be opened: ${message}`);
    }
  }

  async receive({ name = "", scene = null, stage = null, stream, picture, update = false }) {
    // What the page came with is shown after all if this cannot be.
    if (this.loader || this.earlier) this.next?.dispose();
    else this.earlier = this.next;
    const loader = new Loader({
      content: (content) => this.take(loader, content),
      progress: ({ what, part }) => this.progress(loader, what, part),
    });
    Object.assign(loader, { picture, part: 0, scene, remark: "", update });
    this.next = loader;
    try {
      await loader.read({ name, scene, stage, plain: scene?.plain ?? false, stream });
    } catch (error) {
      if (this.loader === loader) this.rest();
      else this.drop(loader);
      throw error;
    }
  }

  // What is shown is all that comes of its file.
  rest() {
    this.whole = true;
    this.redraw();
  }

  // A loader has nothing to show.
  drop(loader) {
    loader.dispose();
    if (loader === this.next) [this.next, this.earlier] = [this.earlier, null];
    else if (loader === this.earlier) this.earlier = null;
    for (const go of this.waiters.splice(0)) go();
  }

  // Only of what was opened last.
  progress(loader, what, part) {
    const [first, last] = SHARES[what];
    loader.part = Math.max(loader.part, first + (last - first) * part);
    if (loader === (this.next ?? this.loader) && !loader.update) this.tell("progress", { what, part: loader.part });
  }

  wanted(loader) {
    return [this.loader, this.next, this.earlier].includes(loader);
  }

  // Once a loader may show what it has; throws Superseded if it may not any more.
  async turnOf(loader) {
    while (loader === this.earlier) await new Promise((resolve) => this.waiters.push(resolve));
    if (!this.wanted(loader)) throw new Superseded();
  }

  // What the worker has read goes to the device. Whether it is shown now: until then all stays as it was.
  async take(loader, { number, whole, scene, model, splats, picture }) {
    const { gl } = this.renderer, begins = loader.scene ? null : beginning(scene);
    let content = null, staged = null;
    try {
      await this.turnOf(loader);
      await loader.picture?.decode();
      gl.getError(); // of anything before
      if (model) {
        content = new Fields(gl, model);
        await content.prepare((part) => {
          if (!this.wanted(loader)) throw new Superseded();
          this.progress(loader, "preparing", part);
        });
        const view = this.view(loader.update && sameAxes(this.scene, scene) ? this.eye : begins?.eye);
        await content.coloured(view, scene.tolerance, { goOn: () => this.wanted(loader) });
      } else {
        content = new Splats(gl, splats);
      }
      await this.turnOf(loader);
      if (content.graphics.lost) throw new ContextLost();
      staged = this.renderer.stage(content, scene, picture ?? loader.picture);
      const error = gl.getError();
      if (content.graphics.lost) throw new ContextLost();
      if (error !== gl.NO_ERROR && model) throw new Unfit("this device's memory does not hold the fields.");
      if (error !== gl.NO_ERROR) throw new Error("It does not fit into the memory of the graphics device.");
    } catch (error) {
      content?.dispose();
      // All begins again when the device is back.
      if (error instanceof ContextLost || error instanceof Superseded) return false;
      if (!model) throw error;
      const unfit = error instanceof Unfit ? error.message : "this device's driver refuses the fields.";
      loader.remark = `Drawn with harmonics: ${unfit}`;
      loader.again(true);
      return false;
    }
    const stays = loader.update && sameAxes(this.scene, scene);
    if (stays) Object.assign(this, { scene, cameras: begins?.cameras ?? this.cameras });
    else if (begins) this.enter(begins);
    this.renderer.show(staged);
    loader.use(number);
    if (loader === this.next) {
      for (const other of [this.loader, this.earlier]) other?.dispose();
      this.loader = loader;
      this.next = this.earlier = null;
      for (const go of this.waiters.splice(0)) go();
    }
    this.scene = scene;
    this.whole = whole || loader.broken;
    this.loaded = true;
    this.tell("exposed");
    this.moves++;
    this.stale = this.unsorted = true;
    if (begins && !stays) this.tell("opened", scene);
    else if (!begins && scene.count !== loader.scene.count) this.tell("counted", scene);
    loader.scene = scene;
    this.tell("said", loader.remark);
    this.progress(loader, "preparing", 1);
    if (!stays) this.tell("loaded");
    this.fit();
    this.resort();
    return true;
  }

  // Stand before a scene.
  enter({ scene, cameras, eye }) {
    this.scene = scene;
    this.cameras = cameras;
    this.eye = this.eye ? Object.assign(this.eye, eye) : eye; // others hold on to it
    this.choose(0);
  }

  // The device was taken away: browsers do so in the background, or when a driver starts anew.
  lose(event) {
    event.preventDefault(); // else it is for ever
    countLoss(this.renderer.gl);
    this.loaded = false;
    this.calm = false; // the picture is not complete until the device is restored
    this.tell("said", "The graphics device was taken away; the picture comes back with it.");
  }

  // It is back, with nothing of what it held.
  async restore() {
    try {
      countLoss(this.renderer.gl);
      this.renderer = new Renderer(this.canvas);
      this.coarse = 1;
      for (const loader of [this.loader, this.next, this.earlier]) loader?.again(false);
      if (this.loader) await this.loader.expect(); // it says what there is to be said
      else this.tell("said", "");
    } catch (error) {
      if (!(error instanceof Superseded)) this.tell("failed", error);
    }
  }

  // ---- drawing

  // "as-photographed" or "consistent", see exposure.js.
  get exposure() {
    return this.chosenExposure;
  }

  set exposure(exposure) {
    if (!EXPOSURES.includes(exposure)) throw new Error(`The exposure must be ${EXPOSURES.join(" or ")}, not ${exposure}.`);
    this.chosenExposure = exposure;
    this.tell("exposed");
    this.redraw();
  }

  // Whether the scene has an exposure map, without which both exposures are the same.
  get hasExposureMap() {
    return Boolean(this.scene?.exposure);
  }

  gains(view) {
    return viewGains(this.scene, view, this.exposure);
  }

  get scale() {
    return this.moving && this.automatic ? Math.max(COARSEST, this.resolution * this.coarse) : this.resolution;
  }

  get held() {
    return this.movers.some((mover) => mover.active);
  }

  get moving() {
    return this.held || performance.now() - this.moved < SETTLED;
  }

  // A promise that the picture is complete: full resolution, the order and colours of the view, the whole background.
  get settled() {
    return this.calm ? Promise.resolve() : new Promise((resolve) => this.calmed.push(resolve));
  }

  // Give the canvas the window's size. That blanks it, so it is drawn to at once.
  fit() {
    const { clientWidth, clientHeight } = this.canvas, [wide, high] = this.renderer.largest;
    const dense = Math.min(devicePixelRatio, DENSEST, wide / clientWidth, high / clientHeight);
    const [width, height] = [clientWidth, clientHeight].map((side) => Math.max(1, Math.round(side * dense)));
    if (this.canvas.width === width && this.canvas.height === height) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    this.moves++;
    this.calm = false;
    this.stale = this.unsorted = true;
  }

  changed() {
    this.moved = performance.now();
    this.moves++;
    this.unsorted = true;
    this.redraw();
  }

  redraw() {
    this.calm = false;
    this.stale = true;
    this.wake();
  }

  wake() {
    if (this.scheduled || !this.loaded) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.scheduled = false;
    if (!this.loaded) return;
    if (this.renderer.busy()) return this.wake();
    this.fit();
    if (this.began !== null) this.measure(now - this.began);
    this.began = null;
    const seconds = this.before === null ? FIRST_STEP : Math.min(LONGEST_STEP, (now - this.before) / 1000);
    if (this.movers.map((mover) => mover.advance(seconds)).some(Boolean)) this.changed();
    this.before = this.held ? now : null;
    this.resort();
    const moving = this.moving, scale = this.scale;
    if (this.stale || this.shown !== scale) {
      const view = this.view(), { content } = this.renderer;
      if (moving) content.recolor(view, this.scene.tolerance, COLORING * Math.max(FRAME, this.took ?? 0));
      this.renderer.draw(view, scale, this.gains(view));
      if (this.renderer.drawn) this.times.first ??= performance.now();
      this.frames++;
      this.began = now;
      this.stale = false;
      this.shown = scale;
    }
    if (moving || this.began !== null) return this.wake();
    this.took = null;
    this.finish();
  }

  // A frame took so many ms, waiting for the screen included.
  measure(took) {
    this.took = 0.8 * (this.took ?? took) + 0.2 * took;
    if (!this.moving) return;
    this.tell("drawn", this.took);
    if (this.automatic) {
      const wish = this.coarse * Math.min(1.15, Math.sqrt(FRAME / took));
      // Small changes would only make the picture swim.
      if (took > 1.3 * FRAME || took < 0.7 * FRAME) this.coarse = Math.min(1, Math.max(COARSEST, wish));
    }
  }

  // Standing still: complete the picture, then rest.
  async finish() {
    if (this.finishing || this.calm) return;
    this.finishing = true;
    const { moves } = this, { content } = this.renderer;
    const goOn = () => this.loaded && this.moves === moves && this.renderer.content === content;
    const how = { goOn, changed: () => this.redraw() };
    const whole = await this.alone(() => content.complete(this.view(), this.scene.tolerance, how)).catch((error) => {
      this.tell("failed", error);
      return true;
    });
    this.finishing = false;
    if (!whole || !goOn() || this.stale || this.unsorted || this.loader.busy) return this.wake();
    if (!this.whole) return;
    this.calm = true;
    this.times.complete ??= performance.now();
    for (const resolve of this.calmed.splice(0)) resolve();
  }

  // Do something to the content after others have done with it. null where the device was taken away.
  alone(work) {
    const done = this.turn.then(work).catch((error) => {
      if (!(error instanceof ContextLost)) throw error;
      return null;
    });
    this.turn = done.catch(() => {});
    return done;
  }

  view(eye = this.eye) {
    return eye.view(this.canvas.width, this.canvas.height);
  }

  // The camera of the world that the window shows.
  get viewed() {
    return cameraOf(this.view(), this.scene);
  }

  async resort() {
    if (!this.unsorted || this.loader.busy) return;
    this.unsorted = false;
    const { content } = this.renderer, sorted = await this.loader.sort(this.view(), this.scene);
    if (sorted && content === this.renderer.content) this.order(sorted);
    else this.unsorted = true;
    this.redraw();
  }

  order({ order, drawn }) {
    if (this.loaded) this.renderer.sorted(order, drawn);
    this.loader.reuse(order);
  }

  // ---- standing somewhere

  // Stand at one of the scene's cameras.
  choose(number) {
    this.camera = (number + this.cameras.length) % this.cameras.length;
    this.eye.stand(this.cameras[this.camera]);
    this.tell("stood", this.camera);
    this.changed();
  }

  // Orbit about what is seen at a place of the canvas, CSS pixels. Whether there is something.
  pick(x, y) {
    if (!this.loaded) return false;
    const { width, height, clientWidth, clientHeight } = this.canvas, view = this.view();
    const [across, down] = [(x * width) / clientWidth, (y * height) / clientHeight];
    const depth = this.renderer.pick(view, across, down, this.eye.depth);
    const [right, below] = [(across - view.cx) / view.fx, (down - view.cy) / view.fy];
    if (depth !== null) this.eye.target = this.eye.point(right, below, depth);
    this.changed();
    return depth !== null;
  }

  // PNG of what the window shows, at its full size.
  capture() {
    const view = this.view();
    this.renderer.draw(view, this.resolution, this.gains(view));
    return new Promise((resolve) => this.canvas.toBlob(resolve, "image/png"));
  }

  // Stand at a camera of the world and draw exactly its picture: RGB bytes, top row first. Throws an Error with a
  // sentence, and stays, where that cannot be.
  async show(camera) {
    if (!this.loaded) throw new Error(TAKEN);
    const view = viewOf(camera, this.scene), { content } = this.renderer;
    this.renderer.check(view);
    this.eye.stand(view);
    this.changed();
    const picture = await this.alone(async () => {
      await content.complete(view, this.scene.tolerance, { exact: true });
      const sorted = await this.loader.sort(view, this.scene);
      if (!sorted || !this.loaded || content !== this.renderer.content) throw new ContextLost();
      this.order(sorted);
      return this.renderer.read(view, this.gains(view));
    });
    this.unsorted = true;
    this.redraw();
    if (!picture) throw new Error(TAKEN);
    return picture;
  }
}

// Whether two scenes have the same origin and unit, so that an eye of one can look at the other.
function sameAxes(before, after) {
  return before?.unit === after.unit && before.center.every((value, axis) => value === after.center[axis]);
}

// How one first stands before a scene. Throws where a camera makes no sense.
function beginning(scene) {
  const cameras = scene.cameras.map((camera) => viewOf(camera, scene)), eye = new Eye(scene, cameras);
  eye.stand(cameras[0]);
  return { scene, cameras, eye };
}
