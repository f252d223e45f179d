// Reads a scene folder as views need it, in the worker: fetches the coarsest levels of chunks first and then, by
// priority, the levels that suit the view within a budget of Gaussians; decodes them, and drops what is not needed when
// memory is short. Neither the memory for Gaussians (see level_choice.js) nor that for the fields of parts grows with
// the scene: a level needs the fields of its part only until it is evaluated.
//
// Messages to the worker, beside those in worker_tasks.js; `number` is that of the content:
//     {stream: {manifest, address, name, views, gaussians, maxRows}}   open the scene with the text `manifest` from
//                                            `address`, with at most `gaussians` in a view, in textures of at most
//                                            `maxRows` rows
//     {look: {ticket, view}}                 choose levels for a view
//     {gaussians}                            another budget
//     {uploaded: {number, chunk, level}}     a level can be drawn
//     {faded: {number, chunk}}               of a `swap`, only the last level is still drawn
//     {unusable: {part, reason}}             the device cannot draw a part
//     {again}                                send the content again, because the graphics device was lost
// Messages from the worker:
//     {content: {..., parts, chunks}}        the content, with the first part of the scene as its model; the further
//                                            parts that were read, and the levels that are drawn at once
//     {part: {number, part, model, place, exposure}}   a further part of the scene, or its fields again;
//                                            if its model is null, they are dropped
//     {chunk: {number, chunk, level, part, rows, explicit, logits, shapeResiduals, colorResiduals, pixelSizes, balls}}
//                                            a level to upload to `rows`
//     {swap: {number, chunk, from, to, mse}}   fade from the rows of one level to those of another one, which changes
//                                            the picture by about `mse`
//     {state: {ticket, isComplete, gaussians, resident, bytes, totalBytes, psnr, problem}}   of the view with this
//                                            ticket: the Gaussians drawn and in memory, the bytes received and of the
//                                            scene, the predicted PSNR in dB; `problem` is a sentence

import { explainMemory } from "../../hyrf/errors.js";
import { parseManifest } from "../../hyrf/manifest.js";
import { movePositions } from "../../hyrf/places.js";
import { rowBalls } from "../../hyrf/row_states.js";
import { DepthSort } from "../../hyrf/sort.js";
import { viewpointOf } from "../../hyrf/viewpoint.js";
import { cameraOf } from "../camera.js";
import { packGaussians } from "../pack.js";
import { modelScene } from "../scene.js";
import { ABSENT, ChunkLevels, READY, UNUSABLE, UPLOADING } from "./chunk_levels.js";
import { FileQueue } from "./file_queue.js";
import { chooseTargets } from "./level_choice.js";
import { RowPool } from "./row_pool.js";
import { ScenePart } from "./scene_part.js";

const ROW_WIDTH = 256; // of the textures: each level begins a row, and the coarsest ones are small
const FIRST_PICTURE_BYTES = 200_000; // the first picture waits for so many bytes of files, and for one chunk at least
const MEMORY_PER_BUDGET_RATIO = 1.25; // Gaussians in memory, above 1 because levels that fade are there twice
// Rows beyond that memory: for each of so many chunks, one for its coarsest level and one for rows that are not full.
const EXTRA_ROWS_PER_CHUNK = 2, MAX_EXTRA_CHUNKS = 256;
// More rows do not wait to be evaluated, so that a slow device evaluates what the present view needs, and not all that
// earlier views needed.
const MAX_UPLOADING_ROWS = 512;
// Bytes of the tables of further parts that are in memory, for each Gaussian of the budget, which itself takes about as
// many bytes. Two parts of any size are always allowed: one loads while levels of the other are evaluated.
const FIELD_BYTES_PER_GAUSSIAN = 128, MIN_FURTHER_PARTS = 2;
const MAX_EARLY_LOSSES = 3; // after so many losses of the connection, the first picture is drawn of what is there
const MAX_PSNR_DB = 99;
const MIN_UPDATE_INTERVAL_MS = 20; // between two updates, so that many events cause only one

