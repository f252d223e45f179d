// Opens models in a worker, which decodes a file, evaluates its fields and sorts its Gaussians for each viewpoint. The
// page only receives arrays.

import { HyrfError, HyrfFormatError } from "./errors.js";

/**
 * @typedef {import("./frustum.js").View} View
 * @typedef {import("./view_evaluator.js").EvaluatedRow} EvaluatedRow
 * @typedef {import("./view_evaluator.js").SkySize} SkySize
 * @typedef {import("./view_evaluator.js").SkyTile} SkyTile
 *
 * What the worker delivers. All arrays belong to the receiver. `onOrder`: the indices of the Gaussians of a view,
 * farthest first, of which the first `drawn` are valid. `onRow`: shapes, pixel sizes and colours of a row of Gaussians.
 * `onTile`: a part of the background. `onError`: the worker has failed; it delivers nothing more.
 * @typedef {{
 *   onOrder: (order: Uint32Array, drawn: number) => void,
 *   onRow: (row: EvaluatedRow) => void,
 *   onTile: (tile: SkyTile) => void,
 *   onError: (error: HyrfError) => void,
 * }} Receiver
 *
 * A model of a file, see `RemoteModel.parts`.
 * @typedef {{
 *   place: import("./places.js").Place,
 *   firstRow: number,
 *   rowCount: number,
 *   exposure: import("./exposure.js").ExposureMap | null,
 * }} RemotePart
 *
 * What can be opened: an address (relative to that of the page or worker), or the content of a file.
 * @typedef {string | URL | Blob | ArrayBufferLike | ArrayBufferView} Source
 *
 * `name` is the file's name for error messages; by default it is the end of the address. `onProgress` is called with
 * the part (0 to 1) of the file that is loaded, and once, with 0, when decoding begins. `signal` cancels the opening.
 * `createWorker` starts the worker from `remote_worker.js`, where bundlers do not find it by themselves or the script
 * is on another site.
 * @typedef {{
 *   name?: string,
 *   onProgress?: (progress: {step: "loading" | "decoding", part: number}) => void,
 *   signal?: AbortSignal,
 *   createWorker?: () => Worker,
 * }} OpenOptions
 */

/** Starts the worker. Bundlers recognise this expression. */
const createModuleWorker = () => new Worker(new URL("./remote_worker.js", import.meta.url), { type: "module" });

/**
 * Opens a model in a worker of its own.
 * @param {Source} source
 * @param {Partial<Receiver> & OpenOptions} [options]
 * @returns {Promise<RemoteModel>} when the file is decoded; nothing is evaluated before the first call of `look`
 * @throws {HyrfError} the file cannot be fetched or read, or the worker does not start; the message names the file
 */
export const openRemoteModel = (source, options = {}) => RemoteModel.open(source, options);

/** A model in a worker. `openRemoteModel` makes one. */
export class RemoteModel {
  /** The metadata of the file, of the first part of a merged file. @type {import("./metadata.js").Metadata} */
  metadata = /** @type {any} */ (null);
  /** `metadata.config`. @type {import("./metadata.js").Config} */
  config = /** @type {any} */ (null);
  /** The number of Gaussians. */
  count = 0;
  /** The exposure map, for `logGains`, or null. @type {import("./exposure.js").ExposureMap | null} */
  exposure = null;
  /** The number of rows of Gaussians; each part of a merged file begins a row. */
  rowCount = 0;
  /**
   * The models of a merged file, or the only model: their places in the units of the first, their rows and their
   * exposure maps.
   * @type {RemotePart[]}
   */
  parts = [];
  /** The size of the background's picture, or null if there is none. @type {SkySize | null} */
  sky = null;
  /** Whether the worker was ended. */
  isClosed = false;

  /** @type {Worker} */
  #worker;
  #name;
  #options;
  #lastTicket = 0;
  /** Resolves the promise of `look`. @type {((isComplete: boolean) => void) | null} */
  #answerLook = null;
  /**
   * Settle the promise of `open`.
   * @type {{resolve: () => void, reject: (error: any) => void} | null}
   */
  #opening = null;

