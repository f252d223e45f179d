// The page: puts scene, worker, renderer, eye and controls together, and draws when something has changed.

const SETTLED = 200; // ms after the last move until the picture is drawn at full resolution
const FRAME = 33; // ms that a frame may take while moving before it is drawn coarser
const COARSEST = 0.2;
const DENSEST = 2; // device pixels a CSS pixel
const LONGEST_STEP = 0.1; // s that a held key flies in one frame

const element = (name) => document.getElementById(name);
const textOf = (name) => element(name).textContent;

const lost = () => new Error("The graphics device was taken away from this page; reload the page to go on.");

function fail(error) {
  element("loading").hidden = true;
  element("message").textContent = error.message;
  element("message").hidden = false;
}

class Page {
  constructor() {
    this.scene = JSON.parse(textOf("scene"));
    this.canvas = element("view");
    this.renderer = new Renderer(this.canvas, this.scene);
    this.splats = new Splats(this.scene);
    this.cameras = this.scene.cameras.map((camera) => viewOf(camera, this.scene));
    this.eye = new Eye(this.scene, this.cameras);
    this.frames = 0; // drawn so far
    this.moved = -Infinity; // when
    this.began = null; // when the frame that is being drawn was begun
    this.coarse = 1; // times the chosen resolution, while moving
    this.scheduled = false;
    this.loaded = false;
    this.stale = true; // the canvas does not show the view
    this.unsorted = true; // the order is not that of the view
    this.controls = new Controls(this.canvas, this.eye, {
      changed: () => this.changed(),
      pick: (x, y) => this.pick(x, y),
      press: (key) => this.press(key),
    });
    this.panel();
    this.choose(0);
    this.canvas.addEventListener("webglcontextlost", () => {
      this.loaded = false;
      fail(lost());
    });
    new ResizeObserver(() => this.wake()).observe(this.canvas);
    addEventListener("resize", () => this.wake()); // also to a screen of other density
  }

  async load() {
    const picture = element("background");
    const [unpacked] = await Promise.all([this.splats.unpack((part) => (element("bar").value = part)), picture?.decode()]);
    if (this.renderer.gl.isContextLost()) throw lost();
    this.renderer.load(unpacked, picture);
    this.loaded = true;
    element("loading").hidden = true;
    this.fit();
    this.resort();
  }

  // ---- drawing

  get scale() {
    const chosen = element("resolution").value / 100;
    return this.moving && element("automatic").checked ? Math.max(COARSEST, chosen * this.coarse) : chosen;
  }

  get moving() {
    return this.controls.active || performance.now() - this.moved < SETTLED;
  }