// Returns the number of rows that Gaussians take, at least one.
const countRows = (gaussians) => Math.max(1, Math.ceil(gaussians / ROW_WIDTH));

export class SceneStream {
  // `sorter` sorts the Gaussians (see worker_tasks.js), and `post` sends messages.
  constructor(request, sorter, post) {
    Object.assign(this, { request, sorter, post });
    this.number = 0; // of the content
    this.gaussians = request.gaussians;
    this.problems = new Map(); // name of an unusable file -> the reason
    this.isOpening = false; // whether the content is being prepared
    this.isShown = false; // whether it was sent
    this.isClosed = false; // whether nothing more is fetched
    this.early = new Map(); // name of a file that came before the shared file of its part -> [file, bytes]
    this.isOutdated = true; // whether levels must be chosen again
    this.isShort = false; // whether a wanted level does not fit into memory
    this.decoding = new Set(); // names of files that are being decoded
    this.timer = null; // of the next update
    this.updateMs = 0; // the time that the last update took
    this.resume = () => this.queue.resume();
    try {
      this.open();
    } catch (error) {
      post({ error: explainMemory(error).message });
    }
  }

  // Reads the manifest and starts to fetch files.
  open() {
    const { manifest: text, address, maxRows } = this.request, manifest = parseManifest(text), { chunks } = manifest;
    this.manifest = manifest;
    this.parts = manifest.parts.map((file, number) => new ScenePart(number, file));
    this.recentParts = this.parts; // those whose fields were used last come first
    this.chunks = chunks.map((chunk, number) => new ChunkLevels(number, chunk, countRows));
    const files = [...manifest.parts, ...chunks.flatMap(({ levels }) => levels)];
    this.fileBytes = files.reduce((sum, file) => sum + file.bytes, 0);
    this.places = new Map(); // name of a file -> [number of the chunk, level]
    chunks.forEach(({ levels }, number) => levels.forEach(({ file }, level) => this.places.set(file, [number, level])));
    this.reserveRows(maxRows);
    this.view = { ticket: 0, camera: firstCamera(manifest) };
    this.queue = new FileQueue(new URL(".", address).href, {
      received: (file, bytes) => this.receive(file, bytes),
      failed: (file, reason) => this.reject(file, reason),
      changed: () => this.schedule(),
    });
    self.addEventListener("online", this.resume);
    this.clear();
    this.update();
  }

  // Sets the number of rows of the textures, and what a view may have of Gaussians and of rows.
  reserveRows(maxRows) {
    const { chunks, gaussians } = this, extraChunks = Math.min(chunks.length, MAX_EXTRA_CHUNKS);
    const allRows = chunks.reduce((sum, { levels }) => levels.reduce((rows, { rowCount }) => rows + rowCount, sum), 0);
    const extra = EXTRA_ROWS_PER_CHUNK * extraChunks;
    this.rowCount = Math.max(1, Math.min(allRows, maxRows, countRows(MEMORY_PER_BUDGET_RATIO * gaussians) + extra));
    this.isWhole = allRows <= this.rowCount; // whether the whole scene has room
    const budgetRows = (this.rowCount - extra) / MEMORY_PER_BUDGET_RATIO;
    // A device with small textures has a smaller budget.
    this.maxGaussians = this.isWhole ? Infinity : budgetRows * ROW_WIDTH;
    // Few chunks have no more rows than this.
    this.maxViewRows = this.isWhole || chunks.length <= MAX_EXTRA_CHUNKS ? Infinity : budgetRows + extraChunks;
  }

  // Empties the memory for Gaussians.
  clear() {
    this.number++;
    this.isShown = false;
    this.pool = new RowPool(this.rowCount);
    this.positions = new Float32Array(3 * ROW_WIDTH * this.rowCount).fill(NaN); // which are not drawn
    this.units = Array(this.rowCount).fill(1);
    this.sorter.add(this.number, new DepthSort(this.positions, ROW_WIDTH, this.units));
    for (const chunk of this.chunks) chunk.clear();
    for (const part of this.parts) part.sent = null;
  }

