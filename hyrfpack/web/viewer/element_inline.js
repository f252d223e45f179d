// Draws the scene of a <hyrf-viewer> in its shadow tree.

import { createViewer } from "./viewer.js";
import { AS_PHOTOGRAPHED } from "./exposure.js";
import { prefersReducedMotion } from "./motion.js";
import { keepPlaced } from "./poster.js";
import { siblingAddress } from "./script_address.js";

export const INLINE_ATTRIBUTES = [
  "src", "camera", "poster", "title", "exposure", "autorotate", "interaction", "loading", "worker",
];
const FIXED_ATTRIBUTES = ["interaction", "worker"]; // a change makes a new viewer
const HINT_MS = 2500;
const HINTS = { wheel: "Click the scene, then the wheel zooms.", finger: "Tap the scene, then fingers move it." };

export class InlineView {
  constructor(element) {
    this.element = element;
    this.viewer = null;
    this.shown = {}; // the values of the attributes at the last update
    this.isFailed = false; // whether the message is an error
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
  }

  dispose() {
    this.close();
    this.placement.disconnect();
    this.root.remove();
  }

  // Frees the viewer, and hides what it shows.
  close() {
    clearTimeout(this.hintTimer);
    this.viewer?.destroy();
    this.viewer = null;
    this.isFailed = false;
    this.bar.hidden = this.message.hidden = true;
    this.root.classList.remove("drawn");
  }

  // Follows the element's attributes.
  update() {
    const { element, shown: before } = this;
    const now = Object.fromEntries(INLINE_ATTRIBUTES.map((name) => [name, element.getAttribute(name)]));
    this.shown = now;
    if (now.src === null || FIXED_ATTRIBUTES.some((name) => now[name] !== before[name])) this.close();
    if (now.poster !== before.poster) this.showPoster(now.poster);
    if (now.src === null) return;
    try {
      if (!this.viewer) return this.create(now);
      if (now.title !== before.title) this.viewer.canvas.setAttribute("aria-label", now.title ?? "3D scene");
      if (now.exposure !== before.exposure) this.viewer.exposure = now.exposure ?? AS_PHOTOGRAPHED;
      if (now.autorotate !== before.autorotate) {
        this.viewer.autorotate = now.autorotate !== null && !prefersReducedMotion();
      }
      if (now.src !== before.src) {
        this.viewer.firstCamera = now.camera;
        this.viewer.load(now.src).catch(() => {}); // the event has reported it
      } else if (now.camera !== before.camera) {
        if (!this.viewer.scene) this.viewer.firstCamera = now.camera;
        else if (now.camera !== null) this.viewer.moveTo(now.camera);
      }
    } catch (error) {
      this.fail(error);
    }
  }

  create({ src, camera, title, exposure, autorotate, interaction, loading, worker }) {
    this.viewer = createViewer({
      container: this.container,
      src,
      camera,
      title: title ?? undefined,
      exposure: exposure ?? undefined,
      autorotate: autorotate !== null,
      interaction: interaction ?? undefined,
      loading: loading ?? undefined,
      workerUrl: worker ?? siblingAddress("player-worker.js"),
    });
    this.viewer.on("progress", ({ progress }) => {
      this.bar.hidden = progress >= 1;
      this.bar.value = progress;
      if (progress < 1) {
        this.message.hidden = true;
        this.isFailed = false;
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
    this.viewer.on("error", ({ error }) => this.fail(error));
    this.viewer.on("ignored", ({ kind }) => this.hint(HINTS[kind]));
  }

  showPoster(address) {
    this.poster.hidden = !address;
    if (address) this.poster.src = address;
  }

  // Shows an error until the next scene is loaded.
  fail({ message }) {
    clearTimeout(this.hintTimer);
    this.isFailed = true;
    this.bar.hidden = true;
    this.message.textContent = message;
    this.message.hidden = false;
    this.element.fireEvent("error", message);
  }

  // Shows a hint for a moment, but not in place of an error.
  hint(text) {
    if (this.isFailed) return;
    clearTimeout(this.hintTimer);
    this.message.textContent = text;
    this.message.hidden = false;
    this.hintTimer = setTimeout(() => (this.message.hidden = true), HINT_MS);
  }
}
