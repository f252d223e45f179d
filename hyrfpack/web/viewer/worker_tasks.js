// Reads a file and sorts its splats by depth, in a worker, so that the page's own thread stays responsive.
//
// Messages to the worker:
//     {start: {name, scene, stage, plain}}   a file follows; `scene` or `stage` (cameras, up, target) if the page has
//                                            them; `plain`: decode it as splats
//     {bytes}                                the next piece of the file
//     {end} or {broken}                      the file is complete, or no more of it can be read
//     {again: {plain}}                       decode the same bytes again
//     {use: number}                          select the content to sort
//     {sort: {ticket, row, sides, near, order}}
// Messages from the worker:
//     {progress: {what, part}}
//     {content: {number, whole, scene, model | splats, picture}}   see pack.js
//     {order: {ticket, number, order, drawn}}
//     {error}                                the reason, as soon as it is certain that the file cannot be read

import { ENTRY_BYTES, HEADER_BYTES, MAGIC_BYTES, MAX_SECTIONS } from "../hyrf/container.js";
import { fitHarmonics } from "../hyrf/harmonics.js";
import { describe, read } from "../hyrf/index.js";
import { viewpointOf } from "../hyrf/viewpoint.js";
import { TEXTURE_WIDTH } from "./constants.js";
import { packModel, packSplats } from "./pack.js";
import { backgroundPicture, modelScene, splatsScene } from "./scene.js";
import { DepthSort } from "./sort.js";

const FIRST_LAYER_DELAY_MS = 150; // if the rest of the file arrives in this time, the first layer is not shown alone
const MAX_FIRST_LAYER_RATIO = 0.8; // a first layer that is a larger part of its file is not shown alone
const HARMONICS_DEGREE = 3;
const MAX_UNSIZED_FILE_BYTES = 2 ** 32; // the limit for formats whose header does not give the file's length
// The magic bytes without the line ends, which a transfer may damage; the reader has a better message for that.
const MODEL_SIGNATURE = MAGIC_BYTES.slice(0, 5);

let readSplats = null;
let request = null;
let pieces = [];
let length = 0;
let firstBytes = new Uint8Array(HEADER_BYTES + ENTRY_BYTES * MAX_SECTIONS); // null once the format is known
let kind = null; // "model" or "other"; null until the format is known
let maxLength = Infinity; // in bytes
let firstLayerLength = Infinity; // in bytes; finite if a model's first layer may be shown alone
let ended = false;
let broken = false; // whether a part of the file is missing or damaged
let decodedLength = 0; // the number of bytes in the last decoding
let isRejected = false; // whether the whole file is useless
let queue = Promise.resolve();
let number = 0;
const sorters = new Map(); // number of a content -> its DepthSort
let sortedContent = null;

// Starts to handle messages. `reader(name, bytes)` decodes files of splats, like decodeSplats in formats/index.js.
export function startWorker(reader) {
  readSplats = reader;
  onmessage = (event) => handleMessage(event.data);
}

function handleMessage(data) {
  if (data.start) request = data.start;
  if (data.bytes) receiveBytes(data.bytes);
  if (data.end) {
    ended = true;
    queueDecoding(false);
  }
  if (data.broken) broken = ended = true;
  if (data.again) {
    request.plain ||= data.again.plain;
    if (ended) queueDecoding(broken); // otherwise the file is decoded at its end
  }
  if (data.use !== undefined) selectContent(data.use);
  if (data.sort) sortContent(data.sort);
}

const reportProgress = (what, part) => postMessage({ progress: { what, part } });

// Decodes the bytes so far, after any earlier decoding has ended. `partial` is true if the file is not complete.
function queueDecoding(partial) {
  if (isRejected) return;
  queue = queue
    .then(() => (partial && ended && !broken ? null : decode(partial)))
    .catch((error) => {
      broken = true; // `again` then decodes only bytes that could be decoded before
      reportError(error);
    });
}

function reportError(error) {
  const isOutOfMemory = error instanceof RangeError; // thrown for arrays that are too long
  postMessage({ error: isOutOfMemory ? "There is not enough memory; open a smaller file." : error.message });
}