  // Give the canvas the window's size. That blanks it, so it is drawn to at once.
  fit() {
    const dense = Math.min(devicePixelRatio, DENSEST);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * dense)));
    if (this.canvas.width === width && this.canvas.height === height) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    this.stale = this.unsorted = true;
  }

  changed() {
    this.moved = performance.now();
    this.stale = this.unsorted = true;
    this.wake();
  }

  redraw() {
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
    if (this.controls.advance(Math.min(LONGEST_STEP, (now - (this.before ?? now)) / 1000))) this.changed();
    this.before = this.controls.active ? now : null;
    this.resort();
    const moving = this.moving, scale = this.scale;
    if (this.stale || this.shown !== scale) {
      this.renderer.draw(this.view(), scale);
      this.frames++;
      this.began = now;
      this.stale = false;
      this.shown = scale;
    }
    if (moving || this.began !== null) this.wake();
    else this.took = null;
  }

  // A frame took so many ms, waiting for the screen included.
  measure(took) {
    this.took = 0.8 * (this.took ?? took) + 0.2 * took;
    if (!this.moving) return;
    element("speed").textContent = `${Math.round(1000 / this.took)} fps`;
    if (element("automatic").checked) {
      const wish = this.coarse * Math.min(1.15, Math.max(0.7, Math.sqrt(FRAME / took)));
      // Small changes would only make the picture swim.
      if (took > 1.3 * FRAME || took < 0.7 * FRAME) this.coarse = Math.min(1, Math.max(COARSEST, wish));
    }
  }

  view() {
    return this.eye.view(this.canvas.width, this.canvas.height);
  }

  async resort() {
    if (!this.unsorted || this.splats.busy) return;
    this.unsorted = false;
    this.take(await this.splats.sort(this.view()));
    this.redraw();
  }

  take({ order, drawn }) {
    if (this.loaded) this.renderer.sorted(order, drawn);
    this.splats.reuse(order);
  }

  // ---- what a person does

  choose(number) {
    this.camera = (number + this.cameras.length) % this.cameras.length;
    element("cameras").selectedIndex = this.camera;
    this.eye.stand(this.cameras[this.camera]);
    this.changed();
  }

  pick(x, y) {
    if (!this.loaded) return;
    const { width, height } = this.canvas, view = this.view();
    const across = width / this.canvas.clientWidth, down = height / this.canvas.clientHeight;
    const depth = this.renderer.pick(view, x * across, y * down, this.eye.depth);
    if (depth !== null) this.eye.target = this.eye.point(...this.controls.fromMiddle(x, y), depth);
    this.changed();
  }

  press(key) {
    const actions = {
      N: () => this.choose(this.camera + 1),
      P: () => this.choose(this.camera - 1),
      R: () => this.choose(this.camera),
      F: () => this.fullscreen(),
      H: () => this.toggle(),
      "?": () => element("help").showModal(),
    };
    actions[key]?.();
  }

  fullscreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.().catch(() => {});
  }

  toggle() {
    const panel = element("panel");
    panel.hidden = !panel.hidden;
    element("toggle").setAttribute("aria-expanded", String(!panel.hidden));
  }

  panel() {
    element("count").textContent = `${this.scene.count.toLocaleString("en")} splats`;
    element("cameras").append(...this.cameras.map((_, number) => new Option(`Camera ${number + 1} of ${this.cameras.length}`)));
    element("cameras").onchange = (event) => this.choose(event.target.selectedIndex);
    element("previous").onclick = () => this.press("P");
    element("next").onclick = () => this.press("N");
    element("reset").onclick = () => this.press("R");
    element("fullscreen").onclick = () => this.press("F");
    element("fullscreen").hidden = !document.fullscreenEnabled;
    element("ask").onclick = () => this.press("?");
    element("toggle").onclick = () => this.press("H");
    if (matchMedia("(max-width: 520px)").matches) this.toggle(); // it would cover the scene
    element("automatic").onchange = () => this.redraw();
    element("resolution").oninput = (event) => {
      element("percent").textContent = `${event.target.value}%`;
      this.redraw();
    };
  }

  // ---- from outside

  // Stand at a camera of the world and draw exactly its picture, for `pixels` to return.
  async show(camera) {
    await this.ready;
    const view = viewOf(camera, this.scene);
    this.eye.stand(view);
    this.changed();
    this.take(await this.splats.sort(view));
    this.picture = this.renderer.read(view);
    this.stale = this.unsorted = true;
    this.wake();
  }

  // Stand where the address says, if it does.
  async hash() {
    const [name, value] = location.hash.slice(1).split("=", 2);
    if (name !== "camera") return;
    try {
      await this.show(JSON.parse(decodeURIComponent(value)));
      element("message").hidden = this.loaded; // what was said of the address before
    } catch (error) {
      throw new Error(`The address names no camera that can be used: ${error.message}.`);
    }
  }
}

try {
  const page = new Page();
  page.ready = page.load();
  page.ready.then(() => page.hash()).catch(fail);
  addEventListener("hashchange", () => page.hash().catch(fail));
  // For scripts. Cameras are {width, height, fx, fy, cx, cy, camera_from_world: 4 x 4}, OpenCV axes, the world's units.
  window.hyrfpack = {
    ready: page.ready, // a promise of the scene
    show: (camera) => page.show(camera), // stands there and draws; a promise
    pixels: () => page.picture, // RGB bytes of what `show` drew last, top row first
    camera: () => cameraOf(page.view(), page.scene), // of the window
    frames: () => page.frames, // how many the window has been given
  };
} catch (error) {
  fail(error);
}
