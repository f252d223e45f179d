// The model out of the bytes of a `.hyrf` file, versions 1.0 to 1.2 (docs/format.md).

import { decodeChannels } from "./channels.js";
import { Container, EXPOSURE_TYPE, FIELD_TYPES, LAYERED_TYPES, incompleteFile, layerType } from "./container.js";
import { DamagedData, HyrfFormatError, damagedFile, newerFile } from "./errors.js";
import { decodeExposure } from "./exposure.js";
import { ROW_FEATURES, decoderSize, tableRows } from "./grids.js";
import { decodeGroups, decoderGroups, tableGroups } from "./groups.js";
import { decodeLattice, latticePositions } from "./lattice.js";
import { readMetadata } from "./metadata.js";
import { decodeFloat16, decodeFloat32, decodeMinMax, decodeVectors } from "./plain.js";

export { HyrfFormatError };

// Gaussians that a file may have: so many for each of its bytes, and some that are free.
const GAUSSIANS_A_BYTE = 32, FREE_GAUSSIANS = 2 ** 18;

/**
 * @typedef {import("./container.js").Entry} Entry
 * @typedef {import("./exposure.js").ExposureMap} ExposureMap
 * @typedef {import("./grids.js").FieldName} FieldName
 * @typedef {import("./lattice.js").LatticePoints} LatticePoints
 * @typedef {import("./metadata.js").Config} Config
 * @typedef {import("./metadata.js").Metadata} Metadata
 *
 * A field: its hash table (rows x 2) and the numbers of its decoder. See `gridLevels` and `decoderLayout`.
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
 *   geometry: Field,
 *   radiance: Field,
 *   exposure: ExposureMap | null,
 * }} Model `exposure`: how exposure varies with the viewpoint, null where the file does not say; see `logGains`
 *
 * @typedef {{
 *   version: [number, number],
 *   length: number,
 *   sections: {type: string, codec: number, offset: number, stored: number, raw: number}[],
 *   firstLayer: number,
 * }} Description
 *
 * A section to be decoded: what it is called in the first layer, and its matrix.
 * @typedef {{type: string, group: string, layer: number, rows: number, columns: number}} WantedSection
 */

const CODEC_FLOAT32 = 1, CODEC_FLOAT16 = 2, CODEC_VECTORS = 3, CODEC_MIN_MAX = 4;
const CODEC_LATTICE = 6, CODEC_CHANNELS = 7, CODEC_GROUPS = 8, CODEC_EXPOSURE = 9;
const KNOWN_CODECS = [CODEC_FLOAT32, CODEC_FLOAT16, CODEC_VECTORS, CODEC_MIN_MAX];
KNOWN_CODECS.push(CODEC_LATTICE, CODEC_CHANNELS, CODEC_GROUPS);
const LAYERED_COLUMNS = [3, 3, 1, 1];

/**
 * What a file holds, from its first bytes: header and table of contents are enough.
 * @param {Uint8Array} bytes the start of a file, or all of it
 * @returns {Description} `firstLayer`: so many bytes of the file make a model, if only a coarse one
 * @throws {HyrfFormatError}
 */
export const describe = (bytes) => {
  const container = new Container(bytes, true);
  let firstLayer = 0;
  for (const type of ["META", ...LAYERED_TYPES, ...FIELD_TYPES]) {
    firstLayer = Math.max(firstLayer, entryOf(container, type).end);
  }
  const sections = [...container.entries.values()].map(({ type, codec, offset, stored, raw }) => {
    return { type, codec, offset, stored, raw };
  });
  return { version: container.version, length: container.length, sections, firstLayer };
};

/**
 * Decode a file.
 * @param {Uint8Array} bytes
 * @param {{partial?: boolean}} [options] `partial`: the start of a file will do, for a model of the layers in it
 * @returns {Promise<Model>}
 * @throws {HyrfFormatError}
 */
export const read = async (bytes, { partial = false } = {}) => {
  try {
    return readModel(new Container(bytes, partial));
  } catch (error) {
    if (!(error instanceof RangeError)) throw error;
    throw new HyrfFormatError("The model takes more memory than there is; open a smaller one.");
  }
};

/**
 * @param {Container} container
 * @returns {Model}
 */
const readModel = (container) => {
  const metadata = readMetadata(container);
  const { config } = metadata;
  const counts = metadata.layers?.length ? metadata.layers : [metadata.gaussians];
  const sections = wantedSections(config, counts);
  sections.forEach((section) => checkSection(container, section)); // all, before the first is decoded
  let there = 1;
  while (there < counts.length && LAYERED_TYPES.every((type) => container.has(layerType(type, there)))) there++;
  const wanted = sections.filter(({ layer }) => layer < there);
  if (!wanted.every(({ type }) => container.has(type))) {
    incompleteFile(container, Math.max(...wanted.map(({ type }) => entryOf(container, type).end)));
  }

  const layers = counts.slice(0, there), count = layers.reduce((sum, each) => sum + each, 0);
  if (count > GAUSSIANS_A_BYTE * container.bytes.length + FREE_GAUSSIANS) {
    damagedFile(`it says ${count} Gaussians, too many for its bytes`);
  }

  /** @type {Map<string, Float32Array>} */
  const arrays = new Map();
  /** @type {LatticePoints[]} */
  const points = []; // of each layer that has its positions on a lattice
  for (const section of wanted) arrays.set(section.type, decodeSection(container, section, config, points));

  /** @param {string} type */
  const joined = (type) => joinedArrays(layers.map((_, layer) => arrayOf(arrays, layerType(type, layer))));
  const [positions, colorLogits, scaleLogits, opacityLogits] = LAYERED_TYPES.map(joined);
  return {
    metadata,
    config,
    count,
    layers,
    whole: there === counts.length,
    positions,
    colorLogits,
    scaleLogits,
    opacityLogits,
    geometry: { table: arrayOf(arrays, "GTAB"), decoder: arrayOf(arrays, "GMLP") },
    radiance: { table: arrayOf(arrays, "RTAB"), decoder: arrayOf(arrays, "RMLP") },
    exposure: readExposure(container),
  };
};

