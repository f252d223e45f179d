// Reads a file and sorts its splats by depth, in a worker, so that the page's own thread stays responsive.
//
// Every message has the number of the `reader` that it is for, or from.
//
// Messages to the worker:
//     {start: {name, scene, views, plain}}   a file follows; `scene` or `views` (cameras, up, target) if the page has
//                                            them; `plain`: decode it as splats
//     {bytes}                                the next piece of the file
//     {end} or {broken}                      the file is complete, or no more of it can be read
//     {again: {plain}}                       decode the same bytes again
//     {use: number}                          select the content to sort
//     {sort: {ticket, row, sides, near, order}}
//     {ask: {ticket, select}}                draw only the Gaussians that these selections keep, see selection.js
//     {ask: {ticket, decode}}                return the file: its bytes or, if `decode`, {model, kept}
//     {close}                                the reader is no longer needed
// and those of stream/scene_stream.js.
// Messages from the worker:
//     {progress: {what, part}}
//     {content: {number, repeats, whole, scene, models | splats, picture}}   see pack.js; `repeats` is the number of
//                                            messages `again` before it
//     {order: {ticket, number, order, drawn}}
//     {answer: {ticket, value | error}}      to `ask`: the numbers that are left after each selection, or the file
//     {error}                                the reason, as soon as it is certain that the file cannot be read
//     {failure}                              the reason why another message could not be handled

import { explainMemory } from "../hyrf/errors.js";
import { fitHarmonics } from "../hyrf/harmonics.js";
import { readFile, readFileParts } from "../hyrf/reader.js";
import { toLocalView, viewpointOf } from "../hyrf/viewpoint.js";
import { TEXTURE_WIDTH } from "./constants.js";
import { rejectOtherFiles } from "./other_files.js";
import { joinPositions, packModel, packSplats } from "./pack.js";
import { movePositions, placeOf } from "../hyrf/places.js";
import { ReceivedFile } from "./received_file.js";
import { BACKGROUND_HEIGHT_PIXELS, backgroundPicture, modelScene, splatsScene } from "./scene.js";
import { measureGaussians, selectGaussians } from "./selection.js";
import { DepthSort } from "../hyrf/sort.js";

const FIRST_LAYER_DELAY_MS = 150; // if the rest of the file arrives in this time, the first layer is not shown alone
const HARMONICS_DEGREE = 3;

// Starts to handle messages. `readSplats(name, bytes)` decodes files of splats, like decodeSplats in formats/index.js.
// `Stream` reads scene folders, like SceneStream in stream/scene_stream.js; null where no page asks for one.
export function startWorker(readSplats, Stream = null) {
  const services = new Map(); // number of a reader -> its Service
  onmessage = ({ data: { reader, ...message } }) => {
    if (!services.has(reader)) {
      const post = (answer, buffers) => postMessage({ reader, ...answer }, buffers);
      services.set(reader, new Service(readSplats, Stream, post));
    }
    const service = services.get(reader);
    if (message.close) services.delete(reader);
    try {
      service.handle(message);
    } catch (error) { // other readers go on
      service.post({ failure: explainMemory(error).message });
    }
  };
}

// Reads files and sorts their splats for one player. `post(message, buffers)` sends a message to it.
class Service {
  constructor(readSplats, Stream, post) {
    Object.assign(this, { readSplats, Stream });
    this.isClosed = false;
    this.post = (message, buffers) => {
      if (!this.isClosed) post(message, buffers);
    };
    this.sorter = new ContentSorter(this.post);
    this.reader = null;
    this.stream = null;
  }

