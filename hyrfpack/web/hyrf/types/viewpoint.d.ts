export type Camera = {
    width: number;
    height: number;
    fx: number;
    fy: number;
    cx: number;
    cy: number;
    camera_from_world: number[][];
};
export type Viewpoint = {
    target: number[];
    up: number[];
    camera: Camera;
    arc: number[];
};
/**
 * A pinhole camera as files store it: OpenCV axes, pixels, world units.
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number,
 *   camera_from_world: number[][]}} Camera
 *
 * A view of a model: the point that it looks at, the up direction, a camera, and the range of angles about `up`, in
 * degrees from that camera, that the photos cover.
 * @typedef {{target: number[], up: number[], camera: Camera, arc: number[]}} Viewpoint
 */
/**
 * Chooses the cameras for showing a model.
 * @param {import("./metadata.js").Metadata} metadata the checked metadata of the model
 * @returns {{cameras: Camera[], fitted: Camera[], up: number[], target: number[], madeUp: boolean}} `cameras`, at least
 *   one, are those of a viewer, which starts at the first; `fitted` are those at which colours are fitted; `up` is a
 *   unit vector in world axes; `target` is the point that the viewer looks at, in world units; `madeUp` is true if the
 *   file has no usable cameras
 */
export declare function viewpointOf(metadata: import("./metadata.js").Metadata): {
    cameras: Camera[];
    fitted: Camera[];
    up: number[];
    target: number[];
    madeUp: boolean;
};
/**
 * Selects at most `count` evenly spaced items, which include the first and the last one.
 * @template Item
 * @param {Item[]} items
 * @param {number} count
 * @returns {Item[]}
 */
export declare function evenlySpaced<Item>(items: Item[], count: number): Item[];
/**
 * Returns the position of a camera in world units.
 * @param {Camera} camera
 * @returns {number[]}
 */
export declare const cameraPosition: ({ camera_from_world: pose }: Camera) => number[];
/**
 * Converts a camera to a view in a model's local units, with the position of its eye.
 * @param {Camera} camera
 * @param {import("./metadata.js").Frame} frame
 * @returns {import("./frustum.js").View & {eye: number[]}}
 */
export declare function toLocalView(camera: Camera, frame: import("./metadata.js").Frame): import("./frustum.js").View & {
    eye: number[];
};
/**
 * Returns the cameras that a file keeps: the training cameras or, if these are absent or invalid, the few coarse ones.
 * @param {import("./metadata.js").Metadata} metadata the checked metadata of the model
 * @param {number} [limit] only so many cameras at the start of a list count; the others may be invalid
 * @returns {{cameras: Camera[], isCoarse: boolean}} `cameras` is empty if the file keeps none that are valid
 */
export declare function storedCameras({ provenance }: import("./metadata.js").Metadata, limit?: number): {
    cameras: Camera[];
    isCoarse: boolean;
};
/**
 * Returns the viewpoint of a model whose file has none. It looks slightly down from 2.5 times the frame's longest
 * half-axis away; up is the frame's -y axis.
 * @param {{center: number[], scale: number, rotation?: number[]}} frame
 * @returns {Viewpoint}
 */
export declare function defaultViewpoint({ center, scale, rotation }: {
    center: number[];
    scale: number;
    rotation?: number[];
}): Viewpoint;
