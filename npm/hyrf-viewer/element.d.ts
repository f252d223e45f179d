import type { Camera, Viewer } from "./index.js";

/** The element <hyrf-viewer>, which importing this module defines. */
export interface HyrfViewerElement extends HTMLElement {
  /** The viewer, or null: with the attribute `frame`, without `src`, or while the element is in no page. */
  readonly viewer: Viewer | null;
}

export interface HyrfViewerEventMap {
  /** A scene is loaded. */
  load: CustomEvent<string>;
  /** Something failed; `detail` is a sentence for the user. */
  error: CustomEvent<string>;
  /** `detail` is the part that is loaded, 0 to 1. */
  progress: CustomEvent<number>;
  /** The picture was drawn from another viewpoint. */
  camera: CustomEvent<Camera>;
}

declare global {
  interface HTMLElementTagNameMap {
    "hyrf-viewer": HyrfViewerElement;
  }
}
