// Shows scenes in an element of any page: the interface of the package hyrf-viewer, see npm/hyrf-viewer/index.d.ts.

import { formatCamera, parseCamera } from "./address.js";
import { cameraOf, toWorld, viewOf } from "./camera.js";
import { AS_PHOTOGRAPHED, EXPOSURES } from "./exposure.js";
import { SupersededError } from "./loader.js";
import { prefersReducedMotion } from "./motion.js";
import { Navigation } from "./navigation.js";
import { Player } from "./player.js";
import { Renderer } from "./renderer.js";
import { keepSource, openSource } from "./source.js";
import { STREAMING } from "./stream/stream_loader.js";

const EVENTS = ["ready", "progress", "error", "camera", "ignored"];
const INTERACTIONS = ["after-click", "always", "none"];
const LOADINGS = ["eager", "lazy"];
const RENDERER_TEXT = 'renderer must be the export `webgpu` of "hyrf-viewer/webgpu"; leave it out for WebGL 2.';
const LAZY_MARGIN = "300px"; // a lazy scene is loaded when its container is this near to the window
// The keys that move the eye, for screen readers; `press` handles others.
const KEYS_TEXT = "Arrow keys look around, W A S D Q E fly, plus and minus zoom.";
const CANVAS_STYLE = { display: "block", width: "100%", height: "100%" };

// Creates a viewer in an element. `options` are those that the constructor lists. Throws an Error with a message for
// the user if one is invalid, or if the browser cannot draw.
export const createViewer = (options) => new Viewer(options ?? {});

class Viewer {
  constructor({
    container, src = null, name, camera = null, exposure = AS_PHOTOGRAPHED, autorotate = false,
    interaction = "after-click", loading = "eager", title = "3D scene", workerUrl = null, maxGaussians = null,
    renderer = Renderer,
  }) {
    this.container = findContainer(container);
    checkChoice("exposure", exposure, EXPOSURES);
    checkChoice("interaction", interaction, INTERACTIONS);
    checkChoice("loading", loading, LOADINGS);
    if (maxGaussians !== null && !(Number.isInteger(maxGaussians) && maxGaussians > 0)) {
      throw new Error(`maxGaussians must be a whole number of at least 1, not ${String(maxGaussians)}.`);
    }
    if (typeof renderer !== "function") throw new Error(RENDERER_TEXT);
    const workerAddress = workerUrl && resolveWorker(workerUrl);
    this.canvas = document.createElement("canvas");
    Object.assign(this.canvas.style, CANVAS_STYLE);
    this.canvas.tabIndex = interaction === "none" ? -1 : 0;
    this.canvas.setAttribute("role", interaction === "none" ? "img" : "application");
    this.canvas.setAttribute("aria-label", title);
    if (interaction !== "none") this.canvas.setAttribute("aria-description", KEYS_TEXT);
    const playerOptions = { workerAddress, streaming: STREAMING, maxGaussians, rendererClass: renderer };
    this.player = new Player(this.canvas, playerOptions);
    this.player.exposure = exposure;
    this.navigation = new Navigation(this.player, {
      keyTarget: interaction === "none" ? null : this.canvas,
      isEmbedded: interaction === "after-click",
      press: (key) => this.press(key),
      ignored: (kind) => this.emit("ignored", { kind }),
    });
    const { turntable } = this.navigation, { isHeld } = turntable;
    turntable.isHeld = () => this.screenshots > 0 || isHeld(); // the picture of a view that moves is never complete
    this.listeners = new Map(EVENTS.map((event) => [event, new Set()]));
    this.firstCamera = camera; // of the scene of the next load
    this.progress = 0;
    // The load whose scene is wanted, `origin` of its loader: {aborter, reject: rejects its promise, firstCamera, name,
    // source: what can be loaded again, null for a stream, isComplete, isReported: whether "ready" was emitted}.
    this.currentLoad = null;
    this.screenshots = 0; // those that are being made
    this.isReady = false;
    this.isDestroyed = false;
    this.isPaused = false; // by `pause`
    this.isVisible = true; // whether the container is in the window, or near it
    this.forward();
    this.container.append(this.canvas);
    this.pending = src !== null && loading === "lazy" ? { src, name } : null; // what is loaded when it becomes visible
    this.observer = new IntersectionObserver((entries) => this.watch(entries.at(-1).isIntersecting), {
      rootMargin: LAZY_MARGIN,
    });
    this.observer.observe(this.container);
    if (autorotate && !prefersReducedMotion()) this.autorotate = true;
    if (src !== null && !this.pending) this.load(src, { name }).catch(() => {}); // `load` has emitted the error
  }

