// The manifest of a scene folder, `scene.json` (docs/reference/scene-folder.md). It is not trusted: all that is used of
// it is checked.

import { MAX_FILE_BYTES, MAX_PARTS } from "./container.js";
import { DamagedData, HyrfFormatError, assertValid, groupedDigits, quotedText, requireBytes } from "./errors.js";
import { MAX_NESTING_DEPTH } from "./json.js";
import { MAX_QUAT_LENGTH_ERROR } from "./metadata.js";
import { CONTROL_CHARACTERS, arePartNames } from "./parts.js";
import { IDENTITY_QUAT } from "./rotation.js";
import { isFileName } from "./shared.js";

/**
 * A file of the folder: its name, its size, and the CRC-32 of its bytes as 8 hexadecimal digits.
 * @typedef {{file: string, bytes: number, crc32: string}} SceneFile
 *
 * A chunk at one level of detail. `errors` are mean squared errors, one for each of the manifest's `error_radii`.
 * @typedef {SceneFile & {gaussians: number, errors: number[]}} ChunkLevel
 *
 * A part of the scene, by its shared file: a model with fields of its own.
 * @typedef {SceneFile & {name: string}} ScenePart
 *
 * Gaussians of one region of a part: corners of the box that holds them, in world units, levels from the finest, and
 * the number of the part.
 * @typedef {{low: number[], high: number[], levels: ChunkLevel[], part: number}} Chunk
 *
 * The stored object, in which a scene of version 1 has one part. It keeps keys that this reader does not know.
 * @typedef {{
 *   gaussians: number, parts: ScenePart[], chunks: Chunk[], error_radii: number[], frame: Record<string, any>,
 *   background: boolean, solid: number[], viewpoint: Record<string, any>, cameras: number[][],
 *   title: string, licence: string, writer: string,
 * }} Manifest
 */

const FORMAT_NAME = "hyrf-scene";
const PARTS_VERSION = 2; // the major version of a scene of several parts; that of another scene is 1
const ONE_PART_NAME = "scene";
export const MAX_MANIFEST_BYTES = 2 ** 24;
const MAX_CHUNKS = 2 ** 16;
const MAX_LEVELS = 8;
const MAX_ERROR_RADII = 16;
const MAX_CAMERAS = 1024, MAX_CAMERA_NUMBERS = 32;
const MAX_TEXT_LENGTH = 1000;
const INTEGER_LIMIT = 2 ** 40;

/**
 * Parses a manifest.
 * @param {Uint8Array} bytes
 * @returns {Manifest}
 * @throws {HyrfFormatError} it is no manifest, is damaged, or has another major version
 * @throws {TypeError} `bytes` is no Uint8Array
 */
export const parseManifest = (bytes) => {
  requireBytes(bytes, "The manifest");
  try {
    assertValid(bytes.length <= MAX_MANIFEST_BYTES, `it has ${groupedDigits(bytes.length)} bytes`);
    const values = parseText(bytes);
    if (values?.format !== FORMAT_NAME) {
      throw new HyrfFormatError("This is not the manifest of a scene folder; check the address.");
    }
    assertValid(!isTooDeep(values, MAX_NESTING_DEPTH), `it is nested deeper than ${MAX_NESTING_DEPTH} levels`);
    const hasOnePart = readMajorVersion(values.version) < PARTS_VERSION;
    const manifest = hasOnePart ? { ...values, ...wrapOnePart(values) } : values;
    checkManifest(manifest, hasOnePart ? 1 : 2);
    return manifest;
  } catch (error) {
    if (!(error instanceof DamagedData)) throw error;
    throw new HyrfFormatError(`The manifest is damaged: ${error.message}; copy the whole folder again.`);
  }
};

/**
 * Parses JSON in UTF-8.
 * @param {Uint8Array} bytes
 * @returns {any}
 */
const parseText = (bytes) => {
  const plain = bytes.slice(); // TextDecoder does not accept shared memory
  try {
    return JSON.parse(new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(plain));
  } catch {
    throw new DamagedData("it is not JSON");
  }
};