/**
 * The exposure map, null where the file has none or its bytes are not there yet.
 * @param {Container} container
 * @returns {ExposureMap | null}
 */
const readExposure = (container) => {
  if (!container.has(EXPOSURE_TYPE)) return null;
  const { codec, raw } = entryOf(container, EXPOSURE_TYPE);
  if (codec !== CODEC_EXPOSURE) newerFile(`section '${EXPOSURE_TYPE}' has the codec ${codec}, which is unknown`);
  return decodeNamed(EXPOSURE_TYPE, () => decodeExposure(container.stored(EXPOSURE_TYPE), raw));
};

/**
 * All sections that a model must have but the metadata; positions come before what leans on them.
 * @param {Config} config
 * @param {number[]} counts of the layers
 * @returns {WantedSection[]}
 */
const wantedSections = (config, counts) => {
  const sections = counts.flatMap((rows, layer) =>
    LAYERED_TYPES.map((group, i) => {
      return { type: layerType(group, layer), group, layer, rows, columns: LAYERED_COLUMNS[i] };
    }),
  );
  for (const group of FIELD_TYPES) {
    const columns = group.endsWith("TAB") ? ROW_FEATURES : 1, field = fieldOf(group);
    const rows = columns === 1 ? decoderSize(config, field) : tableRows(config[field]);
    sections.push({ type: group, group, layer: 0, rows, columns });
  }
  return sections;
};

/**
 * The field that a table or decoder is of.
 * @param {string} type
 * @returns {FieldName}
 */
const fieldOf = (type) => (type.startsWith("G") ? "geometry" : "radiance");

/**
 * @param {Container} container
 * @param {string} type
 * @returns {Entry}
 */
const entryOf = (container, type) =>
  container.entries.get(type) ?? damagedFile(`there is no section '${type}', so that it is incomplete`);

/**
 * @param {Container} container
 * @param {WantedSection} section
 */
const checkSection = (container, { type, rows, columns }) => {
  const { codec, raw } = entryOf(container, type);
  if (!KNOWN_CODECS.includes(codec)) newerFile(`section '${type}' has the codec ${codec}, which is unknown`);
  if (raw !== 4 * rows * columns) damagedFile(`section '${type}' says another size than the metadata`);
};

/**
 * @param {Container} container
 * @param {WantedSection} section
 * @param {Config} config
 * @param {LatticePoints[]} points of each layer, added to
 * @returns {Float32Array} (rows x columns), finite
 */
const decodeSection = (container, section, config, points) => {
  const { type } = section, { codec } = entryOf(container, type);
  const data = container.stored(type);
  return decodeNamed(type, () => {
    const numbers = decodeNumbers(section, codec, data, config, points);
    for (let i = 0; i < numbers.length; i++) {
      if (numbers[i] - numbers[i] !== 0) throw new DamagedData("it holds numbers that are not finite");
    }
    return numbers;
  });
};

/**
 * What `decode` returns; an error about damaged data gets the section's name.
 * @template Decoded
 * @param {string} type
 * @param {() => Decoded} decode
 * @returns {Decoded}
 * @throws {HyrfFormatError}
 */
const decodeNamed = (type, decode) => {
  try {
    return decode();
  } catch (error) {
    if (!(error instanceof DamagedData)) throw error;
    throw new HyrfFormatError(`Section '${type}' is damaged: ${error.message}; fetch or write the file again.`);
  }
};

/**
 * @param {WantedSection} section
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
  if (group === "POSI" || codec !== (isField ? CODEC_GROUPS : CODEC_CHANNELS)) {
    throw new DamagedData(`it cannot have codec ${codec}`);
  }
  if (!points[layer]) throw new DamagedData(`codec ${codec} needs positions of codec ${CODEC_LATTICE}`);
  if (codec === CODEC_CHANNELS) return decodeChannels(data, points[layer], columns);
  return decodeGroups(data, tableGroups(config[fieldOf(group)], points[0]));
};

/**
 * @param {Map<string, Float32Array>} arrays
 * @param {string} type
 */
const arrayOf = (arrays, type) => /** @type {Float32Array} */ (arrays.get(type));

/** @param {Float32Array[]} parts */
const joinedArrays = (parts) => {
  if (parts.length === 1) return parts[0];
  const joined = new Float32Array(parts.reduce((sum, part) => sum + part.length, 0));
  let place = 0;
  for (const part of parts) {
    joined.set(part, place);
    place += part.length;
  }
  return joined;
};
