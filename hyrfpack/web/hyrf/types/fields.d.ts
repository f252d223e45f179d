export declare const BACKGROUND_RADIUS = 100;
export type Layer = {
    inputs: number;
    width: number;
    stride: number;
    weights: Float64Array;
    biases: Float64Array;
    index: Int32Array;
    value: Float64Array;
};
export type PreparedField = {
    levels: import("./grids.js").GridLevel[];
    table: Float32Array;
    encoding: string;
    first: Layer;
    directional: Layer;
    middle: Layer;
    last: Layer;
    places: Float64Array;
    radii: Float64Array;
    features: Float64Array;
    encoded: Float64Array;
    hidden: Float64Array;
    hidden2: Float64Array;
    outputs: Float64Array;
};
export type Model = import("./reader.js").Model;
export type FieldName = import("./grids.js").FieldName;
/**
 * Evaluates the geometry field: opacities, scales and rotations of Gaussians `start` to `stop`.
 * @param {Model} model
 * @param {number} start the index of the first Gaussian
 * @param {number} stop the index after the last Gaussian
 * @returns {{opacities: Float32Array, scales: Float32Array, quats: Float32Array}} opacities (n) in [0, 1]; scales
 *   (3 n), standard deviations in local units; quaternions (4 n), wxyz of unit length
 */
export declare function decodeGeometry(model: Model, start: number, stop: number): {
    opacities: Float32Array;
    scales: Float32Array;
    quats: Float32Array;
};
/**
 * Evaluates the view-independent part of the colour decoder's first layer, before its ReLU, for `colorsAlong`.
 * @param {Model} model
 * @param {number} start the index of the first Gaussian
 * @param {number} stop the index after the last Gaussian
 * @returns {Float32Array} `config.hidden` numbers for each Gaussian
 */
export declare function firstLayers(model: Model, start: number, stop: number): Float32Array;
/**
 * Evaluates the colours of Gaussians `start` to `stop` along given directions.
 * @param {Model} model
 * @param {Float32Array} layers from `firstLayers`, of the same Gaussians
 * @param {number} start the index of the first Gaussian
 * @param {number} stop the index after the last Gaussian
 * @param {Float32Array} directions 3 n: unit vectors from the viewpoint to each Gaussian
 * @returns {Float32Array} 3 n, 0 or more, and at most 1 without residuals
 */
export declare function colorsAlong(model: Model, layers: Float32Array, start: number, stop: number, directions: Float32Array): Float32Array;
/**
 * Evaluates colours of selected Gaussians along given directions. A Gaussian may be selected repeatedly.
 * @param {Model} model
 * @param {Float32Array} layers from `firstLayers`
 * @param {number} start the first Gaussian of `layers`
 * @param {Int32Array} rows n: the selected Gaussians, counted from `start`
 * @param {Float32Array} directions 3 n or more: a unit vector from the viewpoint for each selected Gaussian
 * @param {Float32Array} colors 3 n or more, overwritten
 * @returns {Float32Array} `colors`
 */
export declare function colorsOfRows(model: Model, layers: Float32Array, start: number, rows: Int32Array, directions: Float32Array, colors: Float32Array): Float32Array;
/**
 * Evaluates the colours of the background sphere.
 * @param {Model} model
 * @param {Float32Array} places 3 n: points on the sphere, local units
 * @param {Float32Array} directions 3 n: unit vectors from the viewpoint to these points
 * @returns {Float32Array} 3 n in [0, 1]
 */
export declare function backgroundColors(model: Model, places: Float32Array, directions: Float32Array): Float32Array;
