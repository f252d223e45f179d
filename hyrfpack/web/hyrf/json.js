// JSON as docs/format.md 2.1 wants it: unlike JSON.parse, this tells 1 from 1.0 and bounds the nesting.

import { needSound } from "./errors.js";

const DEEPEST = 64; // objects and lists within each other
const MOST_DIGITS = 4300; // of an integer
const NUMBER_TEXT = /-?(?:0|[1-9]\d*)(\.\d+)?([eE][+-]?\d+)?/y;
/** @type {[string, boolean | null][]} */
const JSON_WORDS = [["true", true], ["false", false], ["null", null]];

/** A number, the nearest one that JavaScript has, and whether it is written as an integer. */
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
 * Objects are maps, so that no key means anything to JavaScript.
 * @typedef {null | boolean | string | JsonNumber | JsonNode[] | JsonObject} JsonNode
 * @typedef {Map<string, any>} JsonObject
 */

/**
 * The value of a text. Of equal keys the last one counts.
 * @param {string} text
 * @returns {JsonNode}
 * @throws {DamagedData} it is not JSON, too deep, or holds a number that is not finite
 */
export const parseJson = (text) => {
  let place = 0;

  /** @param {boolean} holds */
  const needJson = (holds) => needSound(holds, `it is not valid JSON at character ${place}`);

  const skipBlanks = () => {
    for (; ; place++) {
      const code = text.charCodeAt(place);
      if (code !== 32 && code !== 10 && code !== 13 && code !== 9) return;
    }
  };

  /**
   * The next sign, taken if it is this one.
   * @param {string} sign
   */
  const took = (sign) => {
    skipBlanks();
    const is = text[place] === sign;
    if (is) place++;
    return is;
  };

  /** @returns {string} */
  const parseString = () => {
    const start = place;
    needJson(took('"'));
    while (text[place] !== '"') {
      needJson(place < text.length);
      place += text[place] === "\\" ? 2 : 1;
    }
    place++;
    try {
      return JSON.parse(text.slice(start, place));
    } catch {
      needJson(false);
      return "";
    }
  };

  /** @returns {JsonNumber} */
  const parseNumber = () => {
    NUMBER_TEXT.lastIndex = place;
    const match = NUMBER_TEXT.exec(text);
    if (!match) {
      needJson(false);
      return new JsonNumber("0", true);
    }
    place = NUMBER_TEXT.lastIndex;
    const isInteger = match[1] === undefined && match[2] === undefined;
    const number = new JsonNumber(match[0], isInteger);
    if (!isInteger) needSound(Number.isFinite(number.value), "a number is not finite");
    else needSound(match[0].replace("-", "").length <= MOST_DIGITS, "an integer has too many digits");
    return number;
  };

  /** @param {number} depth */
  const parseList = (depth) => {
    /** @type {JsonNode[]} */
    const list = [];
    if (took("]")) return list;
    do list.push(parseValue(depth));
    while (took(","));
    needJson(took("]"));
    return list;
  };

  /** @param {number} depth */
  const parseObject = (depth) => {
    /** @type {JsonObject} */
    const object = new Map();
    if (took("}")) return object;
    do {
      skipBlanks();
      const key = parseString();
      needJson(took(":"));
      object.set(key, parseValue(depth));
    } while (took(","));
    needJson(took("}"));
    return object;
  };

  /**
   * @param {number} depth of what holds the value
   * @returns {JsonNode}
   */
  const parseValue = (depth) => {
    skipBlanks();
    const sign = text[place];
    if (sign === "{" || sign === "[") {
      needSound(depth < DEEPEST, `it is nested deeper than ${DEEPEST} levels`);
      place++;
      return sign === "{" ? parseObject(depth + 1) : parseList(depth + 1);
    }
    if (sign === '"') return parseString();
    for (const [word, value] of JSON_WORDS) {
      if (sign === word[0] && text.startsWith(word, place)) {
        place += word.length;
        return value;
      }
    }
    return parseNumber();
  };

  const value = parseValue(0);
  skipBlanks();
  needJson(place === text.length);
  return value;
};
