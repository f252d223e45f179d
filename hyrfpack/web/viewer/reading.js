// What a worker does: read a file and sort what is in it by depth, away from the page's own thread.
//
// In:   {start: {name, scene, stage, plain}}   a file is to come; what the page knows of it, if anything, or of where
// to
//                                   look at it from (cameras, up, target); `plain`: as splats
//       {bytes}                           of the file, piece by piece; after them {end}, or {broken}: no more come
//       {again: {plain}}                  what was read is wanted once more
//       {use: number}                     orders are of this content from now on
//       {sort: {ticket, row, sides, near, order}}
// Out:  {progress: {what, part}}
//       {content: {number, whole, scene, model | splats, picture}}   see pack.js; the scene as the player knows it
//       {order: {ticket, number, order, drawn}}
//       {error}                           why it cannot be read, said as soon as that is certain

import { ENTRY_BYTES, HEADER_BYTES, MAGIC_BYTES, MAX_SECTIONS } from "../hyrf/container.js";
import { fitHarmonics } from "../hyrf/harmonics.js";
import { describe, read } from "../hyrf/index.js";
import { viewpointOf } from "../hyrf/viewpoint.js";
import { TEXTURE_WIDTH } from "./layout.js";
import { packModel, packSplats } from "./pack.js";
import { backgroundPicture, modelScene, splatsScene } from "./scene.js";
import { DepthSort } from "./sort.js";

const PATIENCE = 150; // ms that the rest of a file may take to come before its first layer is shown
const DEGREE = 3; // of harmonics
const LARGEST_FILE = 2 ** 32; // bytes of files that do not say themselves how long they are
const MARK = MAGIC_BYTES.slice(0, 5); // a model begins so, also where a transfer has spoilt the line ends after it

let readSplats = null;
let wanted = null;
let pieces = [];
let length = 0;
let head = new Uint8Array(HEADER_BYTES + ENTRY_BYTES * MAX_SECTIONS); // first bytes, until what it is is known
let kind = null; // "model" or "other", once that is known
let most = Infinity; // bytes that the file can have
let first = Infinity; // bytes of a model's first layer, where they are worth showing alone
let ended = false;
let broken = false; // not all of the file can be decoded
let decoded = 0; // bytes of which that was done last
let refused = false; // nothing of the file is of use
let working = Promise.resolve();
let number = 0;
const sorts = new Map(); // content -> its order
let used = null;

// Begin to listen. `reader(name, bytes)` decodes files of splats, see formats/index.js.
export function startWorker(reader) {
  readSplats = reader;
  onmessage = (event) => listen(event.data);
}

function listen(data) {
  if (data.start) wanted = data.start;
  if (data.bytes) take(data.bytes);
  if (data.end) {
    ended = true;
    work(false);
  }
  if (data.broken) broken = ended = true;
  if (data.again) {
    wanted.plain ||= data.again.plain;
    if (ended) work(broken); // else the end brings it
  }
  if (data.use !== undefined) use(data.use);
  if (data.sort) order(data.sort);
}

const tell = (what, part) => postMessage({ progress: { what, part } });

// Decode what is there, after what is being decoded already.
function work(partial) {
  if (refused) return;
  working = working
    .then(() => (partial && ended && !broken ? null : decode(partial)))
    .catch((error) => {
      broken = true; // what was decoded before can be had again
      tellError(error);
    });
}

function tellError(error) {
  const memory = error instanceof RangeError; // an array that is too long
  postMessage({ error: memory ? "It takes more memory than there is; open a smaller one." : error.message });
}

function take(bytes) {
  if (refused) return;
  const before = length;
  pieces.push(bytes);
  length += bytes.length;
  try {
    if (kind === null) learn(bytes, before);
    if (length > most) tooLong();
  } catch (error) {
    refused = true;
    pieces = [];
    tellError(error);
    return;
  }
  if (before < first && length >= first) setTimeout(() => work(true), PATIENCE);
}

// Find out from its first bytes what the file is. Throws where a model says what cannot be.
function learn(bytes, before) {
  if (before < head.length) head.set(bytes.subarray(0, head.length - before), before);
  const there = head.subarray(0, length);
  if (!MARK.every((byte, k) => k >= length || there[k] === byte)) {
    kind = "other";
    most = LARGEST_FILE;
    head = null;
    return;
  }
  if (length < HEADER_BYTES) return;
  const parts = new DataView(head.buffer).getUint32(36, true);
  if (parts <= MAX_SECTIONS && length < HEADER_BYTES + ENTRY_BYTES * parts) return;
  const told = describe(there);
  kind = "model";
  most = told.length;
  if (!wanted.plain && told.firstLayer < 0.8 * told.length) first = told.firstLayer;
  head = null;
}

function tooLong() {
  if (kind === "model") describe(gathered()); // says it
  throw new Error("It is longer than 4 GiB; open a smaller one.");
}

// All bytes that are there, as one piece.
function gathered() {
  if (pieces.length !== 1) {
    const all = new Uint8Array(length);
    pieces.reduce((at, piece) => (all.set(piece, at), at + piece.length), 0);
    pieces = [all];
  }
  return pieces[0];
}

async function decode(partial) {
  const all = gathered(), bytes = partial && broken ? all.subarray(0, decoded || length) : all;
  const { name, scene, stage, plain } = wanted, content = { number: ++number, whole: !partial };
  tell("unpacking", 0);
  const transferred = [];
  let positions;
  if (kind !== "other" && length >= MARK.length) {
    const model = await read(bytes, { partial });
    content.scene = { ...(scene ?? { ...modelScene(model, name), ...stage }), exposure: model.exposure };
    positions = model.positions;
    if (plain) {
      tell("unpacking", 1);
      const report = ({ done }) => tell("preparing", done);
      content.splats = packSplats(await fitHarmonics(model, viewpointOf(model.metadata).fitted, DEGREE, report));
      content.picture = backgroundPicture(model);
    } else {
      content.model = packModel(model);
    }
  } else {
    const splats = await readSplats(name, bytes);
    if (scene) settle(splats, scene);
    content.scene = scene ?? splatsScene(splats, name);
    positions = splats.positions;
    content.splats = packSplats(splats);
  }
  sorts.set(content.number, new DepthSort(positions, TEXTURE_WIDTH));
  decoded = bytes.length;
  tell("unpacking", 1);
  const { splats, model, picture } = content;
  for (const part of [splats, model, model?.geometry, model?.radiance, picture]) {
    for (const value of Object.values(part ?? {})) if (ArrayBuffer.isView(value)) transferred.push(value.buffer);
  }
  postMessage({ content }, [...new Set(transferred)]);
}

// Splats of a page, which has said where its origin lies and how long its unit is.
function settle(splats, scene) {
  const { center, unit } = splats;
  for (let i = 0; i < splats.positions.length; i++) {
    splats.positions[i] = splats.positions[i] * unit + center[i % 3];
    splats.scales[i] *= unit;
  }
  Object.assign(splats, { center: scene.center, unit: scene.unit });
}

function use(content) {
  used = content;
  for (const other of sorts.keys()) if (other < content) sorts.delete(other);
}

function order({ ticket, row, sides, near, order: spare }) {
  const { order: sorted, drawn } = sorts.get(used).sort(row, sides, near, spare);
  postMessage({ order: { ticket, number: used, order: sorted, drawn } }, [sorted.buffer]);
}
