// Draws the scene of a <hyrf-viewer> in its shadow tree.

import { createViewer } from "./viewer.js";
import { MAX_SCENES, addView, assignScenes, handleLostContext, removeView } from "./element_limit.js";
import { AS_PHOTOGRAPHED } from "./exposure.js";
import { prefersReducedMotion } from "./motion.js";
import { keepPlaced } from "./poster.js";

export const INLINE_ATTRIBUTES = [
  "src", "camera", "poster", "title", "exposure", "autorotate", "interaction", "loading", "worker",
];
const FIXED_ATTRIBUTES = ["interaction", "worker"]; // a change makes a new viewer
const HINT_MS = 2500;
const WAITING_TEXT = `Only ${MAX_SCENES} scenes are drawn at a time; scroll others out of the window to see this one.`;
const LOST_TEXT = "The graphics device was lost; drawing resumes when it is back.";
const HINTS = { wheel: "Click the scene, then the wheel zooms.", finger: "Tap the scene, then fingers move it." };

export class InlineView {
  constructor(element) {
    this.element = element;
    this.viewer = null;
    this.shown = {}; // the values of the attributes at the last update
    this.isPending = false; // whether there is a scene to show, but no viewer
    this.isEager = false; // whether a pending scene is also shown far from the window
    // The scene before it was suspended, and its camera: {src, name, camera}; null if the attributes name the scene.
    this.suspended = null;
    this.isFailed = false; // whether the message is an error
    this.isLoadFailed = false; // whether the last load has failed, so that the scene of `src` is not shown
    this.failedLoad = null; // the viewer's load whose progress leaves the error shown
    this.wrongAttribute = null; // the name of the attribute whose value is wrong, null for an error of the load
    this.isLost = false; // whether the browser has taken the graphics context away
    const make = (name, attributes = {}) => {
      const made = document.createElement(name);
      for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
      return made;
    };
    this.root = make("div");
    this.poster = make("img", { alt: "", part: "poster", hidden: "" });
    this.container = make("div", { class: "scene" });
    this.placement = keepPlaced(this.poster, this.root);
    this.bar = make("progress", { max: 1, part: "progress", "aria-label": "Loading", hidden: "" });
    this.message = make("p", { role: "status", part: "message", hidden: "" });
    this.root.append(this.poster, this.container, this.bar, this.message);
    element.shadowRoot.append(this.root);
    addView(this);
  }

  dispose() {
    this.close();
    removeView(this);
    this.placement.disconnect();
    this.root.remove();
  }

  // Frees the viewer, and hides what it shows.
  close() {
    clearTimeout(this.hintTimer);
    this.viewer?.destroy();
    this.viewer = null;
    this.isFailed = this.isLoadFailed = this.isLost = this.isPending = false;
    this.bar.hidden = this.message.hidden = true;
    this.root.classList.remove("drawn");
  }

  // Frees the viewer until the element is near the window again, and the page has room for it.
  suspend() {
    this.keepScene();
    this.close();
    this.isPending = true;
    this.isEager = false;
    if (this.isVisible) this.showMessage(WAITING_TEXT);
  }

  // Lets the next viewer show the scene and the camera of this one, also if a script has loaded the scene, but not from
  // a stream, which cannot be read again. After a failed load, the next viewer tries the scene of `src`, unless another
  // scene is still shown.
  keepScene() {
    const { currentLoad, isCurrentShown, cameraText } = this.viewer ?? {};
    if (this.viewer && this.isLoadFailed && !isCurrentShown) {
      this.suspended = null;
    } else if (currentLoad) {
      const { source, name, firstCamera } = currentLoad;
      this.suspended = source && { src: source, name, camera: isCurrentShown ? cameraText : firstCamera };
    }
  }

  // Makes the next update load the scene again if its load has failed, or if files of it are missing.
  forgetFailedLoad() {
    if (this.isLoadFailed || (this.isFailed && this.wrongAttribute === "src")) this.shown.src = null;
  }

  // Shows a pending scene.
  open() {
    if (!this.isPending) return;
    this.close();
    try {
      this.create({ ...this.shown, ...this.suspended });
    } catch (error) {
      this.fail(error);
    }
  }

