export type Grid = import("./grids.js").Grid;
export type DecoderConfig = import("./grids.js").DecoderConfig;
export type FieldName = import("./grids.js").FieldName;
export type LatticePoints = import("./lattice.js").LatticePoints;
export type NumberGroups = {
    index: Uint16Array;
    count: number;
    width: number;
};
/**
 * Returns the groups of a decoder's numbers. Each layer has a group for the weights of each output, and then a group
 * for all biases.
 * @param {DecoderConfig} config
 * @param {FieldName} which
 * @returns {NumberGroups}
 */
export declare const decoderGroups: (config: DecoderConfig, which: FieldName) => NumberGroups;
/**
 * Returns the groups of a table's rows. Rows are grouped by their level and by the number of times that points read
 * them.
 * @param {Grid} grid
 * @param {LatticePoints} points the positions of the first layer's Gaussians
 * @returns {NumberGroups}
 */
export declare const tableGroups: (grid: Grid, points: LatticePoints) => NumberGroups;
/**
 * Reads the groups of a table's rows, which codec 11 states before the numbers.
 * @param {Uint8Array} data
 * @param {Grid} grid
 * @returns {{groups: NumberGroups, rest: Uint8Array}} `rest` is for `decodeGroups`
 * @throws {DamagedData} a length or a group is invalid
 */
export declare const readTableGroups: (data: Uint8Array, grid: Grid) => {
    groups: NumberGroups;
    rest: Uint8Array;
};
/**
 * Decodes numbers in groups.
 * @param {Uint8Array} data
 * @param {NumberGroups} groups
 * @returns {Float32Array} (rows x width), row by row; 0 where a group has no step
 * @throws {DamagedData} a length or a number is invalid
 */
export declare const decodeGroups: (data: Uint8Array, { index, count, width }: NumberGroups) => Float32Array;
