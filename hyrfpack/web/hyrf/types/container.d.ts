export type Entry = {
    type: string;
    codec: number;
    offset: number;
    stored: number;
    raw: number;
    checksum: number;
    end: number;
};
/**
 * An entry of the table of contents. `stored` and `raw` are the section's lengths in the file and after decoding, in
 * bytes; `offset` and `end` are where its bytes start and where its padding ends; `checksum` is the CRC-32.
 * @typedef {{
 *   type: string, codec: number, offset: number, stored: number, raw: number, checksum: number, end: number,
 * }} Entry
 */
export declare const MAGIC_BYTES: number[];
export declare const HEADER_BYTES = 48;
export declare const ENTRY_BYTES = 40;
export declare const MAX_SECTIONS = 1024;
/** The maximum length of a file, and of all its sections after decoding. */
export declare const MAX_FILE_BYTES: number;
/**
 * Returns the largest number of bytes that all sections of a file of `length` bytes may decode to.
 * @param {number} length
 */
export declare const rawBytesLimit: (length: number) => number;
/** The maximum number of layers of Gaussians in a file. */
export declare const MAX_LAYERS = 8;
export declare const LAYERED_TYPES: string[];
export declare const FIELD_TYPES: string[];
/** The types of residuals, which a model of residuals has in each layer. */
export declare const RESIDUAL_TYPES: string[];
/** The type of the exposure map, which is optional. */
export declare const EXPOSURE_TYPE = "EXPO";
/**
 * Returns the type of a layer's section: "POSI" for the first layer, then "POS1", "POS2", ...
 * @param {string} type the type in the first layer
 * @param {number} layer counted from 0
 */
export declare const layerType: (type: string, layer: number) => string;
/** The maximum number of parts of a merged file. */
export declare const MAX_PARTS = 64;
/** The type of the names of the parts, which only merged files have. */
export declare const PART_NAMES_TYPE = "PRTS";
/**
 * Returns the type of the section that holds a part of a merged file.
 * @param {number} number counted from 0
 */
export declare const partType: (number: number) => string;
/** The sections of a file whose header and table of contents have been checked. */
export declare class Container {
    bytes: Uint8Array<ArrayBufferLike>;
    /** @type {[number, number]} */
    version: [number, number];
    /** The length of the whole file in bytes, from its header. */
    length: number;
    /** @type {Map<string, Entry>} */
    entries: Map<string, Entry>;
    /** The file that holds the sections of codec 12, once it is known. @type {Container | null} */
    shared: Container | null;
    /** The name of this file, if another one refers to it. */
    name: string;
    /** Results of decoding that files which refer to this one need, too. @type {Map<string, any>} */
    decoded: Map<string, any>;
    /**
     * @param {Uint8Array} bytes the whole file, or its start
     * @param {boolean} partial whether the start of a file is accepted
     * @throws {HyrfFormatError} the header or the table of contents is invalid, or the file is truncated
     */
    constructor(bytes: Uint8Array, partial: boolean);
    /**
     * Returns whether all bytes of a section are available.
     * @param {string} type
     */
    has(type: string): boolean;
    /**
     * Returns the stored bytes of a section, after it has checked their checksum and their padding.
     * @param {string} type the type of an available section
     * @throws {HyrfFormatError} the checksum or the padding is wrong
     */
    stored(type: string): Uint8Array<ArrayBufferLike>;
    /**
     * Checks the header by steps 1 to 3 of docs/reference/format.md 1.3.
     * @param {boolean} partial whether the start of a file is accepted
     * @returns {DataView} the table of contents, whose checksum is right
     */
    checkHeader(partial: boolean): DataView;
    /**
     * Checks the table of contents by steps 4 to 6 of docs/reference/format.md 1.3, and fills `entries`.
     * @param {DataView} table
     */
    checkEntries(table: DataView): void;
}
/**
 * Throws the error for a file of which too few bytes are available.
 * @param {Container} container
 * @param {number} needed the number of bytes, from the start of the file, that are needed
 * @returns {never}
 */
export declare const rejectIncomplete: (container: Container, needed: number) => never;
/**
 * Reads an unsigned 64-bit integer. Above 2^53 it is rounded, which is harmless, because all limits are far lower.
 * @param {DataView} view
 * @param {number} at the offset in bytes
 */
export declare const readUint64: (view: DataView, at: number) => number;
