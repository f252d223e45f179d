// The section META (docs/format.md 2.1): what a reader must know before it decodes the others.

import { incompleteFile } from "./container.js";
import { DamagedData, HyrfFormatError, damagedFile, needSound, newerFile, quotedText } from "./errors.js";
import { inflateZlib } from "./inflate.js";
import { JsonNumber, parseJson } from "./json.js";

/**
 * @typedef {import("./container.js").Container} Container
 * @typedef {import("./container.js").Entry} Entry
 * @typedef {import("./json.js").JsonNode} JsonNode
 * @typedef {import("./json.js").JsonObject} JsonObject
 * @typedef {import("./grids.js").Grid} Grid
 *
 * @typedef {{center: number[], scale: number, half_extent: number[]}} Frame
 *
 * The shape of a model.
 * @typedef {{
 *   frame: Frame, geometry: Grid, radiance: Grid, hidden: number, background: boolean, solid: number[],
 *   scale_rule: "sum" | "product", scale_grows: boolean, direction_encoding: "sh" | "frequency",
 *   antialiased: boolean, position_gradients: boolean,
 * }} Config
 *
 * META as it is stored: keys of the top level that this reader does not know are there too.
 * @typedef {{
 *   gaussians: number, layers?: number[], config: Config, rules: Record<string, string | number>, profile: string,
 *   settings: Record<string, any>, provenance: Record<string, any>, writer: string,
 * }} Metadata
 */

const CODEC_JSON = 0, CODEC_DEFLATED = 5;
const MOST_META_BYTES = 2 ** 20;
const MOST_GAUSSIANS = 2 ** 40 - 1;
const MOST_LAYERS_OF_FILE = 8;

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
 * @param {Container} container
 * @returns {Metadata}
 * @throws {HyrfFormatError} it is absent, too long, not JSON, or a field is missing or wrong
 */
export const readMetadata = (container) => {
  const entry = container.entries.get("META") ?? damagedFile("there is no section 'META'");
  try {
    const text = metadataText(container, entry);
    checkMetadata(parseJson(text));
    return JSON.parse(text);
  } catch (error) {
    if (!(error instanceof DamagedData)) throw error;
    throw new HyrfFormatError(`The metadata is not valid: ${error.message}; fetch or write the file again.`);
  }
};

/**
 * @param {Container} container
 * @param {Entry} entry
 */
const metadataText = (container, { codec, raw, stored, end }) => {
  if (codec !== CODEC_JSON && codec !== CODEC_DEFLATED) newerFile(`its metadata has codec ${codec}`);
  if (raw > MOST_META_BYTES) damagedFile(`its metadata has ${raw} bytes, and ${MOST_META_BYTES} may be`);
  if (codec === CODEC_JSON && raw !== stored) damagedFile(`its metadata has ${stored} bytes and says ${raw}`);
  if (!container.has("META")) incompleteFile(container, end);
  const bytes = container.stored("META");
  // A copy, as decoders of text take no shared memory.
  const plain = codec === CODEC_DEFLATED ? inflateZlib(bytes, raw) : bytes.slice();
  try {
    return new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(plain);
  } catch {
    throw new DamagedData("it is not UTF-8");
  }
};

/** @param {JsonNode} node */
const checkMetadata = (node) => {
  const values = objectOf(node, "the metadata");
  for (const key of ["rules", "settings", "provenance"]) objectOf(values.get(key), key);
  for (const key of ["profile", "writer"]) needSound(typeof values.get(key) === "string", `'${key}' must be text`);
  const gaussians = integerOf(values.get("gaussians"), "gaussians", 0, MOST_GAUSSIANS);
  const layers = listOf(values.has("layers") ? values.get("layers") : [], "layers");
  needSound(layers.length <= MOST_LAYERS_OF_FILE, `there are ${layers.length} layers`);
  const counts = layers.map((count) => integerOf(count, "layers", 0, MOST_GAUSSIANS));
  const sum = counts.reduce((before, count) => before + count, 0);
  needSound(counts.length === 0 || sum === gaussians, `its layers do not add up to ${gaussians} Gaussians`);
  checkRules(values.get("rules"));
  checkConfig(values.get("config"));
};

