// Connects the player with the worker's SceneStream, which reads a scene folder as views need it.
//
// Events of the player, beside its own:
//     "streamed"   detail: {isComplete, gaussians, resident, bytes, totalBytes, psnr, problem} of the view: whether all
//                  levels that suit it are drawn, the numbers of Gaussians drawn and in memory, the bytes received and
//                  those of the scene, the predicted PSNR in dB, and a sentence, "" for none
//     "problem"    detail: that sentence, when it has changed

import { MAX_MANIFEST_BYTES } from "../../hyrf/manifest.js";
import { Loader } from "../loader.js";
import { decodeName } from "../source.js";
import { StreamedFields } from "./streamed_fields.js";

export const DEFAULT_GAUSSIANS = 2_000_000;
export const DEFAULT_PHONE_GAUSSIANS = 500_000;
const MIN_ADAPTED_GAUSSIANS = 100_000; // slow frames lower the budget no further
const PHONE_QUERY = "(pointer: coarse) and (max-width: 600px), (pointer: coarse) and (max-height: 600px)";
const MANIFEST_NAME = "scene.json";
const MIN_LOOK_INTERVAL_MS = 150; // between two choices of levels while the view moves
// The least predicted PSNR in dB that each word describes.
const DETAIL_WORDS_BY_PSNR_DB = [[40, "full"], [34, "high"], [28, "medium"], [0, "low"]];
const MIN_ADAPTATION_INTERVAL_MS = 1000; // between two changes of the budget
// The budget falls where frames are slow at this part of the resolution, and rises where they are quick at full one.
const LOW_RESOLUTION_RATIO = 0.5, SLOW_FRAME_MS = 43, QUICK_FRAME_MS = 20;
const BUDGET_DECREASE_RATIO = 0.8, BUDGET_INCREASE_RATIO = 1.25;

// Returns whether an address is that of a scene's manifest.
const isManifest = (address) => new URL(address).pathname.endsWith(".json");

class StreamLoader extends Loader {
  // `player` shows the scene.
  constructor({ player, ...options }) {
    super(options);
    this.player = player;
    this.fields = null; // the StreamedFields that are drawn
    this.state = null; // from the worker
    this.lastLook = { key: "", ticket: 0, at: 0 };
    this.most = player.maxGaussians ?? (matchMedia(PHONE_QUERY).matches ? DEFAULT_PHONE_GAUSSIANS : DEFAULT_GAUSSIANS);
    this.gaussians = this.most; // the present budget
    this.adaptedAt = 0;
    this.onFrame = ({ detail }) => this.adapt(detail);
    player.addEventListener("frame", this.onFrame);
  }

  // Opens the scene whose manifest `stream` yields.
  async read({ name, address, views, stream }) {
    const shown = this.expect();
    const manifest = await Promise.race([this.gather(stream), shown]); // `shown` fails if the loader is disposed of
    const { gaussians } = this, maxRows = this.player.renderer.largest[1];
    const [folder] = new URL(address).pathname.split("/").slice(-2).map(decodeName);
    const ownName = name === MANIFEST_NAME && folder ? folder : name;
    this.post({ stream: { manifest, address, name: ownName, views, gaussians, maxRows } });
    return shown;
  }

  // Returns all bytes of a stream, of which a manifest may have few.
  async gather(stream) {
    const parts = [];
    let length = 0;
    for await (const bytes of stream) {
      if (this.broken) break; // ends the download
      length += bytes.length;
      if (length > MAX_MANIFEST_BYTES) throw new Error("The manifest is too long");
      parts.push(bytes);
    }
    return new Uint8Array(await new Blob(parts).arrayBuffer());
  }

  // Sends a message to the worker.
  post(message) {
    this.connection.post(message);
  }

  receive(message) {
    super.receive(message);
    const { part, chunk, swap, state } = message;
    // A content is installed before its parts and levels are handled.
    if (part) this.delivered.then(() => this.addPart(part));
    if (chunk || swap) this.delivered.then(() => this.updateLevels(chunk, swap));
    if (state) this.delivered.then(() => this.setState(state));
  }

  // Handles a part whose fields have arrived or are dropped.
  addPart(part) {
    if (part.number !== this.current) return; // of a content that was lost with the device
    const { player } = this, { scene } = player, { exposure, place } = part;
    scene.parts[part.part] = { exposure, place };
    scene.near = Math.min(scene.near, place.scale * scene.sortNear);
    this.fields.addPart(part);
    player.emit("exposure"); // its map may be the first one of the scene
  }