  // Handles a message of the page.
  handle({ look, gaussians, uploaded, faded, unusable, again, close }) {
    if (close) return this.close();
    if (look) this.view = { ticket: look.ticket, camera: cameraOf(look.view, this.scene) };
    if (gaussians) this.gaussians = gaussians;
    if (look || gaussians) this.isOutdated = true;
    if (uploaded?.number === this.number) {
      const level = this.chunks[uploaded.chunk].get(uploaded.level);
      if (level.state === UPLOADING) level.state = READY;
    }
    if (faded?.number === this.number) this.endFade(this.chunks[faded.chunk]);
    if (unusable) this.reject(this.parts[unusable.part].file, reasonOf({ message: unusable.reason }), true);
    if (again && this.scene) this.clear();
    if (look || gaussians || uploaded || faded || again) this.schedule();
  }

  // Ends all requests and updates.
  close() {
    this.isClosed = true;
    this.queue?.close();
    clearTimeout(this.timer);
    self.removeEventListener("online", this.resume);
  }

  // Updates soon. Choosing levels of many chunks takes long, so it leaves time for sorting.
  schedule() {
    if (this.isClosed) return;
    this.timer ??= setTimeout(() => this.update(), Math.max(MIN_UPDATE_INTERVAL_MS, 2 * this.updateMs));
  }

  // Chooses levels, and does what is to be done next.
  update() {
    this.timer = null;
    const began = performance.now();
    if (this.isOutdated) this.chooseLevels();
    if (this.isShown) {
      for (const chunk of this.chunks) this.swap(chunk, chunk.next(this.isShort));
      this.fetchWanted();
      this.postState();
    } else if (!this.isOpening) {
      this.fetchFirst();
    }
    this.updateMs = performance.now() - began;
  }

  // Chooses the level of each chunk that suits the view.
  chooseLevels() {
    const { manifest, chunks, isWhole, view: { camera } } = this, now = performance.now();
    const gaussians = Math.min(this.gaussians, this.maxGaussians), rows = this.maxViewRows;
    this.errors = chooseTargets(manifest, chunks, camera, { gaussians, rows, isWhole }); // at -1: left out
    for (const chunk of chunks) if (chunk.target >= 0) chunk.get(chunk.target).usedAt = now;
    this.isOutdated = false;
    this.chosenTicket = this.view.ticket;
  }

  // Fades a chunk to a level, or to none.
  swap(chunk, level) {
    if (chunk.fading || level === chunk.shown) return;
    const { number, shown } = chunk, errors = this.errors[number];
    const [from, to] = [shown, level].map((each) => chunk.get(each)?.rows ?? []);
    chunk.fading = { from: shown, to: level };
    this.show(chunk, level);
    const mse = (errors[shown] ?? 0) + errors.at(level);
    this.post({ swap: { number: this.number, chunk: number, from, to, mse } });
  }

  // Records that the fade of a chunk has ended, and hides the level from which it began.
  endFade(chunk) {
    const { from } = chunk.fading ?? { from: -1 };
    if (from >= 0) this.setPositions(chunk.get(from), null);
    chunk.fading = null;
  }

  // Adds a level to what is sorted.
  show(chunk, level) {
    chunk.shown = level;
    if (level >= 0) this.setPositions(chunk.get(level), chunk.get(level).positions);
  }

  // Sets the positions (3 N) of a level's Gaussians, or hides them if `positions` is null.
  setPositions({ rows }, positions) {
    rows.forEach((row, k) => {
      const first = 3 * ROW_WIDTH * row;
      this.positions.fill(NaN, first, first + 3 * ROW_WIDTH);
      if (positions) this.positions.set(positions.subarray(3 * ROW_WIDTH * k, 3 * ROW_WIDTH * (k + 1)), first);
    });
  }

  // ---- files

