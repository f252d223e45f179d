// The errors of the reader, and functions that format their messages.

/** Something failed for a reason that the user can understand. The message is one sentence for the user. */
export class HyrfError extends Error {
  /** @param {string} message */
  constructor(message) {
    super(message);
    this.name = "HyrfError";
  }
}

/** The file cannot be read. */
export class HyrfFormatError extends HyrfError {
  /** @param {string} message */
  constructor(message) {
    super(message);
    this.name = "HyrfFormatError";
  }
}

/** The bytes of a section are invalid. A caller that knows the section's name converts this to a HyrfFormatError. */
export class DamagedData extends Error {}

/**
 * Throws the error for a damaged file.
 * @param {string} reason
 * @returns {never}
 */
export const rejectDamaged = (reason) => {
  throw new HyrfFormatError(`The file is damaged: ${reason}; fetch or write it again.`);
};

/**
 * Throws the error for a file that needs another version of the reader, which is mostly a newer one.
 * @param {string} reason
 * @returns {never}
 */
export const rejectNewer = (reason) => {
  throw new HyrfFormatError(`The file cannot be read: ${reason}; update the reader.`);
};

/**
 * Returns bytes that a caller passes. It also accepts a Uint8Array of another frame of the page, which is of another
 * class.
 * @param {Uint8Array} value
 * @param {string} name that of the bytes, for the message
 * @throws {TypeError} it is no Uint8Array
 */
export const requireBytes = (value, name) => {
  const type = Object.prototype.toString.call(value).slice(8, -1);
  if (type === "Uint8Array") return value;
  throw new TypeError(`${name} must be a Uint8Array, not ${type}; pass new Uint8Array(await response.arrayBuffer()).`);
};

/**
 * Throws DamagedData unless a condition holds.
 * @param {boolean} holds whether the condition holds
 * @param {string} reason what is wrong if it does not hold
 */
export const assertValid = (holds, reason) => {
  if (!holds) throw new DamagedData(reason);
};

// Messages of browsers for arrays that are too long, or for which there is no memory, match this.
const MEMORY_MESSAGE = /alloc|length|memory|array size/i;

/**
 * Returns an error, or one with a clear message in place of that for an array that is too long for the memory.
 * @param {any} error
 */
export const explainMemory = (error) =>
  error instanceof RangeError && MEMORY_MESSAGE.test(error.message)
    ? new HyrfFormatError("The model takes more memory than there is; open a smaller one.")
    : error;

/**
 * Quotes text from a file for a message: at most 40 characters, on one line, in ASCII.
 * @param {string} text
 */
export const quotedText = (text) =>
  JSON.stringify(text.slice(0, 40)).replace(/[^ -~]/g, (letter) => {
    return `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`;
  });

/**
 * Formats a number with commas between groups of three digits.
 * @param {number} number
 */
export const groupedDigits = (number) => number.toLocaleString("en-US");
