// One part of a streamed scene, in the worker: its shared file, and where it lies in the scene.

import { HyrfFormatError } from "../../hyrf/errors.js";
import { readFile } from "../../hyrf/reader.js";
import { IDENTITY_PLACE, placeOf } from "../../hyrf/places.js";
import { packFields } from "../pack.js";

export class ScenePart {
  // `file` is the entry of its shared file in the manifest.
  constructor(number, file) {
    Object.assign(this, { number, file });
    this.bytes = null; // of the shared file
    this.source = null; // what it holds, until it is sent
    this.config = null; // of the model
    this.exposure = null; // of the model
    this.fieldBytes = null; // of the tables of its fields in memory, once it was read
    this.place = IDENTITY_PLACE; // from its units to those of the first part
    this.isUnusable = false;
    this.sent = null; // the promise that it is sent to the page
  }

  get isRead() {
    return this.bytes !== null;
  }

  // Takes the bytes of its shared file. `scene` is the first part.
  async receive(bytes, scene) {
    const model = await readFile(bytes);
    if (model.count) throw new HyrfFormatError("it holds Gaussians, and should hold only what chunks share");
    if (this !== scene) {
      if (model.config.antialiased !== scene.config.antialiased) {
        throw new HyrfFormatError(`${scene.file.file} is antialiased and this file is not, or the other way round`);
      }
      this.place = placeOf(model.config.frame, scene.config.frame);
    }
    this.fieldBytes = model.geometry.table.byteLength + model.radiance.table.byteLength;
    Object.assign(this, { config: model.config, exposure: model.exposure, source: model, bytes });
  }

  // Frees the memory of its fields. Their file is fetched again if another level needs them.
  drop() {
    this.bytes = this.source = this.sent = null;
  }

  // Reads a chunk of the part. `file` is its entry in the manifest.
  async readChunk(file, bytes) {
    const model = await readFile(bytes, { openFile: (name) => this.openFile(name) });
    if (model.count !== file.gaussians) {
      throw new HyrfFormatError(`it has ${model.count} Gaussians, and the manifest says ${file.gaussians}`);
    }
    if (canonicalText(model.config) !== canonicalText(this.config)) {
      throw new HyrfFormatError(`its configuration is not that of ${this.file.file}`);
    }
    return model;
  }

  // Returns the bytes of the file that a chunk refers to.
  openFile(name) {
    if (name === this.file.file) return this.bytes;
    throw new HyrfFormatError(`it refers to ${name}, and the manifest says ${this.file.file}`);
  }

  // Returns what the page needs of the part, and its `source`, which is not sent.
  async pack() {
    const { number, place, exposure } = this, source = this.source ?? (await readFile(this.bytes));
    const model = packFields(source);
    this.source = null; // its tables are transferred
    return { source, packed: { part: number, model, place, exposure } };
  }
}

// Returns a text that is the same for the same JSON value.
const canonicalText = (value) =>
  JSON.stringify(value, (_, inner) => {
    const isObject = typeof inner === "object" && inner !== null && !Array.isArray(inner);
    return isObject ? Object.fromEntries(Object.entries(inner).sort()) : inner;
  });