  // Fetches what the first picture needs, and sends it once it is there.
  fetchFirst() {
    const [scene] = this.parts, needed = this.chunks.filter(({ target, isKept }) => target >= 0 || isKept);
    const coarsest = needed.map((chunk) => coarsestUsable(chunk)).filter(Boolean);
    const rank = ({ chunk, level }) => this.errors[chunk.number][level.level];
    coarsest.sort((a, b) => rank(b) - rank(a));
    const counted = new Set([scene]);
    let bytes = this.request.manifest.length + scene.file.bytes;
    const first = coarsest.filter(({ chunk, level }, place) => {
      const part = this.partOf(chunk);
      bytes += level.file.bytes + (counted.has(part) ? 0 : part.file.bytes);
      counted.add(part);
      return !place || bytes <= FIRST_PICTURE_BYTES;
    });
    const missing = first.filter(({ level }) => level.state === ABSENT);
    this.want(missing);
    const read = first.length - missing.length;
    this.post({ progress: { what: "loading", part: read / Math.max(1, first.length) } });
    const hasLost = this.queue.losses > MAX_EARLY_LOSSES;
    if (scene.isRead && (!missing.length || (hasLost && read))) {
      this.postContent().catch((error) => this.fail(explainMemory(error).message));
    } else if (hasLost) this.fail(`${new URL(this.queue.folder).host} does not answer; reload the page to try again`);
  }

  // Returns the part that a chunk belongs to.
  partOf({ number }) {
    return this.parts[this.manifest.chunks[number].part];
  }

  // Fetches the files of levels {chunk, level}, those needed most first. Before the first level of a part, it fetches
  // the shared file of this part. That of the first part comes first of all, because the scene is placed by it.
  want(levels) {
    const files = new Set();
    const add = (part) => {
      if (!part.isRead) files.add(part.file);
    };
    add(this.parts[0]);
    for (const { chunk, level } of levels) {
      add(this.partOf(chunk));
      files.add(level.file);
    }
    this.queue.want([...files].filter(({ file }) => !this.early.has(file) && !this.decoding.has(file)));
  }

  // Gives up, with a sentence for the user.
  fail(sentence) {
    this.close();
    this.post({ error: sentence });
  }

  // Sends the content, with the levels that were read.
  async postContent() {
    this.isOpening = true;
    const { number, manifest, request: { name, views } } = this, [scene, ...rest] = this.parts;
    const sent = Promise.resolve(), parts = [];
    scene.sent = sent;
    const { source, packed: { model, exposure, place } } = await scene.pack();
    for (let part; (part = rest.find(({ isRead, sent }) => isRead && !sent));) { // more may be read meanwhile
      part.sent = sent;
      parts.push((await part.pack()).packed);
    }
    this.isOpening = false;
    this.isShown = true;
    const described = modelScene({ ...source, count: manifest.gaussians }, manifest.title || name);
    // Gaussians are projected from the nearest near plane of all parts on; the order omits those before their own.
    const near = described.near * Math.min(1, ...parts.map((part) => part.place.scale)), sortNear = described.near;
    this.scene = { ...described, ...views, exposure, near, sortNear, isStreamed: true };
    if (rest.length) {
      const others = rest.map(({ number: part }) => parts.find((other) => other.part === part));
      const maps = others.map((part) => ({ exposure: part?.exposure ?? null, place: part?.place ?? place }));
      Object.assign(this.scene, { exposure: null, parts: [{ exposure, place }, ...maps] });
    }
    const layout = { width: ROW_WIDTH, height: this.rowCount, count: ROW_WIDTH * this.rowCount };
    const chunks = [];
    for (const chunk of this.chunks) {
      for (const level of chunk.levels.filter(({ packed }) => packed)) {
        const { number: part } = this.partOf(chunk);
        chunks.push({ number, chunk: chunk.number, level: level.level, part, rows: level.rows, ...level.packed });
        level.packed = null;
      }
      if (chunk.next(false) >= 0) this.show(chunk, chunk.next(false));
    }
    const content = { number, whole: true, scene: this.scene, models: [{ ...model, ...layout }], parts, chunks };
    const tables = [model, ...parts.map((part) => part.model)].flatMap(listTables);
    this.post({ content }, [...tables, ...chunks.flatMap(listBuffers)]);
    this.schedule();
  }

