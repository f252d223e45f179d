// Reads models from the bytes of `.hyrf` files, versions 1.0 to 1.6 (docs/reference/format.md). index.js has these
// functions for other programs.

import { decodeChannels } from "./channels.js";
import { Container, EXPOSURE_TYPE, FIELD_TYPES, LAYERED_TYPES } from "./container.js";
import { PART_NAMES_TYPE, RESIDUAL_TYPES, layerType, rejectIncomplete } from "./container.js";
import { DamagedData, HyrfFormatError, explainMemory, rejectDamaged, rejectNewer } from "./errors.js";
import { decodeExposure } from "./exposure.js";
import { FEATURES_PER_ROW, decoderSize, tableRows } from "./grids.js";
import { decodeGroups, decoderGroups, readTableGroups, tableGroups } from "./groups.js";
import { decodeLattice, latticePositions } from "./lattice.js";
import { readMetadata } from "./metadata.js";
import { openParts } from "./parts.js";
import { decodeFloat16, decodeFloat32, decodeMinMax, decodeVectors } from "./plain.js";
import { decodeResiduals, residualColumns } from "./residuals.js";
import { CODEC_SHARED, attachShared, explainShared, sharedFileName } from "./shared.js";

// A file of n bytes may have at most MAX_GAUSSIANS_PER_BYTE n + BASE_GAUSSIANS Gaussians, which bounds the memory.
const MAX_GAUSSIANS_PER_BYTE = 32;
const BASE_GAUSSIANS = 2 ** 18;

/**
 * @typedef {import("./container.js").Entry} Entry
 * @typedef {import("./exposure.js").ExposureMap} ExposureMap
 * @typedef {import("./grids.js").FieldName} FieldName
 * @typedef {import("./lattice.js").LatticePoints} LatticePoints
 * @typedef {import("./metadata.js").Config} Config
 * @typedef {import("./metadata.js").Metadata} Metadata
 *
 * A field: its hash table (rows x 2, laid out by `gridLevels`) and the weights and biases of its decoder (laid out by
 * `decoderLayout`).
 * @typedef {{table: Float32Array, decoder: Float32Array}} Field
 *
 * @typedef {{
 *   metadata: Metadata,
 *   config: Config,
 *   count: number,
 *   layers: number[],
 *   whole: boolean,
 *   positions: Float32Array,
 *   colorLogits: Float32Array,
 *   scaleLogits: Float32Array,
 *   opacityLogits: Float32Array,
 *   shapeResiduals: Float32Array | null,
 *   colorResiduals: Float32Array | null,
 *   geometry: Field,
 *   radiance: Field,
 *   exposure: ExposureMap | null,
 * }} Model `layers` has the number of Gaussians of each layer that was read, and `count` is their sum; `whole` is true
 *   if these are all layers of the file. `positions` (3 numbers per Gaussian) are in local units. The residuals, which
 *   correct what the fields predict, are null in a model without them. `exposure` is the exposure map, for `logGains`,
 *   or null if the file has none.
 *
 * @typedef {{
 *   version: [number, number],
 *   length: number,
 *   sections: {type: string, codec: number, offset: number, stored: number, raw: number}[],
 *   firstLayer: number,
 * }} Description
 *
 * Returns the bytes of another file in the folder of a file. Where it returns the same array for several files, what
 * they share is decoded once.
 * @typedef {(name: string) => Uint8Array | Promise<Uint8Array>} OpenFile
 *
 * A section that the metadata requires: `group` is its type in the first layer, `rows` x `columns` its shape.
 * @typedef {{type: string, group: string, layer: number, rows: number, columns: number}} ExpectedSection
 */

const CODEC_FLOAT32 = 1, CODEC_FLOAT16 = 2, CODEC_VECTORS = 3, CODEC_MIN_MAX = 4;
const CODEC_LATTICE = 6, CODEC_CHANNELS = 7, CODEC_GROUPS = 8, CODEC_EXPOSURE = 9, CODEC_STATED_GROUPS = 11;
const CODEC_RESIDUALS = 13;
const PARAMETER_CODECS = [CODEC_FLOAT32, CODEC_FLOAT16, CODEC_VECTORS, CODEC_MIN_MAX];
PARAMETER_CODECS.push(CODEC_LATTICE, CODEC_CHANNELS, CODEC_GROUPS, CODEC_STATED_GROUPS, CODEC_RESIDUALS);
const LAYERED_COLUMNS = [3, 3, 1, 1];

