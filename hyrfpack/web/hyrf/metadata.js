// Reads the section META (docs/reference/format.md 2.1), which is needed to decode the others.

import { MAX_LAYERS, rejectIncomplete } from "./container.js";
import { DamagedData, HyrfFormatError, assertValid, quotedText, rejectDamaged, rejectNewer } from "./errors.js";
import { inflateZlib } from "./inflate.js";
import { JsonNumber, parseJson } from "./json.js";

/**
 * @typedef {import("./container.js").Container} Container
 * @typedef {import("./container.js").Entry} Entry
 * @typedef {import("./json.js").JsonNode} JsonNode
 * @typedef {import("./json.js").JsonObject} JsonObject
 * @typedef {import("./grids.js").Grid} Grid
 *
 * The frame of a model. `rotation`, a quaternion wxyz, is absent if its axes are those of the world; `frameAxes` of
 * rotation.js reads it.
 * @typedef {{center: number[], scale: number, half_extent: number[], rotation?: number[]}} Frame
 *
 * The configuration of a model.
 * @typedef {{
 *   frame: Frame, geometry: Grid, radiance: Grid, hidden: number, background: boolean, solid: number[],
 *   scale_rule: "sum" | "product", scale_grows: boolean, direction_encoding: "sh" | "frequency",
 *   antialiased: boolean, position_gradients: boolean, residual_degree?: number,
 * }} Config
 *
 * The stored object. At its top level it keeps keys that this reader does not know.
 * @typedef {{
 *   gaussians: number, layers?: number[], config: Config, rules: Record<string, string | number>, profile: string,
 *   settings: Record<string, any>, provenance: Record<string, any>, writer: string,
 * }} Metadata
 */

const CODEC_JSON = 0;
const CODEC_DEFLATED = 5;
const MAX_METADATA_BYTES = 2 ** 20;
const MAX_DEFLATE_OVERHEAD_BYTES = 1024; // bounds the time that a forged stream of empty blocks can take
const MAX_GAUSSIANS = 2 ** 40 - 1;
export const MAX_QUAT_LENGTH_ERROR = 1e-6;

/** @type {Record<string, string | number>} */
const KNOWN_RULES = {
  activations: "sigmoid",
  background_radius: 100,
  contraction: "l2",
  decoders: "relu",
  hash: "instant-ngp",
  rotation: "identity-offset",
};

/**
 * Reads and checks the metadata of a file.
 * @param {Container} container
 * @returns {Metadata}
 * @throws {HyrfFormatError} it is absent, too long or not JSON, or a field is missing or invalid
 */
export const readMetadata = (container) => {
  const entry = container.entries.get("META") ?? rejectDamaged("there is no section 'META'");
  try {
    const text = decodeMetadataText(container, entry);
    checkMetadata(parseJson(text));
    return JSON.parse(text);
  } catch (error) {
    if (!(error instanceof DamagedData)) throw error;
    throw new HyrfFormatError(`The metadata is not valid: ${error.message}; fetch or write the file again.`);
  }
};

/**
 * Returns the decompressed text of the metadata.
 * @param {Container} container
 * @param {Entry} entry
 */
const decodeMetadataText = (container, { codec, raw, stored, end }) => {
  if (codec !== CODEC_JSON && codec !== CODEC_DEFLATED) rejectNewer(`its metadata has codec ${codec}`);
  if (raw > MAX_METADATA_BYTES) rejectDamaged(`its metadata has more than ${MAX_METADATA_BYTES} bytes`);
  if (codec === CODEC_JSON ? raw !== stored : stored > raw + MAX_DEFLATE_OVERHEAD_BYTES) {
    rejectDamaged(`its metadata has ${stored} bytes and says ${raw}`);
  }
  if (!container.has("META")) rejectIncomplete(container, end);
  const bytes = container.stored("META");
  // TextDecoder does not accept shared memory, so the bytes are copied.
  const plain = codec === CODEC_DEFLATED ? inflateZlib(bytes, raw) : bytes.slice();
  try {
    return new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(plain);
  } catch {
    throw new DamagedData("it is not UTF-8");
  }
};

/**
 * Checks the fields that are needed to decode a file.
 * @param {JsonNode} node
 */
const checkMetadata = (node) => {
  const values = requireObject(node, "the metadata");
  for (const key of ["rules", "settings", "provenance"]) requireObject(values.get(key), key);
  for (const key of ["profile", "writer"]) assertValid(typeof values.get(key) === "string", `'${key}' must be text`);
  const gaussians = requireInteger(values.get("gaussians"), "gaussians", 0, MAX_GAUSSIANS);
  const layers = requireList(values.has("layers") ? values.get("layers") : [], "layers");
  assertValid(layers.length <= MAX_LAYERS, `there are ${layers.length} layers`);
  const counts = layers.map((count) => requireInteger(count, "layers", 0, MAX_GAUSSIANS));
  const sum = counts.reduce((total, count) => total + count, 0);
  assertValid(counts.length === 0 || sum === gaussians, `its layers do not add up to ${gaussians} Gaussians`);
  checkRules(values.get("rules"));
  checkConfig(values.get("config"));
};

/**
 * Checks that the rules of the file are exactly those that this reader knows.
 * @param {JsonObject} rules
 */
