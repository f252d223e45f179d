import { HyrfError, HyrfFormatError } from "./errors.js";
export { HyrfError, HyrfFormatError };
export type Description = import("./reader.js").Description;
export type Field = import("./reader.js").Field;
export type Model = import("./reader.js").Model;
export type OpenFile = import("./reader.js").OpenFile;
/**
 * @typedef {import("./reader.js").Description} Description
 * @typedef {import("./reader.js").Field} Field
 * @typedef {import("./reader.js").Model} Model
 * @typedef {import("./reader.js").OpenFile} OpenFile
 */
/**
 * Describes a file by its header and its table of contents.
 * @param {Uint8Array} bytes the start of a file, or all of it
 * @returns {Description} all lengths in bytes; a model of the first layer needs the first `firstLayer` bytes. A merged
 *   file is needed whole
 * @throws {HyrfFormatError} the header or the table of contents is invalid
 * @throws {TypeError} `bytes` is no Uint8Array
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
 * @throws {TypeError} `bytes`, or what `openFile` returns, is no Uint8Array
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
 * @throws {TypeError} `bytes` is no Uint8Array
 */
export declare const readParts: (bytes: Uint8Array) => Promise<{
    name: string;
    model: Model;
}[]>;
