// Computes the shapes of hash grids (docs/reference/format.md 2.3) and decoders (2.4) from a model's configuration.

/**
 * A hash grid, with the keys of the metadata. `base` and `finest` are the resolutions of its first and last level.
 * @typedef {{log2_table_size: number, levels: number, base: number, finest: number}} Grid
 *
 * A level of a hash grid: `resolution` is the number of vertices along an axis; `rows` is the number of its table rows
 * and `first` the index of the first one; `dense` is true if each vertex has a row of its own.
 * @typedef {{resolution: number, rows: number, first: number, dense: boolean}} GridLevel
 *
 * A layer of a decoder. `matrix` and `bias` are the offsets of its matrix (outputs x inputs, row by row) and its bias
 * in the decoder's numbers.
 * @typedef {{inputs: number, outputs: number, matrix: number, bias: number}} DecoderLayer
 *
 * The part of a configuration that determines a decoder's shape.
 * @typedef {{geometry: Grid, radiance: Grid, hidden: number, direction_encoding: string}} DecoderConfig
 *
 * @typedef {"geometry" | "radiance"} FieldName
 */

/** The number of features in a row of a hash table. */
export const FEATURES_PER_ROW = 2;

/**
 * The number of features of an encoded direction, by encoding.
 * @type {Record<string, number>}
 */
export const FEATURES_PER_DIRECTION = { sh: 9, frequency: 24 };

/** Factors of y and z in the spatial hash, as signed 32-bit integers, because Math.imul wraps modulo 2^32. */
export const HASH_FACTOR_Y = 2654435761 | 0;
export const HASH_FACTOR_Z = 805459861;

/**
 * Returns the levels of a grid, from the coarsest to the finest, as they follow each other in its table.
 * @param {Grid} grid
 * @returns {GridLevel[]}
 */
export const gridLevels = ({ log2_table_size, levels, base, finest }) => {
  const growth = (finest / base) ** (1 / Math.max(levels - 1, 1));
  const result = [];
  for (let level = 0, first = 0; level < levels; level++) {
    const resolution = Math.ceil(base * growth ** level - 1e-6);
    const dense = resolution ** 3 <= 2 ** log2_table_size;
    const rows = dense ? resolution ** 3 : 2 ** log2_table_size;
    result.push({ resolution, rows, first, dense });
    first += rows;
  }
  return result;
};

/**
 * Returns the number of rows of a grid's table.
 * @param {Grid} grid
 */
export const tableRows = (grid) => gridLevels(grid).reduce((sum, { rows }) => sum + rows, 0);

/**
 * Returns the three layers of a field's decoder.
 * @param {DecoderConfig} config
 * @param {FieldName} field
 * @returns {DecoderLayer[]}
 */
export const decoderLayout = (config, field) => {
  const directions = field === "radiance" ? FEATURES_PER_DIRECTION[config.direction_encoding] : 0;
  const widths = [config[field].levels * FEATURES_PER_ROW + directions, config.hidden, config.hidden];
  let offset = 0;
  return [config.hidden, config.hidden, field === "radiance" ? 3 : 8].map((outputs, layer) => {
    const inputs = widths[layer], matrix = offset, bias = matrix + inputs * outputs;
    offset = bias + outputs;
    return { inputs, outputs, matrix, bias };
  });
};

/**
 * Returns the number of weights and biases of a field's decoder.
 * @param {DecoderConfig} config
 * @param {FieldName} field
 */
export const decoderSize = (config, field) => {
  const { bias, outputs } = decoderLayout(config, field)[2];
  return bias + outputs;
};