const checkRules = (rules) => {
  for (const name of new Set([...rules.keys(), ...Object.keys(KNOWN_RULES)])) {
    const node = rules.get(name);
    const value = node instanceof JsonNumber ? node.value : node;
    if (!Object.hasOwn(KNOWN_RULES, name) || value !== KNOWN_RULES[name]) {
      rejectNewer(`it follows a rule ${quotedText(name)} that this reader does not know`);
    }
  }
};

/**
 * Checks the configuration of the model.
 * @param {JsonNode | undefined} node
 */
const checkConfig = (node) => {
  const booleans = ["background", "scale_grows", "position_gradients", "antialiased"];
  const others = ["frame", "geometry", "radiance", "hidden", "solid", "scale_rule", "direction_encoding"];
  const config = requireExactObject(node, "config", [...booleans, ...others], ["residual_degree"]);
  for (const key of booleans) {
    assertValid(typeof config.get(key) === "boolean", `'config.${key}' must be true or false`);
  }
  const frameKeys = ["center", "scale", "half_extent"];
  const frame = requireExactObject(config.get("frame"), "config.frame", frameKeys, ["rotation"]);
  requireTriple(frame.get("center"), "config.frame.center");
  const sizes = [requireFiniteNumber(frame.get("scale"), "config.frame.scale")];
  sizes.push(...requireTriple(frame.get("half_extent"), "config.frame.half_extent"));
  assertValid(sizes.every((size) => size > 0), "the frame's scale and half extents must be positive");
  if (frame.has("rotation")) {
    const length = Math.hypot(...requireNumbers(frame.get("rotation"), "config.frame.rotation", 4));
    assertValid(Math.abs(length - 1) <= MAX_QUAT_LENGTH_ERROR, "'config.frame.rotation' must have unit length");
  }
  for (const field of ["geometry", "radiance"]) {
    const keys = ["log2_table_size", "levels", "base", "finest"];
    const grid = requireExactObject(config.get(field), `config.${field}`, keys);
    requireInteger(grid.get("log2_table_size"), `config.${field}.log2_table_size`, 4, 24);
    requireInteger(grid.get("levels"), `config.${field}.levels`, 1, 32);
    const base = requireInteger(grid.get("base"), `config.${field}.base`, 2, 65536);
    requireInteger(grid.get("finest"), `config.${field}.finest`, base, 65536);
  }
  requireInteger(config.get("hidden"), "config.hidden", 1, 1024);
  if (config.has("residual_degree")) requireInteger(config.get("residual_degree"), "config.residual_degree", 0, 3);
  requireTriple(config.get("solid"), "config.solid");
  requireChoice(config.get("scale_rule"), "config.scale_rule", ["sum", "product"]);
  requireChoice(config.get("direction_encoding"), "config.direction_encoding", ["sh", "frequency"]);
};

/**
 * Returns a node that must be an object.
 * @param {JsonNode | undefined} node
 * @param {string} path its keys, for the error message
 * @returns {JsonObject}
 * @throws {DamagedData} it is not an object
 */
const requireObject = (node, path) => {
  assertValid(node instanceof Map, `'${path}' must be an object`);
  return /** @type {JsonObject} */ (node);
};

/**
 * Returns a node that must be an object with exactly these keys.
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @param {string[]} keys
 * @param {string[]} [optional] keys that may be absent
 */
const requireExactObject = (node, path, keys, optional = []) => {
  const object = requireObject(node, path);
  for (const key of keys) assertValid(object.has(key), `'${path}.${key}' is missing`);
  const known = [...keys, ...optional];
  assertValid([...object.keys()].every((key) => known.includes(key)), `'${path}' has keys that are unknown`);
  return object;
};

/**
 * Returns a node that must be a list.
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @returns {JsonNode[]}
 */
const requireList = (node, path) => {
  assertValid(Array.isArray(node), `'${path}' must be a list`);
  return /** @type {JsonNode[]} */ (node);
};

/**
 * Returns the value of a node that must be an integer from `low` to `high`.
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @param {number} low
 * @param {number} high
 */
const requireInteger = (node, path, low, high) => {
  const value = node instanceof JsonNumber && node.isInteger ? node.value : NaN;
  assertValid(value >= low && value <= high, `'${path}' must be an integer from ${low} to ${high}`);
  return value;
};

/**
 * Returns the value of a node that must be a finite number.
 * @param {JsonNode | undefined} node
 * @param {string} path
 */
const requireFiniteNumber = (node, path) => {
  const value = node instanceof JsonNumber ? node.value : NaN;
  assertValid(Number.isFinite(value), `'${path}' must be a finite number`);
  return value;
};

/**
 * Returns the values of a node that must be a list of `count` finite numbers.
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @param {number} count
 */
const requireNumbers = (node, path, count) => {
  const list = requireList(node, path);
  assertValid(list.length === count, `'${path}' must be a list of ${count}`);
  return list.map((item) => requireFiniteNumber(item, path));
};

/**
 * Returns the values of a node that must be a list of three finite numbers.
 * @param {JsonNode | undefined} node
 * @param {string} path
 */
const requireTriple = (node, path) => requireNumbers(node, path, 3);

/**
 * Checks that a node is one of several strings.
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @param {string[]} choices
 */
const requireChoice = (node, path, choices) =>
  assertValid(typeof node === "string" && choices.includes(node), `'${path}' must be one of ${choices.join(", ")}`);