  handle(message) {
    if (message.start) this.reader = new SceneReader(message.start, this.readSplats, this.sorter, this.post);
    if (message.bytes) this.reader.receive(message.bytes);
    if (message.end) this.reader.end();
    if (message.broken) this.reader.interrupt();
    if (message.again) this.reader?.decodeAgain(message.again.plain);
    if (message.use !== undefined) this.sorter.use(message.use);
    if (message.sort) this.sorter.sort(message.sort);
    if (message.ask) this.answer(message.ask);
    if (message.stream) this.stream = new this.Stream(message.stream, this.sorter, this.post);
    else this.stream?.handle(message);
    if (message.close) this.isClosed = true;
  }

  async answer({ ticket, select, decode }) {
    try {
      const bytes = this.reader.file.gather(), { kept } = this.sorter;
      const value = select ? await this.select(select) : decode ? { model: await readFile(bytes), kept } : bytes;
      this.post({ answer: { ticket, value } });
    } catch (error) {
      this.post({ answer: { ticket, error: explainMemory(error).message } });
    }
  }

  // Hides the Gaussians that selections remove. Returns the numbers that are left after each.
  async select(selections) {
    const { reader, sorter } = this, needsMeasures = selections.some(({ rows }) => !rows);
    if (needsMeasures) reader.measures ??= await measureGaussians(reader.file.gather());
    const { kept, counts } = selectGaussians(selections, sorter.positions, reader.measures);
    sorter.kept = kept;
    return counts;
  }
}

// Reads one file and posts its contents: the first layer alone if the rest takes long, and the whole.
class SceneReader {
  // `request` is that of the message `start`.
  constructor(request, readSplats, sorter, post) {
    Object.assign(this, { request, readSplats, sorter, post });
    this.file = new ReceivedFile(!request.plain);
    this.ended = false;
    this.broken = false; // whether a part of the file is missing or damaged
    this.isRejected = false; // whether the whole file is useless
    this.decodedLength = 0; // the number of bytes in the last decoding
    this.contents = 0; // the number of the last content
    this.repeats = 0; // of `decodeAgain`
    this.queue = Promise.resolve();
  }

  reportProgress(what, part) {
    this.post({ progress: { what, part } });
  }

  // Stores a piece of the file, and starts to decode the first layer when it is complete.
  receive(bytes) {
    if (this.isRejected) return;
    try {
      if (this.file.add(bytes)) setTimeout(() => this.queueDecoding(true), FIRST_LAYER_DELAY_MS);
    } catch (error) {
      this.isRejected = true;
      this.post({ error: explainMemory(error).message });
    }
  }

  // Decodes the complete file.
  end() {
    this.ended = true;
    this.queueDecoding(false);
  }

  // Records that no more of the file can be read.
  interrupt() {
    this.broken = this.ended = true;
  }

  // Decodes the file again, as splats if `plain`. Of a file that is still arriving, it decodes what has arrived, if
  // that was enough for a first layer.
  decodeAgain(plain) {
    this.repeats++;
    this.request.plain ||= plain;
    if (this.ended || this.contents) this.queueDecoding(this.broken || !this.ended);
  }

  // Decodes the bytes so far, after any earlier decoding has ended. `partial` is true if the file is not complete.
  queueDecoding(partial) {
    if (this.isRejected) return;
    this.queue = this.queue
      .then(() => (partial && this.ended && !this.broken ? null : this.decode(partial)))
      .catch((error) => {
        this.broken = true; // `decodeAgain` then decodes only bytes that could be decoded before
        this.post({ error: explainMemory(error).message });
      });
  }

