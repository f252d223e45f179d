import { RowStates } from "./row_states.js";
/** The number of Gaussians of a row, which are evaluated together. */
export declare const GAUSSIANS_PER_ROW = 2048;
/** The number of floats that describe the shape of a Gaussian: its position and three axes. */
export declare const FLOATS_PER_SHAPE = 12;
export declare const FLOATS_PER_COLOR = 4;
export type Model = import("./reader.js").Model;
export type View = import("./frustum.js").View;
export type EvaluatedRow = {
    row: number;
    shapes: Float32Array | null;
    pixelSizes: Float32Array | null;
    colors: Float32Array;
};
export type SkyTile = {
    isCoarse: boolean;
    x: number;
    y: number;
    width: number;
    height: number;
    pixels: Uint8Array;
};
export type SkySize = {
    width: number;
    height: number;
    coarseWidth: number;
    coarseHeight: number;
};
/**
 * @typedef {import("./reader.js").Model} Model
 * @typedef {import("./frustum.js").View} View
 *
 * A row of Gaussians, of which the first has the index GAUSSIANS_PER_ROW times `row`. `shapes` has FLOATS_PER_SHAPE
 * numbers for each: its position, and its three axes, each with the length of the standard deviation, in local units.
 * `pixelSizes` has the pixel size of the photos at each, in local units, or 0 (see sampling.js). Both are null if they
 * were delivered before. `colors` has red, green, blue and opacity of each, in [0, 1]; colours with residuals may
 * exceed 1.
 * @typedef {{row: number, shapes: Float32Array | null, pixelSizes: Float32Array | null, colors: Float32Array}}
 *   EvaluatedRow
 *
 * A part of the equirectangular picture of the background: its place and its RGBA bytes. Column c of a picture with
 * height h is at the longitude (c + 0.5) pi / h - pi, row r at the latitude pi / 2 - (r + 0.5) pi / h. Longitudes run
 * from +z to +x, latitudes to -y, in local axes. `isCoarse` is true for the small picture, which comes first.
 * @typedef {{isCoarse: boolean, x: number, y: number, width: number, height: number, pixels: Uint8Array}} SkyTile
 *
 * The size of the background's picture and of its coarse version.
 * @typedef {{width: number, height: number, coarseWidth: number, coarseHeight: number}} SkySize
 */
/**
 * Returns the size of the background's picture, or null if the model has no background.
 * @param {import("./metadata.js").Metadata} metadata
 * @returns {SkySize | null}
 */
export declare function skySize(metadata: import("./metadata.js").Metadata): SkySize | null;
/** A model, and which of its rows and of the tiles of its background were evaluated from which viewpoint. */
export declare class ViewEvaluator {
    model: import("./reader.js").Model;
    rows: RowStates;
    pixelSizes: Float32Array<ArrayBufferLike>;
    opacities: Float32Array<ArrayBuffer>;
    /** @type {(Float32Array | null)[]} */
    firstLayers: (Float32Array | null)[];
    sky: SkySize | null;
    tiles: Tile[];
    tileStates: RowStates;
    hasCoarseSky: boolean;
    /**
     * @param {Model} model
     * @param {boolean} [withSky] whether its background is evaluated, if it has one
     */
    constructor(model: Model, withSky?: boolean);
    /**
     * Evaluates, one at a time, what a view needs: first what is in view and was never evaluated, then what has changed
     * most, and in the end everything at this very viewpoint. Rows out of view come last, after `onComplete` was called.
     * @param {View} view in local units
     * @param {() => void} onComplete called when everything in view is evaluated at the viewpoint
     * @returns {Generator<EvaluatedRow | SkyTile, void>}
     */
    evaluate(view: View, onComplete: () => void): Generator<EvaluatedRow | SkyTile, void>;
    /**
     * Evaluates a row of Gaussians.
     * @param {number} row
     * @param {number[]} eye
     * @returns {EvaluatedRow}
     */
    row(row: number, eye: number[]): EvaluatedRow;
    /**
     * Evaluates a part of the background.
     * @param {Tile} tile
     * @param {number[]} eye
     * @returns {SkyTile}
     */
    skyTile({ isCoarse, x, y, width, height, pictureHeight }: Tile, eye: number[]): SkyTile;
}
export type Tile = {
    isCoarse: boolean;
    x: number;
    y: number;
    width: number;
    height: number;
    pictureHeight: number;
    ball: number[];
};