/**
 * Returns whether objects and lists are nested deeper than a number of levels.
 * @param {any} value
 * @param {number} levels
 * @returns {boolean}
 */
const isTooDeep = (value, levels) =>
  Object(value) === value && (levels === 0 || Object.values(value).some((inner) => isTooDeep(inner, levels - 1)));

/**
 * Returns the major version of a manifest.
 * @param {any} version
 * @throws {HyrfFormatError} this reader does not know the version
 */
const readMajorVersion = (version) => {
  const match = typeof version === "string" ? /^(\d{1,4})\.\d{1,4}$/.exec(version) : null;
  if (!match) throw new DamagedData("it has no version");
  const major = Number(match[1]);
  if (major >= 1 && major <= PARTS_VERSION) return major;
  throw new HyrfFormatError(
    `The scene has version ${version} and this reader knows versions 1 and ${PARTS_VERSION}; update the reader.`,
  );
};

/**
 * Returns the parts and the chunks of a scene of version 1 as those of a scene of version 2 with one part.
 * @param {Record<string, any>} values
 */
const wrapOnePart = ({ shared, chunks }) => {
  checkFile(shared, "shared");
  checkList(chunks, "chunks", 0, MAX_CHUNKS);
  const owned = chunks.map((/** @type {any} */ chunk) => (isObject(chunk) ? { ...chunk, part: 0 } : chunk));
  return { parts: [{ ...shared, name: ONE_PART_NAME }], chunks: owned };
};

/**
 * Checks all values that this package uses, and that they fit each other.
 * @param {Record<string, any>} values
 * @param {number} minParts
 */
const checkManifest = (values, minParts) => {
  const { chunks, parts, error_radii: radii } = values;
  checkNumbers(radii, "error_radii", 1, MAX_ERROR_RADII, 0);
  const isRising = (/** @type {number} */ radius, /** @type {number} */ k) => radius > (k ? radii[k - 1] : 0);
  assertValid(radii.every(isRising), "'error_radii' do not rise");
  checkList(parts, "parts", minParts, MAX_PARTS);
  for (const part of parts) checkFile(part, "parts");
  assertValid(arePartNames(parts.map((/** @type {any} */ { name }) => name)), "the names of its parts are not valid");
  checkList(chunks, "chunks", 0, MAX_CHUNKS);
  for (const chunk of chunks) checkChunk(chunk, radii.length, parts.length);
  for (const key of ["frame", "viewpoint"]) assertValid(isObject(values[key]), `'${key}' must be an object`);
  checkFrame(values.frame);
  assertValid(typeof values.background === "boolean", "'background' must be true or false");
  checkNumbers(values.solid, "solid", 3, 3);
  checkList(values.cameras, "cameras", 0, MAX_CAMERAS);
  for (const camera of values.cameras) checkNumbers(camera, "cameras", 1, MAX_CAMERA_NUMBERS);
  for (const key of ["title", "licence", "writer"]) {
    const text = values[key];
    const isText = typeof text === "string" && [...text].length <= MAX_TEXT_LENGTH && !CONTROL_CHARACTERS.test(text);
    assertValid(isText, `'${key}' must be a text of at most ${MAX_TEXT_LENGTH} characters`);
  }
  checkInteger(values.gaussians, "gaussians");
  let sum = 0;
  for (const { levels } of chunks) sum += levels[0].gaussians;
  assertValid(sum === values.gaussians, `the chunks do not add up to ${values.gaussians} Gaussians`);
  // Some file systems ignore case.
  const names = listFiles(/** @type {Manifest} */ (values)).map(({ file }) => file.toLowerCase());
  assertValid(new Set(names).size === names.length, "two files have the same name");
};

/**
 * Checks the part of the scene's frame by which a view is placed. The files have the whole frame.
 * @param {any} frame
 */
const checkFrame = ({ center, scale, rotation = IDENTITY_QUAT }) => {
  checkNumbers(center, "center", 3, 3);
  checkNumbers([scale], "scale", 1, 1);
  checkNumbers(rotation, "rotation", 4, 4);
  const isValid = scale > 0 && Math.abs(Math.hypot(...rotation) - 1) <= MAX_QUAT_LENGTH_ERROR;
  assertValid(isValid, "'frame' has an invalid scale or rotation");
};

