export type Grid = {
    log2_table_size: number;
    levels: number;
    base: number;
    finest: number;
};
export type GridLevel = {
    resolution: number;
    rows: number;
    first: number;
    dense: boolean;
};
export type DecoderLayer = {
    inputs: number;
    outputs: number;
    matrix: number;
    bias: number;
};
export type DecoderConfig = {
    geometry: Grid;
    radiance: Grid;
    hidden: number;
    direction_encoding: string;
};
export type FieldName = "geometry" | "radiance";
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
export declare const FEATURES_PER_ROW = 2;
/**
 * The number of features of an encoded direction, by encoding.
 * @type {Record<string, number>}
 */
export declare const FEATURES_PER_DIRECTION: Record<string, number>;
/** Factors of y and z in the spatial hash, as signed 32-bit integers, because Math.imul wraps modulo 2^32. */
export declare const HASH_FACTOR_Y: number;
export declare const HASH_FACTOR_Z = 805459861;
/**
 * Returns the levels of a grid, from the coarsest to the finest, as they follow each other in its table.
 * @param {Grid} grid
 * @returns {GridLevel[]}
 */
export declare const gridLevels: ({ log2_table_size, levels, base, finest }: Grid) => GridLevel[];
/**
 * Returns the number of rows of a grid's table.
 * @param {Grid} grid
 */
export declare const tableRows: (grid: Grid) => number;
/**
 * Returns the three layers of a field's decoder.
 * @param {DecoderConfig} config
 * @param {FieldName} field
 * @returns {DecoderLayer[]}
 */
export declare const decoderLayout: (config: DecoderConfig, field: FieldName) => DecoderLayer[];
/**
 * Returns the number of weights and biases of a field's decoder.
 * @param {DecoderConfig} config
 * @param {FieldName} field
 */
export declare const decoderSize: (config: DecoderConfig, field: FieldName) => number;
