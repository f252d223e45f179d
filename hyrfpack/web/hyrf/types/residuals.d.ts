export type LatticePoints = import("./lattice.js").LatticePoints;
/** @typedef {import("./lattice.js").LatticePoints} LatticePoints */
/** The number of shape residuals of a Gaussian: two of its scale logits, three of its rotation. */
export declare const SHAPE_RESIDUALS = 5;
/**
 * Returns the number of residuals of a Gaussian in the sections of shapes and of colours.
 * @param {number} degree of the harmonics
 */
export declare const residualColumns: (degree: number) => number[];
/**
 * Decodes a section of residuals.
 * @param {Uint8Array} data the bytes of the section
 * @param {LatticePoints} points the positions of the same Gaussians
 * @param {number} columns
 * @param {boolean} isColor whether they correct colours
 * @returns {Float32Array} (N x columns), row by row
 * @throws {DamagedData} a length, a header or a number is invalid
 */
export declare const decodeResiduals: (data: Uint8Array, { classes, count }: LatticePoints, columns: number, isColor: boolean) => Float32Array;
/**
 * Corrects the outputs of the geometry field for a Gaussian: opacity, three scales, rotation wxyz.
 * @param {Float64Array} outputs
 * @param {number} at the index of the first output
 * @param {Float32Array} residuals
 * @param {number} from the index of the Gaussian's first residual
 */
export declare const addShapeResiduals: (outputs: Float64Array, at: number, residuals: Float32Array, from: number) => void;
/** Corrects colours by the residuals of a model. */
export declare class ColorResiduals {
    residuals: Float32Array<ArrayBufferLike>;
    degree: number;
    basis: Float64Array<ArrayBuffer>;
    /**
     * @param {Float32Array} residuals
     * @param {number} degree of the harmonics
     */
    constructor(residuals: Float32Array, degree: number);
    /**
     * Returns a channel of a colour with the residuals, after `turn`.
     * @param {number} color
     * @param {number} gaussian the index of the Gaussian
     * @param {number} channel 0 to 2
     */
    corrected(color: number, gaussian: number, channel: number): number;
    /**
     * Evaluates the harmonics along a direction, for the next calls of `corrected`.
     * @param {Float32Array} directions
     * @param {number} at the index of the direction's x
     */
    turn(directions: Float32Array, at: number): void;
}
