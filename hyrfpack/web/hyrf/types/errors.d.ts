/** Something failed for a reason that the user can understand. The message is one sentence for the user. */
export declare class HyrfError extends Error {
    /** @param {string} message */
    constructor(message: string);
}
/** The file cannot be read. */
export declare class HyrfFormatError extends HyrfError {
    /** @param {string} message */
    constructor(message: string);
}
/** The bytes of a section are invalid. A caller that knows the section's name converts this to a HyrfFormatError. */
export declare class DamagedData extends Error {
}
/**
 * Throws the error for a damaged file.
 * @param {string} reason
 * @returns {never}
 */
export declare const rejectDamaged: (reason: string) => never;
/**
 * Throws the error for a file that needs another version of the reader, which is mostly a newer one.
 * @param {string} reason
 * @returns {never}
 */
export declare const rejectNewer: (reason: string) => never;
/**
 * Returns bytes that a caller passes. It also accepts a Uint8Array of another frame of the page, which is of another
 * class.
 * @param {Uint8Array} value
 * @param {string} name that of the bytes, for the message
 * @throws {TypeError} it is no Uint8Array
 */
export declare const requireBytes: (value: Uint8Array, name: string) => Uint8Array<ArrayBufferLike>;
/**
 * Throws DamagedData unless a condition holds.
 * @param {boolean} holds whether the condition holds
 * @param {string} reason what is wrong if it does not hold
 */
export declare const assertValid: (holds: boolean, reason: string) => void;
/**
 * Returns an error, or one with a clear message in place of that for an array that is too long for the memory.
 * @param {any} error
 */
export declare const explainMemory: (error: any) => any;
/**
 * Quotes text from a file for a message: at most 40 characters, on one line, in ASCII.
 * @param {string} text
 */
export declare const quotedText: (text: string) => string;
/**
 * Formats a number with commas between groups of three digits.
 * @param {number} number
 */
export declare const groupedDigits: (number: number) => string;
