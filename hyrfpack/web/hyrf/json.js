// Parses JSON by the rules of docs/reference/format.md 2.1. Unlike JSON.parse, it distinguishes 1 from 1.0 and limits
// the nesting.

import { DamagedData, assertValid } from "./errors.js";

export const MAX_NESTING_DEPTH = 64;
const MAX_INTEGER_DIGITS = 4300;
const NUMBER_PATTERN = /-?(?:0|[1-9]\d*)(\.\d+)?([eE][+-]?\d+)?/y;
/** @type {[string, boolean | null][]} */
const JSON_LITERALS = [["true", true], ["false", false], ["null", null]];

/** A number as float64, and whether its text is an integer. */
export class JsonNumber {
  /**
   * @param {string} text
   * @param {boolean} isInteger
   */
  constructor(text, isInteger) {
    this.value = Number(text);
    this.isInteger = isInteger;
  }
}

/**
 * A parsed value. Objects become maps, so that keys such as `__proto__` have no special meaning.
 * @typedef {null | boolean | string | JsonNumber | JsonNode[] | JsonObject} JsonNode
 * @typedef {Map<string, any>} JsonObject
 */

/**
 * Parses a JSON text. If a key is repeated in an object, its last value is used.
 * @param {string} text
 * @returns {JsonNode}
 * @throws {DamagedData} the text is not JSON, is nested too deeply, or has a number that is too large
 */
export const parseJson = (text) => {
  let position = 0;

  const invalidJson = () => new DamagedData(`it is not valid JSON at character ${position}`);

  /** @param {boolean} holds */
  const assertJson = (holds) => {
    if (!holds) throw invalidJson();
  };

  const skipWhitespace = () => {
    for (; ; position++) {
      const code = text.charCodeAt(position);
      if (code !== 32 && code !== 10 && code !== 13 && code !== 9) return;
    }
  };

  /**
   * Skips white space, and then the next character if it is `character`. Returns whether it was.
   * @param {string} character
   */
  const accept = (character) => {
    skipWhitespace();
    const isNext = text[position] === character;
    if (isNext) position++;
    return isNext;
  };

  /** @returns {string} */
  const parseString = () => {
    const start = position;
    assertJson(accept('"'));
    while (text[position] !== '"') {
      assertJson(position < text.length);
      position += text[position] === "\\" ? 2 : 1;
    }
    position++;
    try {
      return JSON.parse(text.slice(start, position));
    } catch {
      throw invalidJson();
    }
  };

  /** @returns {JsonNumber} */
  const parseNumber = () => {
    NUMBER_PATTERN.lastIndex = position;
    const match = NUMBER_PATTERN.exec(text);
    if (!match) throw invalidJson();
    position = NUMBER_PATTERN.lastIndex;
    const isInteger = match[1] === undefined && match[2] === undefined;
    const number = new JsonNumber(match[0], isInteger);
    if (!isInteger) assertValid(Number.isFinite(number.value), "a number is not finite");
    else assertValid(match[0].replace("-", "").length <= MAX_INTEGER_DIGITS, "an integer has too many digits");
    return number;
  };

  /** @param {number} depth */
  const parseList = (depth) => {
    /** @type {JsonNode[]} */
    const list = [];
    if (accept("]")) return list;
    do list.push(parseValue(depth));
    while (accept(","));
    assertJson(accept("]"));
    return list;
  };

  /** @param {number} depth */
  const parseObject = (depth) => {
    /** @type {JsonObject} */
    const object = new Map();
    if (accept("}")) return object;
    do {
      skipWhitespace();
      const key = parseString();
      assertJson(accept(":"));
      object.set(key, parseValue(depth));
    } while (accept(","));
    assertJson(accept("}"));
    return object;
  };

  /**
   * @param {number} depth the number of objects and lists around the value
   * @returns {JsonNode}
   */
  const parseValue = (depth) => {
    skipWhitespace();
    const first = text[position];
    if (first === "{" || first === "[") {
      assertValid(depth < MAX_NESTING_DEPTH, `it is nested deeper than ${MAX_NESTING_DEPTH} levels`);
      position++;
      return first === "{" ? parseObject(depth + 1) : parseList(depth + 1);
    }
    if (first === '"') return parseString();
    for (const [word, value] of JSON_LITERALS) {
      if (first === word[0] && text.startsWith(word, position)) {
        position += word.length;
        return value;
      }
    }
    return parseNumber();
  };

  const value = parseValue(0);
  skipWhitespace();
  assertJson(position === text.length);
  return value;
};
