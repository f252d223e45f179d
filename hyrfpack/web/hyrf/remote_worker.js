// The script of the worker that remote.js starts: reads a model and evaluates it for the latest view.
//
// Messages to the worker:
//     {open: {address | bytes}}         the model: an address to fetch, or its bytes
//     {look: {ticket, view}}            the view to evaluate; it replaces earlier ones
//     {spare}                           the array of an order that is no longer needed
// Messages from the worker:
//     {progress: {step, part}}          the part of "loading" or "decoding" that is done
//     {opened: {...}}                   what remote.js knows about a model
//     {order: {order, drawn}}           the sorted Gaussians of a view
//     {row} or {tile}                   see view_evaluator.js
//     {complete: ticket}                everything that the view needs was sent
//     {error: {message, isFormat}}      a sentence for the user

import { HEADER_BYTES, MAGIC_BYTES, readUint64 } from "./container.js";
import { HyrfError, HyrfFormatError, explainMemory, groupedDigits } from "./errors.js";
import { readFileParts } from "./reader.js";
import { MergedEvaluator } from "./merged_evaluator.js";

const PROGRESS_INTERVAL_MS = 50;

/** @typedef {import("./frustum.js").View} View */

/** @type {MergedEvaluator | null} */
let evaluator = null;
/** @type {{ticket: number, view: View} | null} */
let latest = null; // the view that was not begun yet
/** @type {Uint32Array | null} */
let spare = null;
let isRunning = false;

/**
 * Sends a message, with the buffers of its arrays.
 * @param {object} message
 * @param {ArrayBufferView[]} arrays
 */
const post = (message, arrays = []) => self.postMessage(message, { transfer: arrays.map(({ buffer }) => buffer) });

const { port1, port2 } = new MessageChannel();

/** Waits until the messages that have arrived are handled. A timer would wait for 4 ms. */
const handleMessages = () => new Promise((resolve) => {
  port1.onmessage = resolve;
  port2.postMessage(null);
});

self.onmessage = ({ data: message }) => {
  if (message.open) report(open(message.open));
  if (message.spare) spare = message.spare;
  if (!message.look) return;
  latest = message.look;
  if (!isRunning) report(run());
};

/**
 * Sends the error with which a promise is rejected.
 * @param {Promise<void>} work
 */
function report(work) {
  work.catch((/** @type {Error} */ error) => {
    const explained = explainMemory(error);
    post({ error: { message: explained.message, isFormat: explained instanceof HyrfFormatError } });
  });
}

/**
 * Reads the model.
 * @param {{address?: string, bytes?: Uint8Array}} source
 */
async function open({ address, bytes = new Uint8Array(0) }) {
  const data = address === undefined ? bytes : await fetchBytes(address);
  post({ progress: { step: "decoding", part: 0 } });
  const models = (await readFileParts(data)).map(({ model }) => model);
  evaluator = new MergedEvaluator(models);
  const { metadata, config, exposure } = models[0], count = models.reduce((sum, model) => sum + model.count, 0);
  const parts = evaluator.parts.map(({ place, firstRow, rowCount }, number) => {
    return { place, firstRow, rowCount, exposure: models[number].exposure };
  });
  post({ opened: { metadata, config, count, exposure, parts, rowCount: evaluator.rowCount, sky: evaluator.sky } });
}

/**
 * Fetches a file and reports the progress. The rest of what is no file, or is longer than its header says, is not
 * fetched.
 * @param {string} address
 */
async function fetchBytes(address) {
  const response = await fetch(address).catch(() => {
    throw new HyrfError("It cannot be fetched; check the address, and whether its server allows this page to read it.");
  });
  if (!response.ok || !response.body) {
    throw new HyrfError(`Its server answers with the status ${response.status}; check the address.`);
  }
  const reader = response.body.getReader();
  /** @type {Uint8Array[]} */
  const parts = [];
  let received = 0, reported = 0, length = Infinity;
  while (received <= length) {
    const { done, value } = await reader.read().catch(() => {
      throw new HyrfError(`The connection was lost after ${groupedDigits(received)} bytes; open it again.`);
    });
    if (done) return joinBytes(parts, received);
    parts.push(value);
    received += value.length;
    if (length === Infinity && received >= HEADER_BYTES) length = declaredLength(joinBytes(parts, received));
    if (performance.now() < reported + PROGRESS_INTERVAL_MS) continue;
    reported = performance.now();
    post({ progress: { step: "loading", part: Math.min(1, received / length) } });
  }
  reader.cancel().catch(() => {}); // the connection may be lost meanwhile
  return joinBytes(parts, received);
}

/**
 * Returns the length of a file by its header, or 0 if it is no `.hyrf` file.
 * @param {Uint8Array} bytes its start
 */
const declaredLength = (bytes) =>
  MAGIC_BYTES.every((byte, i) => bytes[i] === byte) ? readUint64(new DataView(bytes.buffer), 16) : 0;

/**
 * Joins the pieces of a file.
 * @param {Uint8Array[]} parts
 * @param {number} length the sum of their lengths
 */
function joinBytes(parts, length) {
  const bytes = new Uint8Array(length);
  let at = 0;
  for (const part of parts) {
    bytes.set(part, at);
    at += part.length;
  }
  return bytes;
}

/** Evaluates the latest view, until everything is evaluated. */
async function run() {
  isRunning = true;
  while (latest && evaluator) {
    const { ticket, view } = latest;
    latest = null;
    const { order, drawn } = evaluator.sort(view, spare);
    spare = null;
    post({ order: { order, drawn } }, [order]);
    for (const part of evaluator.evaluate(view, () => post({ complete: ticket }))) {
      const arrays = "row" in part ? [part.shapes, part.pixelSizes, part.colors] : [part.pixels];
      post("row" in part ? { row: part } : { tile: part }, arrays.filter((array) => array !== null));
      await handleMessages();
      if (latest) break;
    }
  }
  isRunning = false;
}