  // Sends a part to the page, once. Returns a promise that it is sent.
  sendPart(part) {
    const send = async () => {
      const { number } = this, { packed } = await part.pack();
      this.post({ part: { number, ...packed } }, listTables(packed.model));
    };
    return (part.sent ??= send());
  }

  // Fetches the coarsest levels that are kept or begin a chunk, and those that suit the view, as far as they fit into
  // memory.
  fetchWanted() {
    const wanted = [];
    for (const chunk of this.chunks) {
      const { number, target, shown, coarsest, isKept } = chunk, errors = this.errors[number];
      const isWanted = (level) => chunk.get(level)?.state === ABSENT;
      const isFirst = isWanted(coarsest) && (isKept || (target >= 0 && shown < 0));
      if (isFirst) wanted.push({ chunk, level: chunk.get(coarsest), isFirst, rate: errors[coarsest] });
      if ((isFirst && target === coarsest) || !isWanted(target)) continue;
      const gain = errors[shown < 0 ? coarsest : shown] - errors[target], level = chunk.get(target);
      const { isRead, file } = this.partOf(chunk), bytes = level.file.bytes + (isRead ? 0 : file.bytes);
      wanted.push({ chunk, level, isFirst: false, rate: gain / bytes });
    }
    wanted.sort((a, b) => b.isFirst - a.isFirst || b.rate - a.rate);
    let room = this.spareLevels().reduce((rows, { rowCount }) => rows + rowCount, this.pool.free);
    const fitting = wanted.findIndex(({ level: { rowCount } }) => (room -= rowCount) < 0);
    let queue = MAX_UPLOADING_ROWS - this.countUploadingRows();
    const isNext = ({ level: { file, rowCount } }) => (queue -= rowCount) >= 0 || this.queue.requests.has(file.file);
    const levels = this.admitLevels(fitting < 0 ? wanted : wanted.slice(0, fitting));
    this.want(levels.filter(isNext));
    if (this.isShort !== fitting >= 0) this.schedule();
    this.isShort = fitting >= 0;
  }

  // Returns the wanted levels for whose fields there is memory. While the first level of a chunk waits for memory,
  // finer levels are left out, so that the fields in use become free.
  admitLevels(wanted) {
    const parts = this.admitParts(wanted), isAdmitted = ({ chunk }) => parts.has(this.partOf(chunk));
    const isFirstWaiting = wanted.some((each) => each.isFirst && !isAdmitted(each));
    return wanted.filter((each) => isAdmitted(each) && (each.isFirst || !isFirstWaiting));
  }

  // Returns the parts whose fields may be in memory: those in use, those of `levels`, and those of earlier ones, as far
  // as they fit. Drops the fields of others.
  admitParts(levels) {
    const [scene] = this.parts, inUse = this.partsInUse(), admitted = new Set();
    const sizeOf = ({ fieldBytes, file }) => fieldBytes ?? (file.bytes / scene.file.bytes) * scene.fieldBytes;
    const needed = levels.map(({ chunk }) => this.partOf(chunk));
    this.recentParts = [...new Set([...inUse, ...needed, ...this.recentParts.filter(({ isRead }) => isRead)])];
    let room = sizeOf(scene) + FIELD_BYTES_PER_GAUSSIAN * this.request.gaussians;
    for (const part of this.recentParts) {
      const isAdmitted = inUse.has(part) || admitted.size <= MIN_FURTHER_PARTS || sizeOf(part) <= room;
      if (isAdmitted) {
        room -= sizeOf(part);
        admitted.add(part);
      } else if (part.isRead) {
        this.dropFields(part);
      }
    }
    return admitted;
  }

