// The container of a `.hyrf` file (docs/reference/format.md, part 1): a header, a table of contents and named sections.

import { crc32 } from "./crc.js";
import { HyrfFormatError, groupedDigits, quotedText, rejectDamaged, rejectNewer } from "./errors.js";

/**
 * An entry of the table of contents. `stored` and `raw` are the section's lengths in the file and after decoding, in
 * bytes; `offset` and `end` are where its bytes start and where its padding ends; `checksum` is the CRC-32.
 * @typedef {{
 *   type: string, codec: number, offset: number, stored: number, raw: number, checksum: number, end: number,
 * }} Entry
 */

export const MAGIC_BYTES = [0x89, 0x48, 0x59, 0x52, 0x46, 0x0d, 0x0a, 0x0a];
const MAJOR_VERSION = 1;
export const HEADER_BYTES = 48;
export const ENTRY_BYTES = 40;
export const MAX_SECTIONS = 1024;
/** The maximum length of a file, and of all its sections after decoding. */
export const MAX_FILE_BYTES = 2 ** 34;
// A file of n bytes may declare at most MAX_RAW_BYTES_PER_BYTE n + BASE_RAW_BYTES decoded bytes, so that a small file
// cannot claim large memory.
const MAX_RAW_BYTES_PER_BYTE = 1024;
const BASE_RAW_BYTES = 3 * 2 ** 24;

/**
 * Returns the largest number of bytes that all sections of a file of `length` bytes may decode to.
 * @param {number} length
 */
export const rawBytesLimit = (length) => Math.min(MAX_RAW_BYTES_PER_BYTE * length + BASE_RAW_BYTES, MAX_FILE_BYTES);

/** The maximum number of layers of Gaussians in a file. */
export const MAX_LAYERS = 8;
export const LAYERED_TYPES = ["POSI", "COLO", "SCAL", "OPAC"];
export const FIELD_TYPES = ["GTAB", "GMLP", "RTAB", "RMLP"];
/** The types of residuals, which a model of residuals has in each layer. */
export const RESIDUAL_TYPES = ["SHAP", "HARM"];
/** The type of the exposure map, which is optional. */
export const EXPOSURE_TYPE = "EXPO";

/**
 * Returns the type of a layer's section: "POSI" for the first layer, then "POS1", "POS2", ...
 * @param {string} type the type in the first layer
 * @param {number} layer counted from 0
 */
export const layerType = (type, layer) => (layer ? type.slice(0, 3) + layer : type);

/** The maximum number of parts of a merged file. */
export const MAX_PARTS = 64;
/** The type of the names of the parts, which only merged files have. */
export const PART_NAMES_TYPE = "PRTS";

/**
 * Returns the type of the section that holds a part of a merged file.
 * @param {number} number counted from 0
 */
export const partType = (number) => `PT${String(number).padStart(2, "0")}`;

const KNOWN_TYPES = new Set(["META", EXPOSURE_TYPE, ...FIELD_TYPES, PART_NAMES_TYPE]);
for (let part = 0; part < MAX_PARTS; part++) KNOWN_TYPES.add(partType(part));
for (let layer = 0; layer < MAX_LAYERS; layer++) {
  for (const type of [...LAYERED_TYPES, ...RESIDUAL_TYPES]) KNOWN_TYPES.add(layerType(type, layer));
}

/**
 * Rounds a length in bytes up to a multiple of 8, as sections are padded.
 * @param {number} length
 */
const paddedLength = (length) => Math.ceil(length / 8) * 8;

/** The sections of a file whose header and table of contents have been checked. */
export class Container {
  /**
   * @param {Uint8Array} bytes the whole file, or its start
   * @param {boolean} partial whether the start of a file is accepted
   * @throws {HyrfFormatError} the header or the table of contents is invalid, or the file is truncated
   */
  constructor(bytes, partial) {
    this.bytes = bytes;
    /** @type {[number, number]} */
    this.version = [MAJOR_VERSION, 0];
    /** The length of the whole file in bytes, from its header. */
    this.length = 0;
    /** @type {Map<string, Entry>} */
    this.entries = new Map();
    /** The file that holds the sections of codec 12, once it is known. @type {Container | null} */
    this.shared = null;
    /** The name of this file, if another one refers to it. */
    this.name = "";
    /** Results of decoding that files which refer to this one need, too. @type {Map<string, any>} */
    this.decoded = new Map();
    this.checkEntries(this.checkHeader(partial));
  }

  /**
   * Returns whether all bytes of a section are available.
   * @param {string} type
   */
  has(type) {
    const entry = this.entries.get(type);
    return entry !== undefined && entry.end <= this.bytes.length;
  }

  /**
   * Returns the stored bytes of a section, after it has checked their checksum and their padding.
   * @param {string} type the type of an available section
   * @throws {HyrfFormatError} the checksum or the padding is wrong
   */
  stored(type) {
    const entry = /** @type {Entry} */ (this.entries.get(type));
    const stored = this.bytes.subarray(entry.offset, entry.offset + entry.stored);
    if (crc32(stored) !== entry.checksum) rejectDamaged(`the checksum of section '${type}' does not match its bytes`);
    const padding = this.bytes.subarray(entry.offset + entry.stored, entry.end);
    if (padding.some((byte) => byte !== 0)) rejectDamaged(`the padding after section '${type}' is not zero`);
    return stored;
  }

