// Shapes that follow from a model's configuration: hash grids (docs/format.md 2.3) and decoders (2.4).

/**
 * A hash grid, as the metadata has it.
 * @typedef {{log2_table_size: number, levels: number, base: number, finest: number}} Grid
 *
 * A level of a hash grid: vertices an axis, rows of the table, the first of them, and whether each vertex has its own.
 * @typedef {{resolution: number, rows: number, first: number, dense: boolean}} GridLevel
 *
 * A layer of a decoder: where its matrix (outputs x inputs, row by row) and its bias begin in the decoder's numbers.
 * @typedef {{inputs: number, outputs: number, matrix: number, bias: number}} DecoderLayer
 *
 * What decides a decoder's shape.
 * @typedef {{geometry: Grid, radiance: Grid, hidden: number, direction_encoding: string}} DecoderConfig
 *
 * @typedef {"geometry" | "radiance"} FieldName
 */

/** Numbers of a row of a hash table. */
export const ROW_FEATURES = 2;

/** Numbers that each encoding makes of a direction.
 * @type {Record<string, number>} */
export const DIRECTION_FEATURES = { sh: 9, frequency: 24 };

/** Factors of y and z in the spatial hash, as signed 32-bit numbers: Math.imul wraps around as the hash wants. */
export const HASH_Y = 2654435761 | 0;
export const HASH_Z = 805459861;

/**
 * The levels of a grid, in the order of the table.
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
 * Rows of a grid's whole table.
 * @param {Grid} grid
 */
export const tableRows = (grid) => gridLevels(grid).reduce((sum, { rows }) => sum + rows, 0);

/**
 * The three layers of a field's decoder.
 * @param {DecoderConfig} config
 * @param {FieldName} which
 * @returns {DecoderLayer[]}
 */
export const decoderLayout = (config, which) => {
  const directions = which === "radiance" ? DIRECTION_FEATURES[config.direction_encoding] : 0;
  const widths = [config[which].levels * ROW_FEATURES + directions, config.hidden, config.hidden];
  let place = 0;
  return [config.hidden, config.hidden, which === "radiance" ? 3 : 8].map((outputs, layer) => {
    const inputs = widths[layer], matrix = place, bias = matrix + inputs * outputs;
    place = bias + outputs;
    return { inputs, outputs, matrix, bias };
  });
};

/**
 * How many numbers a field's decoder has.
 * @param {DecoderConfig} config
 * @param {FieldName} which
 */
export const decoderSize = (config, which) => {
  const { bias, outputs } = decoderLayout(config, which)[2];
  return bias + outputs;
};