  // Follows the element's attributes.
  update() {
    const { element, shown: before } = this;
    const now = Object.fromEntries(INLINE_ATTRIBUTES.map((name) => [name, element.getAttribute(name)]));
    now.src ||= null; // an empty address would be that of the page
    this.shown = now;
    if (now.src === null || FIXED_ATTRIBUTES.some((name) => now[name] !== before[name])) {
      this.keepScene();
      this.close();
    }
    if (now.src !== before.src) this.suspended = null;
    else if (this.suspended && now.camera !== before.camera) this.suspended.camera = now.camera;
    if (now.poster !== before.poster) this.showPoster(now.poster);
    if (!this.viewer) {
      this.isPending = now.src !== null;
      this.isEager = now.loading !== "lazy";
      return assignScenes();
    }
    const isNew = (name) => now[name] !== before[name];
    if (isNew("title")) this.viewer.canvas.setAttribute("aria-label", now.title ?? "3D scene");
    if (isNew("autorotate")) this.viewer.autorotate = now.autorotate !== null && !prefersReducedMotion();
    if (isNew("src")) {
      this.isLoadFailed = false;
      this.hideError(this.wrongAttribute);
      this.viewer.firstCamera = now.camera;
      this.viewer.load(now.src).catch(() => {}); // the event has reported it
    } else if (isNew("camera")) {
      this.attempt("camera", () => this.moveTo(now.camera));
    }
    if (isNew("exposure")) this.attempt("exposure", () => (this.viewer.exposure = now.exposure ?? AS_PHOTOGRAPHED));
  }

  // Does what an attribute asks for. Shows the error if its value is invalid, and hides that of its value before.
  attempt(name, follow) {
    try {
      follow();
      this.hideError(name);
    } catch (error) {
      this.fail(error, name);
    }
  }

  // Hides the error of an attribute, if it is shown.
  hideError(name) {
    if (!this.isFailed || this.wrongAttribute !== name) return;
    this.isFailed = false;
    this.message.hidden = true;
  }

  // Moves the eye to the camera of the attribute, or begins there if the scene is not shown yet.
  moveTo(camera) {
    const { viewer } = this;
    if (!viewer.isCurrentShown) (viewer.currentLoad ?? viewer).firstCamera = camera;
    else if (camera !== null) viewer.moveTo(camera);
  }

  create({ src, name, camera, title, exposure, autorotate, interaction, loading, worker }) {
    this.viewer = createViewer({
      container: this.container,
      src,
      name,
      camera,
      title: title ?? undefined,
      exposure: exposure ?? undefined,
      autorotate: autorotate !== null,
      interaction: interaction ?? undefined,
      loading: loading ?? undefined,
      workerUrl: worker ?? this.element.constructor.workerAddress,
    });
    this.viewer.on("progress", ({ progress }) => {
      this.bar.hidden = progress >= 1;
      this.bar.value = progress;
      if (progress < 1 && this.isFailed && this.viewer.currentLoad !== this.failedLoad) {
        this.message.hidden = true;
        this.isFailed = this.isLoadFailed = false;
      }
      this.element.fireEvent("progress", progress);
    });
    this.viewer.on("camera", () => {
      this.root.classList.add("drawn");
      this.element.fireEvent("camera", this.viewer.camera);
    });
    this.viewer.on("ready", () => {
      this.bar.hidden = true;
      this.element.fireEvent("load", "");
    });
    this.viewer.on("error", ({ error, option }) => this.fail(error, option));
    this.viewer.player.addEventListener("problem", ({ detail }) => {
      if (!detail) this.hideError("src"); // the connection to the server of a scene folder is back
    });
    this.watchContext(this.viewer);
    this.viewer.on("ignored", ({ kind }) => this.hint(HINTS[kind]));
  }

  // Shows the poster and a message while the browser has taken the graphics context away.
  watchContext(viewer) {
    viewer.canvas.addEventListener("webglcontextlost", () => {
      if (this.viewer !== viewer) return; // it was freed
      this.isLost = true;
      this.root.classList.remove("drawn");
      if (!this.isFailed) this.showMessage(LOST_TEXT);
      handleLostContext(this);
    });
    viewer.canvas.addEventListener("webglcontextrestored", () => {
      this.isLost = false;
      this.message.hidden = !this.isFailed;
    });
  }

  showPoster(address) {
    this.poster.hidden = !address;
    if (address) this.poster.src = address;
  }

  // Shows an error until the next scene is loaded, or until the attribute whose value is wrong is corrected.
  fail({ message }, wrongAttribute = null) {
    const { viewer } = this, isOfScene = ["src", null].includes(wrongAttribute);
    Object.assign(this, { isFailed: true, wrongAttribute });
    // The progress of the scene that is shown hides neither its own errors nor that of a load that should replace it.
    this.failedLoad = (isOfScene ? viewer?.player.loader?.origin : viewer?.currentLoad) ?? null;
    this.isLoadFailed ||= !wrongAttribute;
    this.bar.hidden = true;
    this.showMessage(message);
    this.element.fireEvent("error", message);
  }

  // Shows a hint for a moment, but not in place of an error, or while the graphics context is lost.
  hint(text) {
    if (this.isFailed || this.isLost) return;
    this.showMessage(text);
    this.hintTimer = setTimeout(() => (this.message.hidden = true), HINT_MS);
  }

  showMessage(text) {
    clearTimeout(this.hintTimer);
    this.message.textContent = text;
    this.message.hidden = false;
  }
}
