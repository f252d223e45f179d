// Sections that lie in another file of the same folder (codec 12, docs/reference/format.md 2.12).

import { Container, EXPOSURE_TYPE, FIELD_TYPES } from "./container.js";
import { HyrfFormatError, rejectDamaged } from "./errors.js";

export const CODEC_SHARED = 12;
const SHARED_TYPES = [EXPOSURE_TYPE, ...FIELD_TYPES];
const CHECKSUM_BYTES = 4;
const MAX_NAME_LENGTH = 64;
const FILE_NAME_PATTERN = /^[A-Za-z0-9_][A-Za-z0-9_.-]*\.hyrf$/; // such a name leads to no other folder

/**
 * The containers of files that others refer to, kept so that each file is checked and decoded once.
 * @type {WeakMap<Uint8Array, Container>}
 */
const openFiles = new WeakMap();

/**
 * Returns whether a value may name another file of the same folder.
 * @param {any} name
 */
export const isFileName = (name) =>
  typeof name === "string" && name.length <= MAX_NAME_LENGTH && FILE_NAME_PATTERN.test(name);

/**
 * Returns the name of the file that the available sections of a file refer to, or null if they refer to none.
 * @param {Container} container
 * @throws {HyrfFormatError} a reference is damaged, or there are several names
 */
export const sharedFileName = (container) => {
  const [name = null, ...others] = new Set(listReferences(container).map((reference) => reference.name));
  if (others.length) rejectDamaged("its sections refer to several files");
  return name;
};

/**
 * Sets `shared` of a file to the file that it refers to.
 * @param {Container} container that of the referring file
 * @param {string} name that of the other file
 * @param {Uint8Array} bytes the other file, whole
 * @throws {HyrfFormatError} the other file is not valid, or is not the one that was referred to
 */
export const attachShared = (container, name, bytes) => {
  const shared = openFiles.get(bytes) ?? explainShared({ name }, () => new Container(bytes, false));
  openFiles.set(bytes, shared);
  shared.name = name;
  for (const { type, checksum } of listReferences(container)) {
    const entry = shared.entries.get(type);
    if (!entry || entry.codec === CODEC_SHARED || entry.checksum !== checksum) {
      throw new HyrfFormatError(`${name}: Section '${type}' is not the one of this file; fetch both files again.`);
    }
  }
  container.shared = shared;
};

/**
 * Returns the result of `read`. The message of an error begins with the name of the file, if others refer to it.
 * @template Result
 * @param {{name: string}} file
 * @param {() => Result} read
 */
export const explainShared = ({ name }, read) => {
  try {
    return read();
  } catch (error) {
    throw name && error instanceof HyrfFormatError ? new HyrfFormatError(`${name}: ${error.message}`) : error;
  }
};

/**
 * Returns whether a section refers to another file. Other types are skipped, or refused where they are read.
 * @param {Container} container
 * @param {string} type
 */
export const isReference = (container, type) =>
  SHARED_TYPES.includes(type) && container.entries.get(type)?.codec === CODEC_SHARED;

/**
 * Lists the references of the available sections: the file's name, and the checksum of the section in it.
 * @param {Container} container
 * @returns {{type: string, name: string, checksum: number}[]}
 */
const listReferences = (container) => {
  const types = [...container.entries.keys()].filter((type) => isReference(container, type) && container.has(type));
  return types.map((type) => {
    const { stored, raw } = /** @type {import("./container.js").Entry} */ (container.entries.get(type));
    const data = stored <= CHECKSUM_BYTES + MAX_NAME_LENGTH ? container.stored(type) : new Uint8Array(0);
    const name = String.fromCharCode(...data.subarray(CHECKSUM_BYTES));
    if (raw !== stored || !isFileName(name)) {
      rejectDamaged(`section '${type}' refers to no file of its folder`);
    }
    return { type, name, checksum: new DataView(data.buffer, data.byteOffset).getUint32(0, true) };
  });
};
