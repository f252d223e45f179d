/** The number of harmonics of degree 1 and higher, by the largest degree. */
export declare const HIGHER_HARMONICS_BY_DEGREE: number[];
export type Splats = {
    count: number;
    degree: number;
    antialiased: boolean;
    center: number[];
    unit: number;
    rotation?: number[];
    positions: Float32Array;
    scales: Float32Array;
    quats: Float32Array;
    opacities: Float32Array;
    colors: Float32Array;
    harmonics: Uint8Array;
    range: number;
};
export type LocalCamera = {
    place: number[];
    rows: number[][];
    translation: number[];
    bounds: number[];
    focal: number;
    area: number;
};
export type Model = import("./reader.js").Model;
/**
 * Explicit splats in local axes. The world position of a point p is `center` + `unit` R p, with the rotation R of the
 * quaternion `rotation` (wxyz; absent: the axes are the world's). The colour along the unit vector d is max(0, `colors`
 * + sum over k > 0 of Y_k(d) harmonic_k).
 * @typedef {{
 *   count: number,
 *   degree: number,
 *   antialiased: boolean,
 *   center: number[],
 *   unit: number,
 *   rotation?: number[],
 *   positions: Float32Array,
 *   scales: Float32Array,
 *   quats: Float32Array,
 *   opacities: Float32Array,
 *   colors: Float32Array,
 *   harmonics: Uint8Array,
 *   range: number,
 * }} Splats For each Gaussian: position and scales (standard deviations) in units of `unit`; the rotation, wxyz of unit
 *   length; the opacity in [0, 1]; the colour; RGB of each higher harmonic, (byte - 128) / 128 * range
 *
 * A camera in a model's local units, at `place`. `bounds` are the minimum and maximum of x / z, then of y / z, that
 * count as visible; `focal` is the product of both focal lengths in pixels; `area` is the picture's number of pixels.
 * @typedef {{place: number[], rows: number[][], translation: number[], bounds: number[], focal: number, area: number}}
 *   LocalCamera
 *
 * @typedef {import("./reader.js").Model} Model
 */
/**
 * Converts a model to splats with the model's shapes and opacities. The harmonics h of each Gaussian minimise, over the
 * cameras v that see it,
 *
 *     sum_v w_v |f(d_v) - color(d_v)|^2 + s mean_s |f(d_s) - color(d_s)|^2 + r sum_{k > 0} |h_k|^2
 *
 * where s is SPHERE_TOTAL_WEIGHT, r is RIDGE_WEIGHT, w_v is proportional to the Gaussian's area in the picture of v,
 * sum_v w_v = 1, and the directions d_s cover the sphere evenly. Occlusion is ignored.
 *
 * @param {Model} model
 * @param {import("./viewpoint.js").Camera[]} viewpoints cameras in world units; if empty, only the sphere is fitted
 * @param {number} degree of the harmonics, 0 to 3
 * @param {(progress: {done: number, splats: Splats, coarse: boolean}) => unknown} [report] called and awaited after
 *   each block, with the fraction `done` in [0, 1] and the splats so far. `coarse` is true in one call, unless the
 *   model is empty: then all Gaussians are present, with their colours from the first viewpoint. An exception that
 *   `report` throws ends the conversion.
 * @returns {Promise<Splats>}
 * @throws {HyrfFormatError} a shape or a colour is NaN or infinite
 * @throws {RangeError} `degree` is not 0, 1, 2 or 3
 */
export declare function fitHarmonics(model: Model, viewpoints: import("./viewpoint.js").Camera[], degree: number, report?: (progress: {
    done: number;
    splats: Splats;
    coarse: boolean;
}) => unknown): Promise<Splats>;
/**
 * Chooses the largest magnitude of harmonics that can be stored: a high quantile, so that few are clipped and steps are
 * fine.
 * @param {number[]} sizes the magnitudes of a sample of harmonics
 * @returns {number}
 */
export declare function chooseHarmonicsRange(sizes: number[]): number;