  // Handles a key that does not move the eye.
  press(key) {
    const { player, navigation } = this, { clientWidth, clientHeight } = this.canvas;
    if (!player.loaded) return;
    if (/^[1-9]$/.test(key)) navigation.choose(Number(key) - 1);
    if (key === "N" || key === "P") {
      const { length } = player.cameras;
      navigation.choose((player.camera + (key === "N" ? 1 : length - 1)) % length);
    }
    if (key === "R") navigation.choose(player.camera);
    if (key === "O") navigation.pick(clientWidth / 2, clientHeight / 2);
    if (key === "T") this.autorotate = !this.autorotate;
  }

  // Translates the player's events.
  forward() {
    const { player } = this;
    player.addEventListener("progress", ({ detail }) => {
      this.progress = detail.part;
      this.emit("progress", { progress: detail.part });
    });
    player.addEventListener("failed", ({ detail }) => {
      if (!player.loaded) {
        this.isReady = false;
        if (player.loader?.origin) player.loader.origin.isComplete = false;
      }
      this.emit("error", { error: detail });
    });
    player.addEventListener("problem", ({ detail }) => {
      if (detail) this.emit("error", { error: new Error(detail), option: "src" });
    });
    player.addEventListener("moved", () => this.emit("camera", {}));
    player.addEventListener("opened", () => {
      this.navigation.stop();
      const camera = player.loader.origin.firstCamera;
      if (camera === null) return;
      try {
        this.camera = camera;
      } catch (error) {
        this.emit("error", { error, option: "camera" });
      }
    });
  }

  // Calls the listeners of an event. The page reports their errors, as those of other events.
  emit(event, detail) {
    for (const listener of [...this.listeners.get(event)]) {
      try {
        listener(detail);
      } catch (error) {
        reportError(error);
      }
    }
  }

  on(event, listener) {
    checkChoice("event", event, EVENTS);
    if (typeof listener !== "function") throw new Error(`The listener of "${event}" must be a function.`);
    this.listeners.get(event).add(listener);
    return () => this.off(event, listener);
  }

  off(event, listener) {
    this.listeners.get(event)?.delete(listener);
  }

  // Starts a lazy load when the container comes near the window, and draws only there.
  watch(isVisible) {
    this.isVisible = isVisible;
    if (isVisible && this.pending) {
      const { src, name } = this.pending;
      this.pending = null;
      this.load(src, { name }).catch(() => {});
    }
    this.applyPause();
  }

  // Pauses or resumes the player, as the page, the window and screenshots need it.
  applyPause() {
    if ((this.isPaused || !this.isVisible) && !this.screenshots) this.player.pause();
    else this.player.resume();
  }

  async load(src, options) {
    if (this.isDestroyed) throw new Error(DESTROYED_TEXT);
    this.dropLoad();
    const { firstCamera } = this, name = options?.name;
    const load = { aborter: new AbortController(), firstCamera, name, isComplete: false, isReported: false };
    const dropped = new Promise((_, reject) => (load.reject = reject));
    this.currentLoad = load;
    this.pending = this.firstCamera = null;
    this.isReady = false;
    this.progress = 0;
    await Promise.race([this.show(load, src), dropped]);
  }

  // Aborts the current load and rejects its promise, unless a part of its scene is shown: then the rest still loads, in
  // case the next load fails.
  dropLoad() {
    const { player, currentLoad } = this;
    if (player.next) player.discard(player.next); // an earlier scene that is not shown yet
    if (currentLoad && !this.isCurrentShown) {
      currentLoad.reject(newAbortError());
      currentLoad.aborter.abort();
    }
    this.currentLoad = null;
  }

  // Whether the scene of the last load is shown, at least a part of it, and not an earlier scene.
  get isCurrentShown() {
    return this.currentLoad !== null && this.player.loader?.origin === this.currentLoad;
  }

  // Opens the source of a load, and emits what comes of it.
  async show(load, src) {
    const { player } = this, isDropped = () => this.currentLoad !== load;
    try {
      load.source = keepSource(src);
      const file = await openSource(load.source ?? src, load.name, load.aborter);
      if (isDropped()) return;
      await player.open({ ...file, origin: load });
    } catch (error) {
      if (isDropped() || error instanceof SupersededError) throw newAbortError();
      this.currentLoad = player.loader?.origin ?? null; // the scene that is shown stays; it may still be loading
      this.progress = player.loader?.part ?? 0;
      this.isReady = this.currentLoad !== null && this.currentLoad.isComplete;
      this.emit("error", { error });
      this.reportReady();
      throw error;
    }
    load.isComplete = true;
    if (isDropped()) throw newAbortError();
    this.isReady = true;
    this.reportReady();
  }

  // Emits "ready", once for each load, if the scene is ready and no listener has destroyed the viewer.
  reportReady() {
    const { currentLoad } = this;
    if (!this.isReady || !currentLoad || currentLoad.isReported) return;
    currentLoad.isReported = true;
    this.emit("ready", { scene: this.scene });
  }