  // Returns the first part and those whose fields are needed by levels that are being decoded or evaluated.
  partsInUse() {
    const { parts, chunks, decoding } = this;
    const inUse = ({ state, file }) => state === UPLOADING || decoding.has(file.file);
    const busy = chunks.filter(({ levels }) => levels.some(inUse)).map((chunk) => this.partOf(chunk));
    return new Set([parts[0], ...busy, ...parts.filter(({ file }) => decoding.has(file.file))]);
  }

  // Frees the fields of a part here and on the page.
  dropFields(part) {
    const { place, exposure } = part, dropped = { part: part.number, model: null, place, exposure };
    if (part.sent) this.post({ part: { number: this.number, ...dropped } });
    part.drop();
  }

  // Returns the number of rows that wait to be evaluated.
  countUploadingRows() {
    const waiting = this.chunks.flatMap(({ levels }) => levels.filter(({ state }) => state === UPLOADING));
    return waiting.reduce((sum, { rowCount }) => sum + rowCount, 0);
  }

  // Takes a file.
  async receive(file, bytes) {
    this.decoding.add(file.file);
    try {
      const part = this.parts.find((each) => each.file === file);
      if (part) await this.receivePart(part, bytes);
      else await this.receiveChunk(file, bytes);
    } catch (error) {
      this.reject(file, reasonOf(explainMemory(error)));
    }
    this.decoding.delete(file.file);
    this.schedule();
  }

  // Takes the shared file of a part, and the files that came before it.
  async receivePart(part, bytes) {
    const [scene] = this.parts;
    if (part !== scene && !scene.isRead) {
      this.early.set(part.file.file, [part.file, bytes]);
      return;
    }
    await part.receive(bytes, scene);
    const early = [...this.early.values()];
    this.early.clear();
    for (const [file, data] of early) this.receive(file, data);
  }

  // Takes the file of a level, and sends its Gaussians or keeps them for the content.
  async receiveChunk(file, bytes) {
    const [number, levelNumber] = this.places.get(file.file), chunk = this.chunks[number], part = this.partOf(chunk);
    if (!part.isRead) {
      if (!part.isUnusable) this.early.set(file.file, [file, bytes]);
      return;
    }
    const content = this.number, level = chunk.get(levelNumber), model = await part.readChunk(file, bytes);
    if (this.isShown) await this.sendPart(part);
    if (content !== this.number || level.state !== ABSENT) return; // meanwhile the device was lost
    const rows = this.takeRows(level.rowCount);
    if (!rows) return; // meanwhile memory has become short; it is fetched again if it still suits the view
    for (const row of rows) this.units[row] = part.place.scale;
    const packed = packGaussians(model, ROW_WIDTH);
    let { positions } = model;
    if (part.number) {
      positions = movePositions(positions, part.place);
      packed.balls = rowBalls(positions, ROW_WIDTH);
    }
    Object.assign(level, { rows, positions, state: this.isShown ? UPLOADING : READY });
    if (this.isShown) {
      const sent = { number: content, chunk: number, level: levelNumber, part: part.number, rows, ...packed };
      this.post({ chunk: sent }, listBuffers(sent));
    } else {
      level.packed = packed;
    }
  }

  // Records that a file cannot be used, or that the device cannot draw it, if `isRefused`. Otherwise levels that were
  // evaluated stay: they need no fields any more, until they are dropped.
  reject({ file }, reason, isRefused = false) {
    const part = this.parts.find((each) => each.file.file === file);
    if (part?.number === 0) return this.fail(`${file}: ${reason}`);
    this.problems.set(file, reason);
    if (part) {
      part.isUnusable = true;
      const lost = this.chunks.filter((chunk) => this.partOf(chunk) === part).flatMap(({ levels }) => levels);
      for (const level of lost) {
        if (level.state === UPLOADING) this.drop(level);
        if (level.state === READY && !isRefused) level.isFinal = true;
        else level.state = UNUSABLE;
      }
    } else {
      const [number, level] = this.places.get(file);
      this.chunks[number].get(level).state = UNUSABLE;
    }
    this.isOutdated = true;
    this.schedule();
  }

