import { DepthSort } from "./sort.js";
import { ViewEvaluator } from "./view_evaluator.js";
export type View = import("./frustum.js").View;
export type Place = import("./places.js").Place;
export type EvaluatedRow = import("./view_evaluator.js").EvaluatedRow;
export type SkyTile = import("./view_evaluator.js").SkyTile;
export type Part = {
    evaluator: ViewEvaluator;
    place: Place;
    firstRow: number;
    rowCount: number;
};
/**
 * @typedef {import("./frustum.js").View} View
 * @typedef {import("./places.js").Place} Place
 * @typedef {import("./view_evaluator.js").EvaluatedRow} EvaluatedRow
 * @typedef {import("./view_evaluator.js").SkyTile} SkyTile
 *
 * A model of a merged file: its place in the scene, its first row and its number of rows.
 * @typedef {{evaluator: ViewEvaluator, place: Place, firstRow: number, rowCount: number}} Part
 */
export declare class MergedEvaluator {
    /** The number of rows. */
    rowCount: number;
    /** @type {Part[]} */
    parts: Part[];
    sorter: DepthSort;
    sky: import("./view_evaluator.js").SkySize | null;
    /** @param {import("./index.js").Model[]} models */
    constructor(models: import("./index.js").Model[]);
    /**
     * Sorts the Gaussians by their depth in a view.
     * @param {View} view in local units
     * @param {Uint32Array | null} spare an earlier order, to be overwritten
     */
    sort(view: View, spare: Uint32Array | null): {
        order: Uint32Array;
        drawn: number;
    };
    /**
     * See ViewEvaluator. What is in view of all models comes first.
     * @param {View} view
     * @param {() => void} onComplete
     * @returns {Generator<EvaluatedRow | SkyTile, void>}
     */
    evaluate(view: View, onComplete: () => void): Generator<EvaluatedRow | SkyTile, void>;
}