  // The player's scene, or null if none is shown.
  get shownScene() {
    return this.isDestroyed ? null : this.player.scene;
  }

  get scene() {
    const { shownScene: scene, player: { cameras } } = this;
    if (!scene) return null;
    const { title, kind, count, up, target } = scene;
    const hasExposureMap = this.player.hasExposureMap;
    return { title, kind, count, up, target, hasExposureMap, cameras: cameras.map((view) => cameraOf(view, scene)) };
  }

  get camera() {
    return this.shownScene && this.player.viewed;
  }

  set camera(camera) {
    this.moveTo(camera, { seconds: 0 });
  }

  // The text by which links name the camera, or null while there is no scene.
  get cameraText() {
    return this.shownScene && formatCamera(this.player.eye, this.shownScene);
  }

  moveTo(camera, options) {
    if (this.isDestroyed) throw new Error(DESTROYED_TEXT);
    const { scene } = this.player, seconds = options?.seconds;
    if (!scene) throw new Error("The viewer has no scene yet; wait for 'ready'.");
    if (seconds !== undefined && !Number.isFinite(seconds)) {
      throw new Error(`seconds must be a finite number, not ${String(seconds)}.`);
    }
    this.navigation.moveTo(readCamera(camera, scene), seconds);
  }

  // Whether the eye turns slowly about its target.
  get autorotate() {
    return this.navigation.turntable.on;
  }

  set autorotate(isOn) {
    this.navigation.turntable.turn(isOn);
  }

  get exposure() {
    return this.player.exposure;
  }

  set exposure(exposure) {
    this.player.exposure = exposure;
  }

  pick(x, y) {
    const { scene } = this.player, point = this.player.findPoint(x, y);
    return point && toWorld(point, scene);
  }

  async screenshot({ type = "image/png", quality } = {}) {
    const { loaded, failure } = this.player;
    if (!loaded) throw failure ?? new Error("The viewer has no scene yet; wait for 'ready'.");
    this.screenshots++;
    this.applyPause();
    try {
      await this.player.settled;
      return await this.player.capture(type, quality);
    } finally {
      this.screenshots--;
      this.applyPause();
    }
  }

  pause() {
    this.isPaused = true;
    this.applyPause();
  }

  resume() {
    this.isPaused = false;
    this.applyPause();
  }

  destroy() {
    if (this.isDestroyed) return;
    this.dropLoad();
    this.isDestroyed = true;
    this.isReady = false;
    this.progress = 0;
    this.pending = null;
    this.observer.disconnect();
    this.navigation.dispose();
    this.player.dispose();
    this.canvas.remove();
    for (const listeners of this.listeners.values()) listeners.clear();
  }
}

const DESTROYED_TEXT = "The viewer has been destroyed; create another one.";
const CANCELLED_TEXT = "The load was cancelled: another scene was loaded, or the viewer was destroyed.";
// Returns the error with which a load that was cancelled is rejected.
const newAbortError = () => new DOMException(CANCELLED_TEXT, "AbortError");

// Throws an Error if a value is not one of the allowed ones.
function checkChoice(name, value, allowed) {
  if (!allowed.includes(value)) throw new Error(`${name} must be ${allowed.join(", ")}, not ${String(value)}.`);
}

// Returns the element that `container` is, or that it selects. It may be in a frame, whose elements have other classes.
function findContainer(container) {
  let element = container;
  try {
    if (typeof container === "string") element = document.querySelector(container);
  } catch {
    element = null; // the selector is invalid
  }
  if (element?.nodeType === Node.ELEMENT_NODE) return element;
  throw new Error("createViewer needs a container: element or selector.");
}

// Returns the address of the worker's script in full. Throws an Error if it is none.
function resolveWorker(address) {
  try {
    return new URL(address, document.baseURI).href;
  } catch {
    throw new Error(`workerUrl must be the address of the worker's script, not ${String(address)}.`);
  }
}

// Returns {number} or {view, depth} of a camera: its index from 0, its text in a link, or a camera in world units.
function readCamera(camera, scene) {
  const isText = typeof camera === "string";
  if (camera === null || !["number", "object", "string"].includes(typeof camera)) {
    throw new Error(`A camera is a number, a text or an object, not ${String(camera)}.`);
  }
  if (typeof camera !== "number") {
    try {
      return isText ? parseCamera(camera, scene) : { view: viewOf(camera, scene) };
    } catch ({ message }) {
      throw new Error(`The camera ${isText ? `${camera} ` : ""}cannot be used: ${message}.`);
    }
  }
  if (Number.isInteger(camera) && camera >= 0 && camera < scene.cameras.length) return { number: camera };
  throw new Error(`There is no camera ${camera}; the scene has cameras 0 to ${scene.cameras.length - 1}.`);
}