  // Handles a level that has arrived, or one that is to be drawn instead of another one.
  updateLevels(chunk, swap) {
    if ((chunk ?? swap).number !== this.current) return; // of a content that was lost with the device
    if (chunk) this.fields.arrive(chunk).catch(() => {}); // the device was lost
    if (!swap) return;
    this.fields.swap(swap);
    this.redraw();
  }

  // Handles what the worker says about the scene.
  setState(state) {
    if (this.player.loader !== this) return; // meanwhile another scene is shown
    const before = this.state;
    this.state = state;
    if (state.problem !== (before?.problem ?? "")) {
      this.remark = state.problem;
      this.player.emit("remark", state.problem);
      this.player.emit("problem", state.problem);
    }
    this.player.emit("streamed", state);
  }

  makeContent(gl, { models: [model], parts, chunks }) {
    this.fields = new StreamedFields(gl, model, parts, chunks, this);
    return this.fields;
  }

  sorted(answer) {
    super.sorted(answer);
    if (answer.number === this.current) this.fields.receiveOrder();
  }

  // Sends the content again. Harmonics cannot be fitted to a scene that is loaded in parts.
  again(plain) {
    if (plain) this.fail(new Error(`${this.remark.split(": ")[1]} Open the scene as one file`));
    else this.post({ again: true });
  }

  async ask() {
    throw new Error("A scene folder cannot be edited; edit the file that hyrfpack decompress joins.");
  }

  // ---- for StreamedFields

  // Chooses levels for a view. Returns the number of the choice.
  look(view, isMoving) {
    const { lastLook } = this, { rows, eye, width, height, fx, fy, cx, cy } = view, now = performance.now();
    const key = [rows, eye, width, height, fx, fy, cx, cy].join();
    if (key === lastLook.key || (isMoving && now < lastLook.at + MIN_LOOK_INTERVAL_MS)) return lastLook.ticket;
    this.lastLook = { key, ticket: lastLook.ticket + 1, at: now };
    this.post({ look: { ticket: this.lastLook.ticket, view } });
    return this.lastLook.ticket;
  }

  // Returns whether the worker has sent all that suits the last view, if `ticket` is that of it.
  isComplete(ticket) {
    return Boolean(this.state?.isComplete) && this.state.ticket === ticket;
  }

  // Draws another order of Gaussians.
  redraw() {
    this.player.unsorted = true;
    this.player.redraw();
  }

  // Adapts the budget to the ms that a frame of a moving view takes.
  adapt(ms) {
    const { player: { automatic, coarse, scene }, most } = this, now = performance.now();
    if (!automatic || !this.fields || now < this.adaptedAt + MIN_ADAPTATION_INTERVAL_MS) return;
    const isSlow = coarse <= LOW_RESOLUTION_RATIO && ms > SLOW_FRAME_MS, isQuick = coarse === 1 && ms < QUICK_FRAME_MS;
    const ratio = isSlow ? BUDGET_DECREASE_RATIO : isQuick ? BUDGET_INCREASE_RATIO : 1;
    const present = Math.min(this.gaussians, scene.count);
    const gaussians = Math.min(most, Math.max(Math.min(MIN_ADAPTED_GAUSSIANS, most), Math.round(ratio * present)));
    if (ratio === 1 || gaussians === this.gaussians) return;
    Object.assign(this, { gaussians, adaptedAt: now });
    this.post({ gaussians });
  }

  dispose() {
    this.player.removeEventListener("frame", this.onFrame);
    super.dispose();
  }
}

// What the player needs to open scene folders.
export const STREAMING = { StreamLoader, isManifest, describeLoaded };

// Returns two texts for people on a scene of `count` Gaussians: how many are drawn, and what is loaded of its bytes and
// its detail.
function describeLoaded({ gaussians, bytes, totalBytes, psnr }, count) {
  const megabytes = [bytes, totalBytes].map((size) => (size / 1e6).toFixed(1));
  const [, detail] = DETAIL_WORDS_BY_PSNR_DB.find(([minPsnr]) => psnr >= minPsnr);
  const drawn = `${gaussians.toLocaleString("en")} of ${count.toLocaleString("en")} Gaussians`;
  return [drawn, `${megabytes.join(" of ")} MB loaded, ${detail} detail here`];
}
