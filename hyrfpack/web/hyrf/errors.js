// What a reader says of files that it cannot read.

/** A file was refused; the message is one sentence for its user. */
export class HyrfFormatError extends Error {
  /** @param {string} message */
  constructor(message) {
    super(message);
    this.name = "HyrfFormatError";
  }
}

/** Bytes of a section cannot be what a writer made. Who reads the section says which one it is. */
export class DamagedData extends Error {}

/**
 * @param {string} what
 * @returns {never}
 */
export const damagedFile = (what) => {
  throw new HyrfFormatError(`The file is damaged: ${what}; fetch or write it again.`);
};

/**
 * @param {string} what
 * @returns {never}
 */
export const newerFile = (what) => {
  throw new HyrfFormatError(`The file is newer than this reader: ${what}; update the reader.`);
};

/**
 * Throw DamagedData unless something holds.
 * @param {boolean} holds
 * @param {string} what
 */
export const needSound = (holds, what) => {
  if (!holds) throw new DamagedData(what);
};

/** Text out of a file for a message: short, on one line, and in ASCII.
 * @param {string} text */
export const quotedText = (text) =>
  JSON.stringify(text.slice(0, 40)).replace(/[^ -~]/g, (letter) => {
    return `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`;
  });

/** @param {number} number */
export const groupedDigits = (number) => number.toLocaleString("en-US");
