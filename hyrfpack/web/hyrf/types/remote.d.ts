import { HyrfError } from "./errors.js";
export type View = import("./frustum.js").View;
export type EvaluatedRow = import("./view_evaluator.js").EvaluatedRow;
export type SkySize = import("./view_evaluator.js").SkySize;
export type SkyTile = import("./view_evaluator.js").SkyTile;
export type Receiver = {
    onOrder: (order: Uint32Array, drawn: number) => void;
    onRow: (row: EvaluatedRow) => void;
    onTile: (tile: SkyTile) => void;
    onError: (error: HyrfError) => void;
};
export type RemotePart = {
    place: import("./places.js").Place;
    firstRow: number;
    rowCount: number;
    exposure: import("./exposure.js").ExposureMap | null;
};
export type Source = string | URL | Blob | ArrayBufferLike | ArrayBufferView;
export type OpenOptions = {
    name?: string;
    onProgress?: (progress: {
        step: "loading" | "decoding";
        part: number;
    }) => void;
    signal?: AbortSignal;
    createWorker?: () => Worker;
};
/**
 * Opens a model in a worker of its own.
 * @param {Source} source
 * @param {Partial<Receiver> & OpenOptions} [options]
 * @returns {Promise<RemoteModel>} when the file is decoded; nothing is evaluated before the first call of `look`
 * @throws {HyrfError} the file cannot be fetched or read, or the worker does not start; the message names the file
 */
export declare const openRemoteModel: (source: Source, options?: Partial<Receiver> & OpenOptions) => Promise<RemoteModel>;
/** A model in a worker. `openRemoteModel` makes one. */
export declare class RemoteModel {
    #private;
    /** The metadata of the file, of the first part of a merged file. @type {import("./metadata.js").Metadata} */
    metadata: import("./metadata.js").Metadata;
    /** `metadata.config`. @type {import("./metadata.js").Config} */
    config: import("./metadata.js").Config;
    /** The number of Gaussians. */
    count: number;
    /** The exposure map, for `logGains`, or null. @type {import("./exposure.js").ExposureMap | null} */
    exposure: import("./exposure.js").ExposureMap | null;
    /** The number of rows of Gaussians; each part of a merged file begins a row. */
    rowCount: number;
    /**
     * The models of a merged file, or the only model: their places in the units of the first, their rows and their
     * exposure maps.
     * @type {RemotePart[]}
     */
    parts: RemotePart[];
    /** The size of the background's picture, or null if there is none. @type {SkySize | null} */
    sky: SkySize | null;
    /** Whether the worker was ended. */
    isClosed: boolean;
    /**
     * @private
     * @param {string} name
     * @param {Partial<Receiver> & OpenOptions} options
     */
    private constructor();
    /**
     * See `openRemoteModel`.
     * @param {Source} source
     * @param {Partial<Receiver> & OpenOptions} options
     */
    static open(source: Source, options: Partial<Receiver> & OpenOptions): Promise<RemoteModel>;
    /**
     * Evaluates the model for a view, which replaces the previous one. The receiver gets an order, and then rows and
     * tiles, until everything in view is evaluated at the viewpoint, and later what is out of view.
     * @param {View} view in the model's local units
     * @returns {Promise<boolean>} true when everything in view was delivered; false if another view came first, or if the
     *   model was closed
     */
    look(view: View): Promise<boolean>;
    /**
     * Gives an order back to the worker, which then allocates no new one.
     * @param {Uint32Array} order
     */
    reuse(order: Uint32Array): void;
    /** Ends the worker. */
    close(): void;
}
