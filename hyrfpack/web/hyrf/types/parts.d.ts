import { Container } from "./container.js";
/**
 * Reads the names of a merged file's parts.
 * @param {Container} container
 * @returns {string[]}
 * @throws {HyrfFormatError} the names are damaged
 */
export declare const readPartNames: (container: Container) => string[];
/**
 * Returns whether a value is a list of names of parts.
 * @param {any} names
 */
export declare const arePartNames: (names: any) => boolean;
/**
 * Returns name and container of each part, after a check of all sizes that they declare.
 * @param {Container} container of a merged file that is complete
 * @returns {{name: string, container: Container}[]}
 * @throws {HyrfFormatError} a part is missing or damaged, is itself a merged file, or the parts declare too many bytes
 */
export declare const openParts: (container: Container) => {
    name: string;
    container: Container;
}[];
