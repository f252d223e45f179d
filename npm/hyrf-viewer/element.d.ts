import type { Camera, Viewer } from "./index.js";

/** The element <hyrf-viewer>, which importing this module defines. */
export interface HyrfViewerElement extends HTMLElement {
  /** The attribute `src`; null removes it. */
  src: string | null;
  /**
   * The viewer, or null: with the attribute `frame`, without `src`, while the element is in no page, or while it has no
   * viewer yet or any longer. A lazy element gets one when it comes near the window. A page keeps at most 12: elements
   * that left the window may lose theirs, and get a new one when they come back. The event `load` reports it.
   */
  readonly viewer: Viewer | null;

  addEventListener<Name extends keyof ElementEvents>(
    type: Name,
    listener: (this: HyrfViewerElement, event: ElementEvents[Name]) => unknown,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(
    type: string,
    listener: EventListenerOrEventListenerObject,
    options?: boolean | AddEventListenerOptions,
  ): void;
  removeEventListener<Name extends keyof ElementEvents>(
    type: Name,
    listener: (this: HyrfViewerElement, event: ElementEvents[Name]) => unknown,
    options?: boolean | EventListenerOptions,
  ): void;
  removeEventListener(
    type: string,
    listener: EventListenerOrEventListenerObject,
    options?: boolean | EventListenerOptions,
  ): void;
}

/** Events of the element. With the attribute `frame` it fires only `load` and `error`. */
export interface HyrfViewerEventMap {
  /** A scene is loaded, for the first time or in a new viewer. */
  load: CustomEvent<string>;
  /** Something failed, or files of a scene folder are missing; `detail` is a sentence for the user. */
  error: CustomEvent<string>;
  /** `detail` is the part that is loaded, 0 to 1. */
  progress: CustomEvent<number>;
  /** The picture was drawn from another viewpoint. */
  camera: CustomEvent<Camera>;
}

interface ElementEvents extends Omit<HTMLElementEventMap, keyof HyrfViewerEventMap>, HyrfViewerEventMap {}

declare global {
  interface HTMLElementTagNameMap {
    "hyrf-viewer": HyrfViewerElement;
  }
}
