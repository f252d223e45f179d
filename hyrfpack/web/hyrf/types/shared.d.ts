import { Container } from "./container.js";
export declare const CODEC_SHARED = 12;
/**
 * Returns whether a value may name another file of the same folder.
 * @param {any} name
 */
export declare const isFileName: (name: any) => boolean;
/**
 * Returns the name of the file that the available sections of a file refer to, or null if they refer to none.
 * @param {Container} container
 * @throws {HyrfFormatError} a reference is damaged, or there are several names
 */
export declare const sharedFileName: (container: Container) => string | null;
/**
 * Makes the file to which a file refers its `shared` one.
 * @param {Container} container
 * @param {string} name of the other file
 * @param {Uint8Array} bytes of the other file, whole
 * @throws {HyrfFormatError} the other file is not valid, or is not the one that was referred to
 */
export declare const attachShared: (container: Container, name: string, bytes: Uint8Array) => void;