/**
 * Returns all files of the folder but the manifest.
 * @param {Manifest} manifest
 * @returns {SceneFile[]}
 */
export const listFiles = ({ parts, chunks }) => [...parts, ...chunks.flatMap(({ levels }) => levels)];

/**
 * Returns the bytes of the shared files of all parts.
 * @param {Manifest} manifest
 */
export const sharedBytes = ({ parts }) => parts.reduce((sum, { bytes }) => sum + bytes, 0);

/**
 * Checks a chunk and its levels.
 * @param {any} chunk
 * @param {number} radiusCount the number of errors of a level
 * @param {number} partCount
 */
const checkChunk = (chunk, radiusCount, partCount) => {
  assertValid(isObject(chunk), "a chunk is no object");
  for (const key of ["low", "high"]) checkNumbers(chunk[key], key, 3, 3);
  const inOrder = chunk.low.every((/** @type {number} */ low, /** @type {number} */ axis) => low <= chunk.high[axis]);
  assertValid(inOrder, "the box of a chunk is not in order");
  checkInteger(chunk.part, "part");
  assertValid(chunk.part < partCount, `a chunk belongs to part ${chunk.part}, and there are ${partCount} parts`);
  checkList(chunk.levels, "levels", 1, MAX_LEVELS);
  for (const level of chunk.levels) {
    checkFile(level, "levels");
    checkInteger(level.gaussians, "gaussians");
    checkNumbers(level.errors, "errors", radiusCount, radiusCount, 0);
  }
};

/**
 * Checks the entry of a file.
 * @param {any} file
 * @param {string} key where the entry is, for the error message
 */
const checkFile = (file, key) => {
  assertValid(isObject(file), `'${key}' must be an object`);
  if (!isFileName(file.file)) {
    const name = typeof file.file === "string" ? quotedText(file.file) : `'file' of '${key}'`;
    throw new DamagedData(`${name} is not the name of a .hyrf file in the folder`);
  }
  checkInteger(file.bytes, "bytes");
  assertValid(file.bytes <= MAX_FILE_BYTES, "'bytes' is out of range");
  const isChecksum = typeof file.crc32 === "string" && /^[0-9a-f]{8}$/.test(file.crc32);
  assertValid(isChecksum, `the checksum of ${file.file} is not 8 hexadecimal digits`);
};

/**
 * Returns whether a value is an object, and no list.
 * @param {any} value
 */
const isObject = (value) => typeof value === "object" && value !== null && !Array.isArray(value);

/**
 * Checks that a value is an integer from 0 to INTEGER_LIMIT - 1.
 * @param {any} value
 * @param {string} key
 */
const checkInteger = (value, key) =>
  assertValid(Number.isInteger(value) && value >= 0 && value < INTEGER_LIMIT, `'${key}' is out of range`);

/**
 * Checks that a value is a list of `minLength` to `maxLength` entries.
 * @param {any} list
 * @param {string} key
 * @param {number} minLength
 * @param {number} maxLength
 */
const checkList = (list, key, minLength, maxLength) => {
  if (Array.isArray(list) && list.length >= minLength && list.length <= maxLength) return;
  throw new DamagedData(`'${key}' must be a list of ${minLength} to ${groupedDigits(maxLength)} entries`);
};

/**
 * Checks that a value is a list of `minLength` to `maxLength` finite numbers.
 * @param {any} numbers
 * @param {string} key
 * @param {number} minLength
 * @param {number} maxLength
 * @param {number} [minimum] of the numbers
 */
const checkNumbers = (numbers, key, minLength, maxLength, minimum = -Infinity) => {
  checkList(numbers, key, minLength, maxLength);
  const areFinite = numbers.every((/** @type {any} */ value) => Number.isFinite(value) && value >= minimum);
  assertValid(areFinite, `'${key}' holds something else than numbers in range`);
};