  // Decodes the file and posts its content.
  async decode(partial) {
    const { file, request: { name, scene, views, plain } } = this, all = file.gather();
    const bytes = partial && this.broken ? all.subarray(0, this.decodedLength || file.length) : all;
    const content = { number: ++this.contents, repeats: this.repeats, whole: !partial };
    this.reportProgress("unpacking", 0);
    let positions;
    if (file.isMerged) {
      positions = this.decodeMerged(await readFileParts(bytes), content);
    } else if (file.isModel) {
      const model = await readFile(bytes, { partial });
      content.scene = { ...(scene ?? { ...modelScene(model, name), ...views }), exposure: model.exposure };
      positions = model.positions;
      if (plain) {
        this.reportProgress("unpacking", 1);
        const report = ({ done }) => this.reportProgress("preparing", done);
        const { fitted } = viewpointOf(model.metadata);
        content.splats = packSplats(await fitHarmonics(model, fitted, HARMONICS_DEGREE, report));
        content.picture = backgroundPicture(model, BACKGROUND_HEIGHT_PIXELS);
      } else {
        content.models = [packModel(model, firstEye(content.scene, model))];
      }
    } else {
      rejectOtherFiles(bytes);
      const splats = await this.readSplats(name, bytes);
      if (scene) convertToScene(splats, scene);
      content.scene = scene ?? { ...splatsScene(splats, name), ...views };
      positions = splats.positions;
      content.splats = packSplats(splats);
    }
    this.sorter.add(content.number, new DepthSort(positions, TEXTURE_WIDTH));
    this.decodedLength = bytes.length;
    this.reportProgress("unpacking", 1);
    this.post({ content }, listBuffers(content));
  }

  // Packs the parts of a merged file for a content. Returns the positions of all their Gaussians.
  decodeMerged(parts, content) {
    const { name, scene, views } = this.request, frame = parts[0].model.config.frame;
    const placed = parts.map(({ model }) => ({ model, place: placeOf(model.config.frame, frame) }));
    const count = parts.reduce((sum, { model }) => sum + model.count, 0);
    const own = scene ?? { ...modelScene(parts[0].model, name), ...views };
    const described = placed.map(({ model: { exposure }, place }) => ({ exposure, place }));
    const sortNear = own.near * Math.min(...placed.map(({ place }) => place.scale)); // the nearest one of all parts
    content.scene = { ...own, count, sortNear, exposure: null, parts: described };
    content.models = placed.map(({ model, place }, number) => {
      const packed = packModel(model, firstEye(content.scene, model));
      return { ...packed, place, background: number === 0 && packed.background };
    });
    return joinPositions(placed.map(({ model, place }) => movePositions(model.positions, place)));
  }
}

// Returns the eye of a scene's first camera in the local units of a model.
const firstEye = ({ cameras }, { config }) => toLocalView(cameras[0], config.frame).eye;

// Returns the buffers of all arrays of a content, which are transferred with its message.
function listBuffers({ splats, models = [], picture }) {
  const partsOf = (model) => [model, model.geometry, model.radiance, model.estimate, model.coarseBackground];
  const parts = [splats, ...models.flatMap(partsOf), picture];
  const values = parts.flatMap((part) => Object.values(part ?? {}));
  return [...new Set(values.filter(ArrayBuffer.isView).map(({ buffer }) => buffer))];
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

// Sorts the splats of the content that the page shows.
class ContentSorter {
  constructor(post) {
    this.post = post;
    this.sorters = new Map(); // number of a content -> its DepthSort
    this.selected = null;
    this.kept = null; // a byte for each Gaussian of the whole file, 0 if it is hidden; null to show all
  }

  // Returns the positions of the Gaussians of the selected content.
  get positions() {
    return this.sorters.get(this.selected).positions;
  }

  // Adds the DepthSort of a content by its number.
  add(number, sorter) {
    this.sorters.set(number, sorter);
  }

  // Selects the content to sort, and drops older ones.
  use(number) {
    this.selected = number;
    for (const other of this.sorters.keys()) if (other < number) this.sorters.delete(other);
  }

  // Posts the order of the splats for a request.
  sort({ ticket, row, sides, near, order: spare }) {
    const sorter = this.sorters.get(this.selected), kept = this.kept?.length === sorter.count ? this.kept : null;
    const { order, drawn } = sorter.sort(row, sides, near, spare, kept);
    this.post({ order: { ticket, number: this.selected, order, drawn } }, [order.buffer]);
  }
}