/** See `describe` of index.js. @type {typeof import("./index.js").describe} */
export const describeFile = (bytes) => {
  const container = new Container(bytes, true);
  const isMerged = container.entries.has(PART_NAMES_TYPE);
  let firstLayer = isMerged ? container.length : 0;
  const residuals = RESIDUAL_TYPES.filter((type) => container.entries.has(type));
  for (const type of isMerged ? [] : ["META", ...LAYERED_TYPES, ...residuals, ...FIELD_TYPES]) {
    firstLayer = Math.max(firstLayer, requireEntry(container, type).end);
  }
  const sections = [...container.entries.values()].map(({ type, codec, offset, stored, raw }) => {
    return { type, codec, offset, stored, raw };
  });
  return { version: container.version, length: container.length, sections, firstLayer };
};

/** See `read` of index.js. @type {typeof import("./index.js").read} */
export const readFile = async (bytes, { partial = false, openFile } = {}) => {
  const container = new Container(bytes, partial), name = sharedFileName(container);
  if (name !== null && openFile) attachShared(container, name, await openFile(name));
  if (!container.entries.has(PART_NAMES_TYPE)) return readModel(container);
  throw new HyrfFormatError("The file holds merged models; use readParts.");
};

/** See `readParts` of index.js. @type {typeof import("./index.js").readParts} */
export const readFileParts = async (bytes) => {
  const container = new Container(bytes, false);
  if (!container.entries.has(PART_NAMES_TYPE)) return [{ name: "scene", model: readModel(container) }];
  const parts = openParts(container);
  const metadatas = parts.map((part) => readMetadata(part.container));
  checkGaussians(metadatas.reduce((sum, { gaussians }) => sum + gaussians, 0), bytes.length);
  if (metadatas.some(({ config }) => config.antialiased !== metadatas[0].config.antialiased)) {
    rejectDamaged("some of its parts are antialiased and others are not");
  }
  return parts.map((part) => ({ name: part.name, model: readModel(part.container) }));
};

/**
 * Throws an error if a file of `length` bytes may not have `count` Gaussians.
 * @param {number} count
 * @param {number} length
 */
const checkGaussians = (count, length) => {
  if (count > MAX_GAUSSIANS_PER_BYTE * length + BASE_GAUSSIANS) {
    rejectDamaged(`it says ${count} Gaussians, too many for its bytes`);
  }
};

/**
 * Decodes all sections that are available.
 * @param {Container} container
 * @returns {Model}
 */
const readModel = (container) => {
  try {
    return decodeModel(container);
  } catch (error) {
    throw explainMemory(error);
  }
};

/**
 * See `readModel`.
 * @param {Container} container
 * @returns {Model}
 */
const decodeModel = (container) => {
  const metadata = readMetadata(container);
  const { config } = metadata, { shared } = container;
  if (shared) {
    const { provenance } = decodeOnce(shared, "META", () => explainShared(shared, () => readMetadata(shared)));
    metadata.provenance = { ...provenance, ...metadata.provenance };
  }
  const counts = metadata.layers?.length ? metadata.layers : [metadata.gaussians];
  const sections = expectedSections(config, counts);
  sections.forEach((section) => checkSection(container, section)); // all are checked before the first one is decoded
  let layerCount = 1;
  /** @param {number} layer */
  const hasLayer = (layer) => layeredTypes(config).every((type) => container.has(layerType(type, layer)));
  while (layerCount < counts.length && hasLayer(layerCount)) layerCount++;
  const required = sections.filter(({ layer }) => layer < layerCount);
  if (!required.every(({ type }) => container.has(type))) {
    rejectIncomplete(container, Math.max(...required.map(({ type }) => requireEntry(container, type).end)));
  }

  const layers = counts.slice(0, layerCount), count = layers.reduce((sum, each) => sum + each, 0);
  checkGaussians(count, container.bytes.length);

  /** @type {Map<string, Float32Array>} */
  const arrays = new Map();
  /** @type {LatticePoints[]} */
  const points = []; // by layer, where positions are lattice points
  for (const section of required) arrays.set(section.type, decodeSection(container, section, config, points));

  /** @param {string} type */
  const joined = (type) => concatenateArrays(layers.map((_, layer) => getArray(arrays, layerType(type, layer))));
  const [positions, colorLogits, scaleLogits, opacityLogits] = LAYERED_TYPES.map(joined);
  const hasResiduals = config.residual_degree !== undefined;
  const [shapeResiduals, colorResiduals] = hasResiduals ? RESIDUAL_TYPES.map(joined) : [null, null];
  return {
    metadata,
    config,
    count,
    layers,
    whole: layerCount === counts.length,
    positions,
    colorLogits,
    scaleLogits,
    opacityLogits,
    shapeResiduals,
    colorResiduals,
    geometry: { table: getArray(arrays, "GTAB"), decoder: getArray(arrays, "GMLP") },
    radiance: { table: getArray(arrays, "RTAB"), decoder: getArray(arrays, "RMLP") },
    exposure: readExposure(container),
  };
};