  /**
   * Checks the header by steps 1 to 3 of docs/reference/format.md 1.3.
   * @param {boolean} partial whether the start of a file is accepted
   * @returns {DataView} the table of contents, whose checksum is right
   */
  checkHeader(partial) {
    const { bytes } = this;
    const available = bytes.length;
    if (available === 0) rejectDamaged("it is empty");
    if (MAGIC_BYTES.some((byte, i) => i < available && bytes[i] !== byte)) {
      throw new HyrfFormatError("This is not a .hyrf file; check the address or the path.");
    }
    const view = new DataView(bytes.buffer, bytes.byteOffset, available);
    // The version is checked first, because another major version may change the layout of everything after it.
    if (available >= 12) {
      this.version = [view.getUint16(8, true), view.getUint16(10, true)];
      if (this.version[0] !== MAJOR_VERSION) {
        rejectNewer(`it has format version ${this.version.join(".")} and this reader knows version ${MAJOR_VERSION}`);
      }
    }
    if (available < HEADER_BYTES) rejectDamaged(`it ends after ${available} bytes, within its header`);
    if (crc32(bytes.subarray(0, 44)) !== view.getUint32(44, true)) {
      rejectDamaged("the checksum of the header does not match its bytes");
    }
    const flags = view.getUint32(12, true);
    if (flags) rejectNewer(`its header sets the flags 0x${flags.toString(16)}`);
    this.length = readUint64(view, 16);
    const lengths = `its header says ${groupedDigits(this.length)} bytes and there are ${groupedDigits(available)}`;
    if (this.length > available && !partial) {
      throw new HyrfFormatError(`The file is truncated: ${lengths}; fetch it again.`);
    }
    if (this.length < available) rejectDamaged(lengths);
    if (this.length > MAX_FILE_BYTES) rejectDamaged(`its header says ${groupedDigits(this.length)} bytes, too many`);
    const count = view.getUint32(36, true);
    if (count > MAX_SECTIONS) rejectDamaged(`its header says ${groupedDigits(count)} sections, too many`);
    const length = view.getUint32(32, true);
    const end = HEADER_BYTES + length;
    if (readUint64(view, 24) !== HEADER_BYTES || length !== count * ENTRY_BYTES || end > this.length) {
      rejectDamaged("its header misplaces the table of contents");
    }
    if (end > available) rejectDamaged(`it ends after ${available} bytes, within its table of contents`);
    const table = bytes.subarray(HEADER_BYTES, end);
    if (crc32(table) !== view.getUint32(40, true)) {
      rejectDamaged("the checksum of the table of contents does not match its bytes");
    }
    return new DataView(table.buffer, table.byteOffset, length);
  }

  /**
   * Checks the table of contents by steps 4 to 6 of docs/reference/format.md 1.3, and fills `entries`.
   * @param {DataView} table
   */
  checkEntries(table) {
    let end = HEADER_BYTES + table.byteLength, declared = 0;
    for (let at = 0; at < table.byteLength; at += ENTRY_BYTES) {
      const letters = [0, 1, 2, 3].map((i) => String.fromCharCode(table.getUint8(at + i)));
      const type = letters.join("");
      if (!/^[A-Za-z0-9_]{4}$/.test(type)) rejectDamaged(`a section has the malformed type ${quotedText(type)}`);
      if (this.entries.has(type)) rejectDamaged(`section '${type}' occurs twice`);
      const flags = table.getUint16(at + 6, true);
      if (flags & 1 && !KNOWN_TYPES.has(type)) rejectNewer(`it requires section '${type}', which is unknown`);
      if (flags > 1 || table.getUint32(at + 36, true)) rejectDamaged(`section '${type}' sets reserved bits`);
      const offset = readUint64(table, at + 8), stored = readUint64(table, at + 16), raw = readUint64(table, at + 24);
      if (offset !== end) rejectDamaged(`section '${type}' is at a wrong place`);
      if (stored > this.length - offset) rejectDamaged(`section '${type}' does not fit into the file`);
      end = offset + paddedLength(stored);
      const codec = table.getUint16(at + 4, true), checksum = table.getUint32(at + 32, true);
      this.entries.set(type, { type, codec, offset, stored, raw, checksum, end });
      // Sections that are not available are not decoded, so their declared size takes no memory.
      if (end <= this.bytes.length) declared += raw;
    }
    if (end !== this.length) rejectDamaged("its sections end elsewhere than the file");
    const limit = rawBytesLimit(this.bytes.length);
    if (declared > limit) rejectDamaged(`its sections say they decode to ${groupedDigits(declared)} bytes, too many`);
  }
}

/**
 * Throws the error for a file of which too few bytes are available.
 * @param {Container} container
 * @param {number} needed the number of bytes, from the start of the file, that are needed
 * @returns {never}
 */
export const rejectIncomplete = (container, needed) => {
  const [required, all, available] = [needed, container.length, container.bytes.length].map(groupedDigits);
  const problem = `The first ${required} of ${all} bytes make a model and ${available} are there`;
  throw new HyrfFormatError(`${problem}; fetch more.`);
};

/**
 * Reads an unsigned 64-bit integer. Above 2^53 it is rounded, which is harmless, because all limits are far lower.
 * @param {DataView} view
 * @param {number} at the offset in bytes
 */
export const readUint64 = (view, at) => view.getUint32(at + 4, true) * 2 ** 32 + view.getUint32(at, true);
