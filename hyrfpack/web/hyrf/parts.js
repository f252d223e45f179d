// The parts of a merged file, each a whole `.hyrf` file (docs/reference/format.md 2.11).

import { Container, MAX_PARTS, PART_NAMES_TYPE, partType, rawBytesLimit } from "./container.js";
import { HyrfFormatError, rejectDamaged, rejectNewer } from "./errors.js";
import { isReference } from "./shared.js";

const CODEC_NAMES = 0;
const CODEC_FILE = 10;
const MAX_NAMES_BYTES = 2 ** 16;
const MAX_NAME_LENGTH = 64;
export const CONTROL_CHARACTERS = /[\u0000-\u001f\u007f-\u009f\u2028\u2029\ud800-\udfff]/u;

/**
 * Reads the names of a merged file's parts.
 * @param {Container} container
 * @returns {string[]}
 * @throws {HyrfFormatError} the names are damaged
 */
export const readPartNames = (container) => {
  const { codec, stored, raw } = /** @type {import("./container.js").Entry} */ (container.entries.get(PART_NAMES_TYPE));
  if (codec !== CODEC_NAMES || raw !== stored || stored > MAX_NAMES_BYTES) {
    rejectNewer("the names of its parts are stored in another way");
  }
  /** @type {any} */
  let content = null;
  try {
    const decoder = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });
    // TextDecoder does not accept shared memory, so the bytes are copied.
    content = JSON.parse(decoder.decode(container.stored(PART_NAMES_TYPE).slice()));
  } catch (error) {
    if (error instanceof HyrfFormatError) throw error;
    rejectDamaged("the names of its parts are not JSON");
  }
  const names = content?.names;
  if (!arePartNames(names)) rejectDamaged("the names of its parts are not valid");
  return names;
};

/**
 * Returns whether a value is a list of names of parts.
 * @param {any} names
 */
export const arePartNames = (names) =>
  Array.isArray(names) && names.length >= 1 && names.length <= MAX_PARTS && names.every(isName) &&
  new Set(names).size === names.length;

/**
 * Returns whether a value may name a part.
 * @param {any} name
 */
const isName = (name) =>
  typeof name === "string" && name.length > 0 && [...name].length <= MAX_NAME_LENGTH && !CONTROL_CHARACTERS.test(name);

/**
 * Returns the name and the container of each part, after it has checked all sizes that the parts declare.
 * @param {Container} container of a merged file that is complete
 * @returns {{name: string, container: Container}[]}
 * @throws {HyrfFormatError} a part is missing or damaged, is itself a merged file, or refers to another file; or the
 *   parts declare too many bytes
 */
export const openParts = (container) => {
  let declared = 0;
  const parts = readPartNames(container).map((name, number) => {
    const type = partType(number), entry = container.entries.get(type);
    if (!entry) return rejectDamaged(`there is no section '${type}', so that it is incomplete`);
    if (entry.codec !== CODEC_FILE || entry.raw !== entry.stored) rejectNewer(`section '${type}' is no file`);
    const part = new Container(container.stored(type), false);
    if (part.entries.has(PART_NAMES_TYPE)) rejectDamaged(`section '${type}' is a merged file itself`);
    for (const { type: inner, raw } of part.entries.values()) {
      if (isReference(part, inner)) rejectDamaged(`section '${type}' refers to another file`);
      declared += raw;
    }
    return { name, container: part };
  });
  if (declared > rawBytesLimit(container.length)) rejectDamaged("its parts say that they decode to too many bytes");
  return parts;
};