  // ---- memory

  // Returns the levels that may be dropped, those first that no view has needed for the longest time.
  spareLevels() {
    const spare = this.chunks.flatMap((chunk) => chunk.levels.filter((level) => chunk.isSpare(level)));
    return spare.sort((a, b) => a.usedAt - b.usedAt);
  }

  // Returns free rows for a level, or null if there are too few.
  takeRows(count) {
    for (const level of this.pool.free < count ? this.spareLevels() : []) {
      this.drop(level);
      if (this.pool.free >= count) break;
    }
    return this.pool.take(count);
  }

  // Frees the memory of a level that is not drawn.
  drop(level) {
    this.pool.give(level.rows);
    level.clear();
  }

  // ---- state

  // Sends what is loaded, if that has changed.
  postState() {
    const { queue, chunks, request: { manifest } } = this;
    const isWorking = chunks.some(({ fading, levels }) => fading || levels.some(({ state }) => state === UPLOADING));
    const isWaiting = this.isOutdated || this.decoding.size > 0 || (queue.wanted.length > 0 && !queue.isLost);
    const isSettled = chunks.every((chunk) => chunk.next(this.isShort) === chunk.shown);
    const state = {
      ticket: this.chosenTicket,
      isComplete: !isWorking && !isWaiting && isSettled && this.timer === null,
      gaussians: chunks.reduce((sum, chunk) => sum + (chunk.get(chunk.shown)?.file.gaussians ?? 0), 0),
      resident: chunks.reduce((sum, chunk) => sum + chunk.resident, 0),
      bytes: queue.bytes + manifest.length,
      totalBytes: manifest.length + this.fileBytes,
      psnr: this.predictPsnr(),
      problem: this.describeProblems(),
    };
    const text = JSON.stringify(state);
    if (text !== this.postedState) this.post({ state });
    this.postedState = text;
  }

  // Returns the predicted PSNR (dB) of the view against the finest levels, MAX_PSNR_DB for these.
  predictPsnr() {
    const errors = this.chunks.map(({ number, shown }) => this.errors[number].at(shown));
    const mse = errors.reduce((sum, error) => sum + error, 0);
    return Math.round(Math.min(MAX_PSNR_DB, Math.max(0, -10 * Math.log10(mse))));
  }

  // Returns a sentence for the user, "" if all is well.
  describeProblems() {
    const { queue: { isLost, folder }, problems: { size } } = this;
    if (isLost) return `The connection to ${new URL(folder).host} is lost; loading goes on when it is back.`;
    if (!size) return "";
    const [[file, reason]] = this.problems;
    const more = size > 1 ? `, nor can ${size - 1} other file${size > 2 ? "s" : ""} of the scene` : "";
    return `${file} cannot be shown: ${reason}${more}; the rest of the scene is shown.`;
  }
}

// Returns the first camera of a scene, in world units, as far as its manifest says.
const firstCamera = ({ viewpoint, cameras, frame }) =>
  viewpointOf({ provenance: { viewpoint, cameras }, config: { frame } }).cameras[0];

// Returns the coarsest level of a chunk whose file is usable, or null.
function coarsestUsable(chunk) {
  const level = chunk.levels.findLast(({ state }) => state !== UNUSABLE);
  return level ? { chunk, level } : null;
}

// Returns the message of an error as the end of a sentence.
const reasonOf = ({ message }) => message[0].toLowerCase() + message.slice(1).replace(/\.$/, "");

// Returns the buffers of the arrays of a level.
const listBuffers = (chunk) => Object.values(chunk).filter(ArrayBuffer.isView).map(({ buffer }) => buffer);

// Returns the buffers of the tables of a packed model.
const listTables = ({ geometry, radiance }) => [geometry.table.buffer, radiance.table.buffer];
