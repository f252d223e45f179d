// Defines <hyrf-viewer src="scene.hyrf">, which draws a scene in the page itself or, with the attribute `frame`, shows
// the whole player in an iframe. npm/hyrf-viewer/README.md has its attributes, properties and events.

import { FRAME_ATTRIBUTES, FrameView } from "./element_frame.js";
import { INLINE_ATTRIBUTES, InlineView } from "./element_inline.js";

const ELEMENT_CSS = `
  :host { display: block; position: relative; overflow: hidden; aspect-ratio: 4 / 3; background: #000; }
  :host([hidden]) { display: none; }
  iframe { display: block; width: 100%; height: 100%; border: 0; }
  div, img { position: absolute; inset: 0; width: 100%; height: 100%; }
  img { object-fit: cover; }
  .scene { opacity: 0; transition: opacity .4s; }
  .drawn .scene { opacity: 1; }
  canvas { cursor: grab; outline-offset: -3px; -webkit-user-select: none; user-select: none; }
  canvas:active { cursor: grabbing; }
  progress {
    position: absolute; left: 0; bottom: 0; width: 100%; height: 4px; appearance: none; border: 0;
    background: rgb(0 0 0 / 40%);
  }
  progress::-webkit-progress-bar { background: none; }
  progress::-webkit-progress-value { background: #8ab4f8; }
  progress::-moz-progress-bar { background: #8ab4f8; }
  p {
    position: absolute; left: 50%; bottom: 14px; transform: translateX(-50%); box-sizing: border-box; margin: 0;
    max-width: calc(100% - 24px); padding: 6px 14px; border-radius: 10px; overflow-wrap: anywhere;
    background: rgb(22 24 28 / 90%); color: #e8eaed; font: 14px/1.4 system-ui, sans-serif; pointer-events: none;
  }
  [hidden] { display: none; }
  @media (prefers-reduced-motion: reduce) { .scene { transition: none; } }
`;

// The class exists without a browser, too, so that servers can import the package.
class HyrfViewerElement extends (globalThis.HTMLElement ?? class {}) {
  static workerAddress = null; // of the worker's script for elements without the attribute; null: the embedded one
  static observedAttributes = [...new Set(["frame", ...INLINE_ATTRIBUTES, ...FRAME_ATTRIBUTES])];

  constructor() {
    super();
    const style = new CSSStyleSheet(); // unlike style elements, no page's security policy forbids it
    style.replaceSync(ELEMENT_CSS);
    this.attachShadow({ mode: "open" }).adoptedStyleSheets = [style];
    this.view = null;
    this.isScheduled = false;
  }

  // Returns the viewer of createViewer, or null: in a frame, without a `src`, while the element is in no page, or while
  // its scene waits for the element to come near the window (see element_limit.js).
  get viewer() {
    return this.view?.viewer ?? null;
  }

  // The attribute `src`; null removes it.
  get src() {
    return this.getAttribute("src");
  }

  set src(address) {
    if (address === null || address === undefined) this.removeAttribute("src");
    else this.setAttribute("src", address);
  }

  connectedCallback() {
    if (Object.hasOwn(this, "src")) { // it was set before this class was defined, and hides the property
      const { src } = this;
      delete this.src;
      this.src = src;
    }
    this.view?.reconnect?.();
    this.schedule();
  }

  disconnectedCallback() {
    this.schedule();
  }

  // An address that is set again starts another load if the last one has failed.
  attributeChangedCallback(name) {
    if (name === "src") this.view?.forgetFailedLoad();
    this.schedule();
  }

  // Updates the view once for all changes of the same moment. An element that is moved in the page keeps its view.
  async schedule() {
    if (this.isScheduled) return;
    this.isScheduled = true;
    await null;
    this.isScheduled = false;
    const View = this.hasAttribute("frame") ? FrameView : InlineView;
    if (this.view && (!this.isConnected || !(this.view instanceof View))) {
      this.view.dispose();
      this.view = null;
    }
    if (!this.isConnected) return;
    this.view ??= new View(this);
    this.view.update();
  }

  fireEvent(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}

// Defines the element, once for a page. `workerAddress` is for elements without the attribute `worker`.
export function defineElement(workerAddress = null) {
  const registry = globalThis.customElements;
  if (!registry || registry.get("hyrf-viewer")) return;
  HyrfViewerElement.workerAddress = workerAddress;
  registry.define("hyrf-viewer", HyrfViewerElement);
}
