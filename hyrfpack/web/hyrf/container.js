// The container (docs/format.md, part 1): named sections behind a table of contents, all of it checked.

import { crc32 } from "./crc.js";
import { HyrfFormatError, damagedFile, groupedDigits, newerFile, quotedText } from "./errors.js";

/**
 * A line of the table of contents; `end` is where the section ends, padding included.
 * @typedef {{
 *   type: string, codec: number, offset: number, stored: number, raw: number, checksum: number, end: number,
 * }} Entry
 */

export const MAGIC_BYTES = [0x89, 0x48, 0x59, 0x52, 0x46, 0x0d, 0x0a, 0x0a];
const MAJOR_VERSION = 1;
export const HEADER_BYTES = 48;
export const ENTRY_BYTES = 40;
export const MOST_SECTIONS = 1024;
const MOST_BYTES = 2 ** 34; // of a file, and of what it decodes to
// Decoded bytes that a file may promise: so many for each of its own, and some that are free.
const EXPANSION = 1024;
const FREE_BYTES = 3 * 2 ** 24;

const MOST_LAYERS = 8;
export const LAYERED_TYPES = ["POSI", "COLO", "SCAL", "OPAC"];
export const FIELD_TYPES = ["GTAB", "GMLP", "RTAB", "RMLP"];
export const EXPOSURE_TYPE = "EXPO"; // optional

/**
 * What a section of a layer is called: "POSI", then "POS1", "POS2", ...
 * @param {string} type of the first layer
 * @param {number} layer
 */
export const layerType = (type, layer) => (layer ? type.slice(0, 3) + layer : type);

const KNOWN_TYPES = new Set(["META", EXPOSURE_TYPE, ...FIELD_TYPES]);
for (let layer = 0; layer < MOST_LAYERS; layer++) {
  for (const type of LAYERED_TYPES) KNOWN_TYPES.add(layerType(type, layer));
}

/** @param {number} length */
const paddedLength = (length) => Math.ceil(length / 8) * 8;

/** A file whose header and table of contents have been checked. */
export class Container {
  /**
   * @param {Uint8Array} bytes of the file, or its start
   * @param {boolean} partial whether the start will do
   */
  constructor(bytes, partial) {
    this.bytes = bytes;
    /** @type {[number, number]} */
    this.version = [MAJOR_VERSION, 0];
    /** Bytes of the whole file, as its header says. */
    this.length = 0;
    /** @type {Map<string, Entry>} */
    this.entries = new Map();
    this.checkEntries(this.checkHeader(partial));
  }

  /**
   * Whether a section is there whole.
   * @param {string} type
   */
  has(type) {
    const entry = this.entries.get(type);
    return entry !== undefined && entry.end <= this.bytes.length;
  }

  /**
   * The stored bytes of a section, which is there, checked.
   * @param {string} type
   */
  stored(type) {
    const entry = /** @type {Entry} */ (this.entries.get(type));
    const stored = this.bytes.subarray(entry.offset, entry.offset + entry.stored);
    if (crc32(stored) !== entry.checksum) damagedFile(`the checksum of section '${type}' does not match its bytes`);
    const padding = this.bytes.subarray(entry.offset + entry.stored, entry.end);
    if (padding.some((byte) => byte !== 0)) damagedFile(`the padding after section '${type}' is not zero`);
    return stored;
  }

