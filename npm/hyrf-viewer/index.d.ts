/**
 * A pinhole camera. Lengths of the pose are in the file's world units, the rest in pixels.
 */
export interface Camera {
  /** Size of the picture. */
  width: number;
  height: number;
  /** Focal lengths and principal point. */
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  /** 4 x 4, row by row, with OpenCV axes: x right, y down, z forward. The last row may be absent. */
  camera_from_world: number[][];
}

/**
 * Names a camera: its index in `scene.cameras` (from 0), the text of a link as `cameraText` has it (its plain numbers
 * count from 1), or a camera.
 */
export type CameraName = number | string | Camera;

/** "as-photographed" has the exposure of the photos taken near the viewpoint, "consistent" one exposure everywhere. */
export type Exposure = "as-photographed" | "consistent";

/**
 * A `.hyrf`, `.ply`, `.spz`, `.splat` or `.sog` file: its address, or its content. Or the address of the `scene.json`
 * of a scene folder.
 */
export type Source = string | URL | Blob | ArrayBuffer | ArrayBufferView | ReadableStream<Uint8Array>;

/** What draws scenes: the value `webgpu` of "hyrf-viewer/webgpu". It has no use but the option `renderer`. */
export type SceneRenderer = abstract new (...values: never[]) => object;

export interface ViewerOptions {
  /** The element, or a selector of it, that the canvas fills. It needs a height. */
  container: Element | string;
  /** The first scene. */
  src?: Source | null;
  /** File name of the first scene if `src` has none. Endings tell formats of splats apart. */
  name?: string;
  /** The first camera of the first scene; later loads do not use it, even if the first one fails. */
  camera?: CameraName | null;
  exposure?: Exposure;
  /** Turn slowly while the user makes no input, unless the user prefers reduced motion. */
  autorotate?: boolean;
  /**
   * "after-click" (the default): wheel and fingers scroll the page until the scene is clicked. "always": they move the
   * scene at once. "none": the scene takes no input.
   */
  interaction?: "after-click" | "always" | "none";
  /** "lazy": the first scene is loaded when the container comes near the window. */
  loading?: "eager" | "lazy";
  /** Accessible name of the canvas. */
  title?: string;
  /**
   * Address of the package's `worker.js` on the page's own site. It is needed only where a Content-Security-Policy
   * forbids `worker-src blob:`.
   */
  workerUrl?: string | URL | null;
  /** The most Gaussians of a scene folder at a time. Default: 2 million, 500,000 on phones. */
  maxGaussians?: number | null;
  /**
   * `webgpu` of "hyrf-viewer/webgpu": draw files of one model with WebGPU where the browser has it. Other scenes, and
   * browsers without WebGPU, are drawn with WebGL 2, which is the default.
   */
  renderer?: SceneRenderer;
}

export interface SceneInfo {
  /** Name of the file. */
  title: string;
  /** "hyrf" for a model whose fields are evaluated, "splats" for a file of splats. */
  kind: "hyrf" | "splats";
  /** Number of Gaussians. */
  count: number;
  /** Upward direction and centre of the scene, in the file's world units. */
  up: [number, number, number];
  target: [number, number, number];
  /** Whether `exposure` makes a difference. */
  hasExposureMap: boolean;
  /** Up to 12 cameras of the file, evenly spaced among them, or 12 made-up ones for a file without cameras. */
  cameras: Camera[];
}

export interface ViewerEvents {
  /** A scene is loaded. If it was complete while a later load was pending, it is fired when that load fails. */
  ready: { scene: SceneInfo };
  /** The part of the scene that is loaded, 0 to 1. */
  progress: { progress: number };
  /**
   * Something failed. The message is a sentence for the user. With `option`, the scene is shown all the same: "camera"
   * if its first camera is wrong, "src" if files of a scene folder are missing or damaged, or its server no longer
   * answers.
   */
  error: { error: Error; option?: "camera" | "src" };
  /** A frame was drawn from another viewpoint; `viewer.camera` has it. */
  camera: Record<string, never>;
  /** A wheel or a finger was left to the page, see `interaction`. */
  ignored: { kind: "wheel" | "finger" };
}

/** Shows a scene in an element. Frames are drawn only if something changes, and only near the window. */
export interface Viewer {
  readonly canvas: HTMLCanvasElement;
  /** The part of the scene that is loaded, 0 to 1. */
  readonly progress: number;
  /** Whether a scene is loaded and none is being loaded. */
  readonly isReady: boolean;
  /** The scene that is shown, or null. */
  readonly scene: SceneInfo | null;
  /** The camera of the canvas, or null without a scene. Setting it moves there at once. */
  get camera(): Camera | null;
  set camera(camera: CameraName);
  /** The camera as a short text, for links, or null without a scene. */
  readonly cameraText: string | null;
  exposure: Exposure;
  autorotate: boolean;

  /**
   * Loads another scene; the present one stays until it is ready. Rejects with a sentence for the user, which the event
   * "error" has, too, or with an AbortError if yet another scene is loaded or the viewer is destroyed. Either ends the
   * request, and cancels a stream, of which no part is shown yet. Bytes and the arrays of a stream are copied.
   */
  load(source: Source, options?: { name?: string }): Promise<void>;
  /** Glides to a camera in `seconds`, at once for 0. Throws an error if one is invalid or there is no scene. */
  moveTo(camera: CameraName, options?: { seconds?: number }): void;
  /** Returns the visible point at a place of the canvas in CSS pixels, in world units, or null if there is none. */
  pick(x: number, y: number): [number, number, number] | null;
  /** Returns the complete picture of the canvas as a file. `type` and `quality` are those of `canvas.toBlob`. */
  screenshot(options?: { type?: string; quality?: number }): Promise<Blob>;
  /** Stops drawing until `resume`. */
  pause(): void;
  resume(): void;
  /**
   * Calls a listener with each event of a kind. Returns a function that ends this. Errors of listeners are reported as
   * those of other events are, by the window's event "error".
   */
  on<Name extends keyof ViewerEvents>(event: Name, listener: (detail: ViewerEvents[Name]) => void): () => void;
  off<Name extends keyof ViewerEvents>(event: Name, listener: (detail: ViewerEvents[Name]) => void): void;
  /** Removes the canvas and frees workers and graphics memory. Then there is no scene, and none can be loaded. */
  destroy(): void;
}

/**
 * Creates a viewer in an element.
 *
 * @throws {Error} an option is invalid, or the browser has no WebGL 2; the message is a sentence for the user
 */
export function createViewer(options: ViewerOptions): Viewer;