/** @param {JsonObject} rules */
const checkRules = (rules) => {
  for (const name of new Set([...rules.keys(), ...Object.keys(KNOWN_RULES)])) {
    const node = rules.get(name);
    const value = node instanceof JsonNumber ? node.value : node;
    if (!Object.hasOwn(KNOWN_RULES, name) || value !== KNOWN_RULES[name]) {
      newerFile(`it follows a rule ${quotedText(name)} that this reader does not know`);
    }
  }
};

/** @param {JsonNode | undefined} node */
const checkConfig = (node) => {
  const booleans = ["background", "scale_grows", "position_gradients", "antialiased"];
  const others = ["frame", "geometry", "radiance", "hidden", "solid", "scale_rule", "direction_encoding"];
  const config = exactObjectOf(node, "config", [...booleans, ...others]);
  for (const key of booleans) {
    needSound(typeof config.get(key) === "boolean", `'config.${key}' must be true or false`);
  }
  const frame = exactObjectOf(config.get("frame"), "config.frame", ["center", "scale", "half_extent"]);
  triplesOf(frame.get("center"), "config.frame.center");
  const sizes = [finiteOf(frame.get("scale"), "config.frame.scale")];
  sizes.push(...triplesOf(frame.get("half_extent"), "config.frame.half_extent"));
  needSound(sizes.every((size) => size > 0), "the frame's scale and half extents must be positive");
  for (const field of ["geometry", "radiance"]) {
    const keys = ["log2_table_size", "levels", "base", "finest"];
    const grid = exactObjectOf(config.get(field), `config.${field}`, keys);
    integerOf(grid.get("log2_table_size"), `config.${field}.log2_table_size`, 4, 24);
    integerOf(grid.get("levels"), `config.${field}.levels`, 1, 32);
    const base = integerOf(grid.get("base"), `config.${field}.base`, 2, 65536);
    integerOf(grid.get("finest"), `config.${field}.finest`, base, 65536);
  }
  integerOf(config.get("hidden"), "config.hidden", 1, 1024);
  triplesOf(config.get("solid"), "config.solid");
  choiceOf(config.get("scale_rule"), "config.scale_rule", ["sum", "product"]);
  choiceOf(config.get("direction_encoding"), "config.direction_encoding", ["sh", "frequency"]);
};

/**
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @returns {JsonObject}
 */
const objectOf = (node, path) => {
  needSound(node instanceof Map, `'${path}' must be an object`);
  return /** @type {JsonObject} */ (node);
};

/**
 * An object with these keys and no others.
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @param {string[]} keys
 */
const exactObjectOf = (node, path, keys) => {
  const object = objectOf(node, path);
  for (const key of keys) needSound(object.has(key), `'${path}.${key}' is missing`);
  needSound(object.size === keys.length, `'${path}' has keys that are unknown`);
  return object;
};

/**
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @returns {JsonNode[]}
 */
const listOf = (node, path) => {
  needSound(Array.isArray(node), `'${path}' must be a list`);
  return /** @type {JsonNode[]} */ (node);
};

/**
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @param {number} low
 * @param {number} high
 */
const integerOf = (node, path, low, high) => {
  const value = node instanceof JsonNumber && node.isInteger ? node.value : NaN;
  needSound(value >= low && value <= high, `'${path}' must be an integer from ${low} to ${high}`);
  return value;
};

/**
 * @param {JsonNode | undefined} node
 * @param {string} path
 */
const finiteOf = (node, path) => {
  const value = node instanceof JsonNumber ? node.value : NaN;
  needSound(Number.isFinite(value), `'${path}' must be a finite number`);
  return value;
};

/**
 * @param {JsonNode | undefined} node
 * @param {string} path
 */
const triplesOf = (node, path) => {
  const list = listOf(node, path);
  needSound(list.length === 3, `'${path}' must be a list of 3`);
  return list.map((item) => finiteOf(item, path));
};

/**
 * @param {JsonNode | undefined} node
 * @param {string} path
 * @param {string[]} choices
 */
const choiceOf = (node, path, choices) =>
  needSound(typeof node === "string" && choices.includes(node), `'${path}' must be one of ${choices.join(", ")}`);