  /**
   * @private
   * @param {string} name
   * @param {Partial<Receiver> & OpenOptions} options
   */
  constructor(name, options) {
    this.#name = name;
    this.#options = options;
    try {
      this.#worker = (options.createWorker ?? createModuleWorker)();
    } catch (error) {
      throw describeWorkerError(name, /** @type {Error} */ (error).message);
    }
    this.#worker.onmessage = ({ data }) => this.#receive(data);
    this.#worker.onerror = (event) => {
      event.preventDefault();
      this.#fail(describeWorkerError(name, event.message));
    };
  }

  /**
   * See `openRemoteModel`.
   * @param {Source} source
   * @param {Partial<Receiver> & OpenOptions} options
   */
  static async open(source, options) {
    const { name = nameOf(source), signal } = options;
    signal?.throwIfAborted();
    const request = await describeSource(source).catch((/** @type {Error} */ { message }) => {
      throw new HyrfError(`${name}: It cannot be read (${message}); check the address or the file.`);
    });
    signal?.throwIfAborted();
    const model = new RemoteModel(name, options), abort = () => model.#fail(signal?.reason);
    signal?.addEventListener("abort", abort, { once: true });
    try {
      await new Promise((resolve, reject) => {
        model.#opening = { resolve: () => resolve(null), reject };
        model.#worker.postMessage({ open: request });
      });
    } finally {
      signal?.removeEventListener("abort", abort);
      model.#opening = null;
    }
    return model;
  }

  /**
   * Evaluates the model for a view, which replaces the previous one. The receiver gets an order, and then rows and
   * tiles, until everything in view is evaluated at the viewpoint, and later what is out of view.
   * @param {View} view in the model's local units
   * @returns {Promise<boolean>} true when everything in view was delivered; false if another view came first, or if the
   *   model was closed
   */
  look(view) {
    this.#endLook(false);
    if (this.isClosed) return Promise.resolve(false);
    this.#worker.postMessage({ look: { ticket: ++this.#lastTicket, view } });
    return new Promise((resolve) => (this.#answerLook = resolve));
  }

  /**
   * Gives an order back to the worker, which then allocates no new one.
   * @param {Uint32Array} order
   */
  reuse(order) {
    if (!this.isClosed) this.#worker.postMessage({ spare: order }, [order.buffer]);
  }

  /** Ends the worker. */
  close() {
    this.isClosed = true;
    this.#worker.terminate();
    this.#endLook(false);
  }

  /** @param {boolean} isComplete */
  #endLook(isComplete) {
    this.#answerLook?.(isComplete);
    this.#answerLook = null;
  }

  /** @param {any} message of the worker */
  #receive({ progress, opened, order, row, tile, complete, error }) {
    if (this.isClosed) return; // messages that were sent before the end may still arrive
    const { onProgress, onOrder, onRow, onTile } = this.#options;
    if (progress) onProgress?.(progress);
    if (opened) {
      Object.assign(this, opened);
      this.#opening?.resolve();
    }
    if (order) onOrder?.(order.order, order.drawn);
    if (row) onRow?.(row);
    if (tile) onTile?.(tile);
    if (complete === this.#lastTicket) this.#endLook(true);
    if (!error) return;
    const message = `${this.#name}: ${error.message}`;
    this.#fail(error.isFormat ? new HyrfFormatError(message) : new HyrfError(message));
  }

  /** @param {any} error */
  #fail(error) {
    if (this.isClosed) return;
    this.close();
    if (this.#opening) this.#opening.reject(error);
    else this.#options.onError?.(error);
  }
}

/**
 * Returns the error for a worker that does not run.
 * @param {string} name
 * @param {string | undefined} reason
 */
const describeWorkerError = (name, reason) =>
  new HyrfError(
    `${name}: The worker remote_worker.js of hyrf.js does not run${reason ? ` (${reason})` : ""}; serve it beside ` +
      "remote.js, from the page's own site, or pass `createWorker`.",
  );

/**
 * Returns the name of a file for messages.
 * @param {Source} source
 */
function nameOf(source) {
  if (typeof source !== "string" && !(source instanceof URL)) return /** @type {File} */ (source)?.name ?? "the file";
  const path = String(source).split(/[?#]/)[0];
  return decodeName(path.split("/").pop() || path);
}

/**
 * Decodes the percent signs of a part of an address.
 * @param {string} name
 */
function decodeName(name) {
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/**
 * Returns what the worker needs to know of a source. Bytes are copied, so that the caller keeps them.
 * @param {Source} source
 */
async function describeSource(source) {
  if (typeof source === "string" || source instanceof URL) {
    return { address: new URL(source, globalThis.document?.baseURI ?? globalThis.location?.href).href };
  }
  const content = source instanceof Blob ? await source.arrayBuffer() : source;
  if (ArrayBuffer.isView(content)) {
    const { buffer, byteOffset, byteLength } = content;
    return { bytes: new Uint8Array(buffer, byteOffset, byteLength).slice() }; // else the message has the whole buffer
  }
  const isBuffer = Object.prototype.toString.call(content).endsWith("ArrayBuffer]"); // also one of another frame
  if (!isBuffer) throw new TypeError("neither an address nor the content of a file");
  return { bytes: new Uint8Array(content) };
}