/**
 * Reads the exposure map. Returns null if the file has none, or if its bytes are not available yet.
 * @param {Container} container
 * @returns {ExposureMap | null}
 */
const readExposure = (container) => {
  if (!container.has(EXPOSURE_TYPE)) return null;
  const source = sourceOf(container, EXPOSURE_TYPE), { codec, raw } = requireEntry(source, EXPOSURE_TYPE);
  if (codec !== CODEC_EXPOSURE) rejectNewer(`section '${EXPOSURE_TYPE}' has the codec ${codec}, which is unknown`);
  return decodeStored(source, EXPOSURE_TYPE, (data) => decodeExposure(data, raw));
};

/**
 * Returns the container that holds a section: that of the file, or of the file that it refers to.
 * @param {Container} container
 * @param {string} type
 * @returns {Container}
 * @throws {HyrfFormatError} the other file is not known
 */
const sourceOf = (container, type) => {
  if (container.entries.get(type)?.codec !== CODEC_SHARED) return container;
  if (!container.has(type)) rejectIncomplete(container, requireEntry(container, type).end);
  if (container.shared) return container.shared;
  const name = sharedFileName(container);
  const fix = "open the folder's scene.json in a player, or give `read` the option openFile";
  throw new HyrfFormatError(`The file needs ${name} of its scene folder; ${fix}.`);
};

/**
 * Returns the result of `decode` for a part of a file, which is called once for all files that refer to it.
 * @template Decoded
 * @param {Container} container
 * @param {string} key
 * @param {() => Decoded} decode
 * @returns {Decoded}
 */
const decodeOnce = ({ decoded }, key, decode) => {
  if (!decoded.has(key)) decoded.set(key, decode());
  return decoded.get(key);
};

/**
 * Returns the types of the sections that each layer has, as in the first layer.
 * @param {Config} config
 */
const layeredTypes = ({ residual_degree: degree }) =>
  degree === undefined ? LAYERED_TYPES : [...LAYERED_TYPES, ...RESIDUAL_TYPES];

/**
 * Lists the sections that a model must have, except the metadata. Positions come first, because others depend on them.
 * @param {Config} config
 * @param {number[]} counts the number of Gaussians of each layer
 * @returns {ExpectedSection[]}
 */
const expectedSections = (config, counts) => {
  const columns = [...LAYERED_COLUMNS, ...residualColumns(config.residual_degree ?? 0)];
  const sections = counts.flatMap((rows, layer) =>
    layeredTypes(config).map((group, i) => {
      return { type: layerType(group, layer), group, layer, rows, columns: columns[i] };
    }),
  );
  for (const group of FIELD_TYPES) {
    const columns = group.endsWith("TAB") ? FEATURES_PER_ROW : 1, field = fieldOf(group);
    const rows = columns === 1 ? decoderSize(config, field) : tableRows(config[field]);
    sections.push({ type: group, group, layer: 0, rows, columns });
  }
  return sections;
};

/**
 * Returns the field that a table or a decoder belongs to.
 * @param {string} type
 * @returns {FieldName}
 */
const fieldOf = (type) => (type.startsWith("G") ? "geometry" : "radiance");

/**
 * Returns the entry of a section.
 * @param {Container} container
 * @param {string} type
 * @returns {Entry}
 * @throws {HyrfFormatError} there is no such section
 */
const requireEntry = (container, type) =>
  container.entries.get(type) ?? rejectDamaged(`there is no section '${type}', so that it is incomplete`);

/**
 * Checks the codec and the size of a section.
 * @param {Container} container
 * @param {ExpectedSection} section
 */
const checkSection = (container, { type, rows, columns }) => {
  const source = sourceOf(container, type), { codec, raw } = requireEntry(source, type);
  explainShared(source, () => {
    if (!PARAMETER_CODECS.includes(codec)) rejectNewer(`section '${type}' has the codec ${codec}, which is unknown`);
    if (raw !== 4 * rows * columns) rejectDamaged(`section '${type}' says another size than the metadata`);
    // The groups of a table would follow from the Gaussians of the other file.
    if (source !== container && codec === CODEC_GROUPS && columns > 1) rejectDamaged(`section '${type}' has codec 8`);
  });
};

