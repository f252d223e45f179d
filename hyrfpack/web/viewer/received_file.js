// Collects the bytes of a file while they arrive, and identifies its format from the first of them.

import { ENTRY_BYTES, HEADER_BYTES, MAGIC_BYTES, MAX_SECTIONS, PART_NAMES_TYPE } from "../hyrf/container.js";
import { describeFile } from "../hyrf/reader.js";

const MAX_FIRST_LAYER_RATIO = 0.8; // a first layer that is a larger part of its file is not decoded alone
const MAX_UNSIZED_FILE_BYTES = 2 ** 32; // the limit for formats whose header does not give the file's length
const SECTION_COUNT_OFFSET = 36; // in bytes
// The magic bytes without the line ends, which a transfer may damage; the reader has a better message for that.
const MODEL_SIGNATURE = MAGIC_BYTES.slice(0, 5);

export class ReceivedFile {
  // `layered`: whether the first layer of a model may be decoded alone.
  constructor(layered) {
    this.layered = layered;
    this.pieces = [];
    this.length = 0; // in bytes, like the other lengths
    this.maxLength = Infinity;
    this.firstLayerLength = Infinity; // finite once a model is known to have a first layer that may be decoded alone
    this.firstBytes = new Uint8Array(HEADER_BYTES + ENTRY_BYTES * MAX_SECTIONS); // null once the format is known
    this.isOtherFormat = false;
    this.isMerged = false; // whether it is a file of several models
  }

  // Whether the bytes so far are of a model, as far as they show.
  get isModel() {
    return !this.isOtherFormat && this.length >= MODEL_SIGNATURE.length;
  }

  // Adds the next bytes, and returns whether they complete the first layer. Throws an error, and drops all bytes, as
  // soon as it is certain that the file cannot be read.
  add(bytes) {
    const before = this.length;
    this.pieces.push(bytes);
    this.length += bytes.length;
    try {
      if (this.firstBytes) this.identify(bytes, before);
      if (this.length > this.maxLength) this.rejectLength();
    } catch (error) {
      this.pieces = [];
      throw error;
    }
    return before < this.firstLayerLength && this.length >= this.firstLayerLength;
  }

  // Returns all bytes so far as one array.
  gather() {
    if (this.pieces.length !== 1) {
      const all = new Uint8Array(this.length);
      this.pieces.reduce((at, piece) => (all.set(piece, at), at + piece.length), 0);
      this.pieces = [all];
    }
    return this.pieces[0];
  }

  // Identifies the format from the first bytes, if enough of them are here. Throws an error if a model's header is
  // invalid.
  identify(bytes, before) {
    const { firstBytes, length } = this;
    if (before < firstBytes.length) firstBytes.set(bytes.subarray(0, firstBytes.length - before), before);
    const available = firstBytes.subarray(0, length);
    if (!MODEL_SIGNATURE.every((byte, k) => k >= length || available[k] === byte)) {
      this.isOtherFormat = true;
      this.maxLength = MAX_UNSIZED_FILE_BYTES;
      this.firstBytes = null;
      return;
    }
    if (length < HEADER_BYTES) return;
    const sections = new DataView(firstBytes.buffer).getUint32(SECTION_COUNT_OFFSET, true);
    if (sections <= MAX_SECTIONS && length < HEADER_BYTES + ENTRY_BYTES * sections) return;
    const description = describeFile(available);
    this.maxLength = description.length;
    this.isMerged = description.sections.some(({ type }) => type === PART_NAMES_TYPE);
    if (this.layered && description.firstLayer < MAX_FIRST_LAYER_RATIO * description.length) {
      this.firstLayerLength = description.firstLayer;
    }
    this.firstBytes = null;
  }

  // Throws the error for a file that is too long.
  rejectLength() {
    if (!this.isOtherFormat) describeFile(this.gather()); // throws an error about the length
    throw new Error("It is larger than 4 GiB; open a smaller one.");
  }
}