// Stores a piece of the file, and starts to decode the first layer when it is complete.
function receiveBytes(bytes) {
  if (isRejected) return;
  const before = length;
  pieces.push(bytes);
  length += bytes.length;
  try {
    if (kind === null) identifyFile(bytes, before);
    if (length > maxLength) rejectLongFile();
  } catch (error) {
    isRejected = true;
    pieces = [];
    reportError(error);
    return;
  }
  const hasFirstLayer = before < firstLayerLength && length >= firstLayerLength;
  if (hasFirstLayer) setTimeout(() => queueDecoding(true), FIRST_LAYER_DELAY_MS);
}

// Identifies the format from the first bytes. Throws an error if a model's header is invalid.
function identifyFile(bytes, before) {
  if (before < firstBytes.length) firstBytes.set(bytes.subarray(0, firstBytes.length - before), before);
  const available = firstBytes.subarray(0, length);
  if (!MODEL_SIGNATURE.every((byte, k) => k >= length || available[k] === byte)) {
    kind = "other";
    maxLength = MAX_UNSIZED_FILE_BYTES;
    firstBytes = null;
    return;
  }
  if (length < HEADER_BYTES) return;
  const parts = new DataView(firstBytes.buffer).getUint32(36, true);
  if (parts <= MAX_SECTIONS && length < HEADER_BYTES + ENTRY_BYTES * parts) return;
  const description = describe(available);
  kind = "model";
  maxLength = description.length;
  if (!request.plain && description.firstLayer < MAX_FIRST_LAYER_RATIO * description.length) {
    firstLayerLength = description.firstLayer;
  }
  firstBytes = null;
}

// Throws the error for a file that is too long.
function rejectLongFile() {
  if (kind === "model") describe(gatherBytes()); // throws an error about the length
  throw new Error("It is larger than 4 GiB; open a smaller one.");
}

// Returns all bytes so far as one array.
function gatherBytes() {
  if (pieces.length !== 1) {
    const all = new Uint8Array(length);
    pieces.reduce((at, piece) => (all.set(piece, at), at + piece.length), 0);
    pieces = [all];
  }
  return pieces[0];
}

// Decodes the file and posts its content.
async function decode(partial) {
  const all = gatherBytes(), bytes = partial && broken ? all.subarray(0, decodedLength || length) : all;
  const { name, scene, stage, plain } = request, content = { number: ++number, whole: !partial };
  reportProgress("unpacking", 0);
  const transferred = [];
  let positions;
  if (kind !== "other" && length >= MODEL_SIGNATURE.length) {
    const model = await read(bytes, { partial });
    content.scene = { ...(scene ?? { ...modelScene(model, name), ...stage }), exposure: model.exposure };
    positions = model.positions;
    if (plain) {
      reportProgress("unpacking", 1);
      const report = ({ done }) => reportProgress("preparing", done);
      const { fitted } = viewpointOf(model.metadata);
      content.splats = packSplats(await fitHarmonics(model, fitted, HARMONICS_DEGREE, report));
      content.picture = backgroundPicture(model);
    } else {
      content.model = packModel(model);
    }
  } else {
    const splats = await readSplats(name, bytes);
    if (scene) convertToScene(splats, scene);
    content.scene = scene ?? splatsScene(splats, name);
    positions = splats.positions;
    content.splats = packSplats(splats);
  }
  sorters.set(content.number, new DepthSort(positions, TEXTURE_WIDTH));
  decodedLength = bytes.length;
  reportProgress("unpacking", 1);
  const { splats, model, picture } = content;
  for (const part of [splats, model, model?.geometry, model?.radiance, picture]) {
    for (const value of Object.values(part ?? {})) if (ArrayBuffer.isView(value)) transferred.push(value.buffer);
  }
  postMessage({ content }, [...new Set(transferred)]);
}

// Converts splats to the origin and the unit of the page's scene.
function convertToScene(splats, scene) {
  const { center, unit } = splats;
  for (let i = 0; i < splats.positions.length; i++) {
    splats.positions[i] = splats.positions[i] * unit + center[i % 3];
    splats.scales[i] *= unit;
  }
  Object.assign(splats, { center: scene.center, unit: scene.unit });
}

// Selects the content to sort, and drops older ones.
function selectContent(content) {
  sortedContent = content;
  for (const other of sorters.keys()) if (other < content) sorters.delete(other);
}

// Posts the order of the splats for a request.
function sortContent({ ticket, row, sides, near, order: spare }) {
  const { order: sorted, drawn } = sorters.get(sortedContent).sort(row, sides, near, spare);
  postMessage({ order: { ticket, number: sortedContent, order: sorted, drawn } }, [sorted.buffer]);
}