/**
 * Decodes a section and checks its numbers.
 * @param {Container} container
 * @param {ExpectedSection} section
 * @param {Config} config
 * @param {LatticePoints[]} points the lattice points of each layer; a section of positions adds its own
 * @returns {Float32Array} (rows x columns), finite
 */
const decodeSection = (container, section, config, points) => {
  const { type } = section, source = sourceOf(container, type), { codec } = requireEntry(source, type);
  const decode = () =>
    decodeStored(source, type, (data) => {
      const numbers = decodeNumbers(section, codec, data, config, points);
      for (let i = 0; i < numbers.length; i++) {
        if (numbers[i] - numbers[i] !== 0) throw new DamagedData("it holds numbers that are not finite");
      }
      return numbers;
    });
  if (source === container) return decode();
  const { geometry, radiance, hidden, direction_encoding } = config; // they determine the section's shape
  return decodeOnce(source, JSON.stringify([type, geometry, radiance, hidden, direction_encoding]), decode);
};

/**
 * Returns what `decode` makes of the stored bytes of a section. Errors name the section.
 * @template Decoded
 * @param {Container} source
 * @param {string} type
 * @param {(data: Uint8Array) => Decoded} decode
 * @returns {Decoded}
 * @throws {HyrfFormatError}
 */
const decodeStored = (source, type, decode) =>
  explainShared(source, () => {
    try {
      return decode(source.stored(type));
    } catch (error) {
      if (!(error instanceof DamagedData)) throw error;
      throw new HyrfFormatError(`Section '${type}' is damaged: ${error.message}; fetch or write the file again.`);
    }
  });

/**
 * Decodes the numbers of a section by its codec.
 * @param {ExpectedSection} section
 * @param {number} codec
 * @param {Uint8Array} data
 * @param {Config} config
 * @param {LatticePoints[]} points
 */
const decodeNumbers = ({ group, layer, rows, columns }, codec, data, config, points) => {
  if (codec === CODEC_FLOAT32) return decodeFloat32(data, rows * columns);
  if (codec === CODEC_FLOAT16) return decodeFloat16(data, rows * columns);
  if (codec === CODEC_VECTORS) return decodeVectors(data, rows, columns);
  if (codec === CODEC_MIN_MAX) return decodeMinMax(data, rows * columns);
  if (codec === CODEC_LATTICE && group === "POSI") {
    points[layer] = decodeLattice(data, rows);
    return latticePositions(points[layer], config.frame.half_extent);
  }
  const isField = FIELD_TYPES.includes(group), isDecoder = isField && columns === 1;
  if (codec === CODEC_GROUPS && isDecoder) return decodeGroups(data, decoderGroups(config, fieldOf(group)));
  if (codec === CODEC_STATED_GROUPS && isField && !isDecoder) {
    const { groups, rest } = readTableGroups(data, config[fieldOf(group)]);
    return decodeGroups(rest, groups);
  }
  const isResidual = RESIDUAL_TYPES.includes(group);
  if (group === "POSI" || codec !== (isField ? CODEC_GROUPS : isResidual ? CODEC_RESIDUALS : CODEC_CHANNELS)) {
    throw new DamagedData(`it cannot have codec ${codec}`);
  }
  if (!points[layer]) throw new DamagedData(`codec ${codec} needs positions of codec ${CODEC_LATTICE}`);
  if (codec === CODEC_RESIDUALS) return decodeResiduals(data, points[layer], columns, group === "HARM");
  if (codec === CODEC_CHANNELS) return decodeChannels(data, points[layer], columns);
  return decodeGroups(data, tableGroups(config[fieldOf(group)], points[0]));
};

/**
 * Returns the array of a decoded section.
 * @param {Map<string, Float32Array>} arrays
 * @param {string} type
 */
const getArray = (arrays, type) => /** @type {Float32Array} */ (arrays.get(type));

/**
 * Concatenates arrays. A single array is returned without a copy.
 * @param {Float32Array[]} parts
 */
const concatenateArrays = (parts) => {
  if (parts.length === 1) return parts[0];
  const joined = new Float32Array(parts.reduce((sum, part) => sum + part.length, 0));
  let place = 0;
  for (const part of parts) {
    joined.set(part, place);
    place += part.length;
  }
  return joined;
};
