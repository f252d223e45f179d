export type Place = {
    rows: number[][];
    scale: number;
    shift: number[];
};
export type View = import("./frustum.js").View & {
    eye?: number[];
};
/**
 * Where a part lies: `rows` are those of the rotation from the part's local axes to those of the scene.
 * @typedef {{rows: number[][], scale: number, shift: number[]}} Place
 *
 * @typedef {import("./frustum.js").View & {eye?: number[]}} View
 */
/** The place of the scene itself. @type {Place} */
export declare const IDENTITY_PLACE: Place;
/**
 * Returns the place of a part in the local units of the scene.
 * @param {import("./metadata.js").Frame} own the frame of the part
 * @param {import("./metadata.js").Frame} scene the frame of the scene
 * @returns {Place}
 */
export declare function placeOf(own: import("./metadata.js").Frame, scene: import("./metadata.js").Frame): Place;
/**
 * Returns a view of the scene in the axes and units of a part.
 * @template {View} SceneView
 * @param {SceneView} view
 * @param {Place} place
 * @returns {SceneView}
 */
export declare function viewFromPlace<SceneView extends View>(view: SceneView, { rows, scale, shift }: Place): SceneView;
/**
 * Returns positions (3 N) of a part in the scene's units: the same array if the part is the scene.
 * @param {Float32Array} positions
 * @param {Place} place
 */
export declare function movePositions(positions: Float32Array, place: Place): Float32Array<ArrayBufferLike>;
