import { HyrfError, HyrfFormatError } from "./errors.js";
export { HyrfError, HyrfFormatError };
export type Entry = import("./container.js").Entry;
export type ExposureMap = import("./exposure.js").ExposureMap;
export type FieldName = import("./grids.js").FieldName;
export type LatticePoints = import("./lattice.js").LatticePoints;
export type Config = import("./metadata.js").Config;
export type Metadata = import("./metadata.js").Metadata;
export type Field = {
    table: Float32Array;
    decoder: Float32Array;
};
export type Model = {
    metadata: Metadata;
    config: Config;
    count: number;
    layers: number[];
    whole: boolean;
    positions: Float32Array;
    colorLogits: Float32Array;
    scaleLogits: Float32Array;
    opacityLogits: Float32Array;
    shapeResiduals: Float32Array | null;
    colorResiduals: Float32Array | null;
    geometry: Field;
    radiance: Field;
    exposure: ExposureMap | null;
};
export type Description = {
    version: [number, number];
    length: number;
    sections: {
        type: string;
        codec: number;
        offset: number;
        stored: number;
        raw: number;
    }[];
    firstLayer: number;
};
export type OpenFile = (name: string) => Uint8Array | Promise<Uint8Array>;
export type ExpectedSection = {
    type: string;
    group: string;
    layer: number;
    rows: number;
    columns: number;
};
/**
 * Describes a file by its header and its table of contents.
 * @param {Uint8Array} bytes the start of a file, or all of it
 * @returns {Description} all lengths in bytes; a model of the first layer needs the first `firstLayer` bytes. A merged
 *   file is needed whole
 * @throws {HyrfFormatError} the header or the table of contents is invalid
 */
export declare const describe: (bytes: Uint8Array) => Description;
/**
 * Decodes a file of one model.
 * @param {Uint8Array} bytes the file, or its start if `partial` is true
 * @param {{partial?: boolean, openFile?: OpenFile}} [options] `partial`: accept the start of a file, and read the
 *   layers that are complete; `openFile`: called for the file that a chunk of a scene folder refers to
 * @returns {Promise<Model>} the fields and the exposure map of a chunk are those of the other file
 * @throws {HyrfFormatError} the file is damaged, truncated or too new; `bytes` has no complete layer; the file is a
 *   merged one; or it refers to a file that is damaged or another one, or that cannot be opened, as without `openFile`
 */
export declare const read: (bytes: Uint8Array, { partial, openFile }?: {
    partial?: boolean;
    openFile?: OpenFile;
}) => Promise<Model>;
/**
 * Decodes all parts of a merged file, or the one model of any other file. The first part is the scene, whose background
 * and cameras are those of the file.
 * @param {Uint8Array} bytes the whole file
 * @returns {Promise<{name: string, model: Model}[]>}
 * @throws {HyrfFormatError} the file is damaged, truncated or too new
 */
export declare const readParts: (bytes: Uint8Array) => Promise<{
    name: string;
    model: Model;
}[]>;