  /**
   * Steps 1 to 3 of 1.3.
   * @param {boolean} partial
   * @returns {DataView} the table of contents
   */
  checkHeader(partial) {
    const { bytes } = this;
    const there = bytes.length;
    if (there === 0) damagedFile("it is empty");
    if (MAGIC_BYTES.some((byte, i) => i < there && bytes[i] !== byte)) {
      throw new HyrfFormatError("This is not a .hyrf file; check the address or the path.");
    }
    const view = new DataView(bytes.buffer, bytes.byteOffset, there);
    // The version comes first: another major version may lay out everything after it anew.
    if (there >= 12) {
      this.version = [view.getUint16(8, true), view.getUint16(10, true)];
      if (this.version[0] !== MAJOR_VERSION) {
        newerFile(`it has format version ${this.version.join(".")} and this reader knows version ${MAJOR_VERSION}`);
      }
    }
    if (there < HEADER_BYTES) damagedFile(`it ends after ${there} bytes, within its header`);
    if (crc32(bytes.subarray(0, 44)) !== view.getUint32(44, true)) {
      damagedFile("the checksum of the header does not match its bytes");
    }
    const flags = view.getUint32(12, true);
    if (flags) newerFile(`its header sets the flags 0x${flags.toString(16)}`);
    this.length = readUint64(view, 16);
    const says = `its header says ${groupedDigits(this.length)} bytes and there are ${groupedDigits(there)}`;
    if (this.length > there && !partial) {
      throw new HyrfFormatError(`The file is truncated: ${says}; fetch it again.`);
    }
    if (this.length < there) damagedFile(says);
    if (this.length > MOST_BYTES) damagedFile(`its header says ${groupedDigits(this.length)} bytes, too many`);
    const count = view.getUint32(36, true);
    if (count > MOST_SECTIONS) damagedFile(`its header says ${groupedDigits(count)} sections, too many`);
    const length = view.getUint32(32, true);
    const end = HEADER_BYTES + length;
    if (readUint64(view, 24) !== HEADER_BYTES || length !== count * ENTRY_BYTES || end > this.length) {
      damagedFile("its header misplaces the table of contents");
    }
    if (end > there) damagedFile(`it ends after ${there} bytes, within its table of contents`);
    const table = bytes.subarray(HEADER_BYTES, end);
    if (crc32(table) !== view.getUint32(40, true)) {
      damagedFile("the checksum of the table of contents does not match its bytes");
    }
    return new DataView(table.buffer, table.byteOffset, length);
  }

  /**
   * Steps 4 to 6 of 1.3.
   * @param {DataView} table
   */
  checkEntries(table) {
    let end = HEADER_BYTES + table.byteLength, promised = 0;
    for (let at = 0; at < table.byteLength; at += ENTRY_BYTES) {
      const letters = [0, 1, 2, 3].map((i) => String.fromCharCode(table.getUint8(at + i)));
      const type = letters.join("");
      if (!/^[A-Za-z0-9_]{4}$/.test(type)) damagedFile(`a section has the malformed type ${quotedText(type)}`);
      if (this.entries.has(type)) damagedFile(`section '${type}' occurs twice`);
      const flags = table.getUint16(at + 6, true);
      if (flags & 1 && !KNOWN_TYPES.has(type)) newerFile(`it requires section '${type}', which is unknown`);
      if (flags > 1 || table.getUint32(at + 36, true)) damagedFile(`section '${type}' sets reserved bits`);
      const offset = readUint64(table, at + 8), stored = readUint64(table, at + 16), raw = readUint64(table, at + 24);
      if (offset !== end) damagedFile(`section '${type}' does not start where the one before it ends`);
      if (stored > this.length - offset) damagedFile(`section '${type}' does not fit into the file`);
      end = offset + paddedLength(stored);
      const codec = table.getUint16(at + 4, true), checksum = table.getUint32(at + 32, true);
      this.entries.set(type, { type, codec, offset, stored, raw, checksum, end });
      // What is not there can be promised without paying for it: it does not count.
      if (end <= this.bytes.length) promised += raw;
    }
    if (end !== this.length) damagedFile("its sections end elsewhere than the file");
    const limit = Math.min(EXPANSION * this.bytes.length + FREE_BYTES, MOST_BYTES);
    if (promised > limit) damagedFile(`its sections say they decode to ${groupedDigits(promised)} bytes, too many`);
  }
}

/**
 * Say that too little of a file is there.
 * @param {Container} container
 * @param {number} needed bytes of it
 * @returns {never}
 */
export const incompleteFile = (container, needed) => {
  const [least, all, there] = [needed, container.length, container.bytes.length].map(groupedDigits);
  throw new HyrfFormatError(`The first ${least} of ${all} bytes make a model and ${there} are there; fetch more.`);
};

/**
 * A u64; beyond 2^53 the nearest number, which is far above every limit.
 * @param {DataView} view
 * @param {number} at
 */
export const readUint64 = (view, at) => view.getUint32(at + 4, true) * 2 ** 32 + view.getUint32(at, true);
