// PLY, the container (Turk 1994): a header in text that names elements and their properties, and then their rows.

import { groupedDigits, quotedText } from "../../hyrf/errors.js";
import { refuseSplats } from "./checked.js";

const LONGEST_PLY_HEADER = 1 << 16;
const PLY_ORDERS = ["binary_little_endian", "binary_big_endian", "ascii"];
const PLY_KINDS = {
  char: "Int8", uchar: "Uint8", short: "Int16", ushort: "Uint16", int: "Int32", uint: "Uint32", float: "Float32",
  double: "Float64", int8: "Int8", uint8: "Uint8", int16: "Int16", uint16: "Uint16", int32: "Int32", uint32: "Uint32",
  float32: "Float32", float64: "Float64",
};
const KIND_BYTES = { Int8: 1, Uint8: 1, Int16: 2, Uint16: 2, Int32: 4, Uint32: 4, Float32: 4, Float64: 8 };
const PLAIN_NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$/;
const NO_NUMBER = { nan: NaN, inf: Infinity, infinity: Infinity };

/**
 * What the text at the start of a PLY file says: how rows are stored, of each element how many there are and its
 * properties (name -> a kind of DataView's numbers, "" for a list), and where the rows begin.
 * @typedef {{order: string, elements: Map<string, {count: number, properties: Map<string, string>}>, length: number}}
 *   PlyHeader
 *
 * Rows of an element: how many, and what gives the number of a property in row i.
 * @typedef {{count: number, column: (name: string) => (i: number) => number}} PlyRows
 */

/**
 * @param {Uint8Array} bytes
 * @returns {PlyHeader}
 */
export function readPlyHeader(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, LONGEST_PLY_HEADER));
  if (!/^ply\r?\n/.test(text)) refuseSplats("this is not a PLY file, for its first line is not 'ply'");
  const end = /^end_header\r?\n/m.exec(text);
  if (!end) refuseSplats(`its PLY header has no end within ${groupedDigits(LONGEST_PLY_HEADER)} bytes; it is damaged`);
  let order = null, properties = null;
  const elements = new Map();
  for (const line of text.slice(0, end.index).split("\n").slice(1)) {
    const [first, ...words] = line.split(/\s+/).filter(Boolean), [kind, name] = words, label = words[words.length - 1];
    const isNew = properties && !properties.has(label);
    if (first === undefined || first === "comment" || first === "obj_info") continue;
    if (first === "format" && words.length === 2 && PLY_ORDERS.includes(kind)) {
      order = kind;
    } else if (first === "element" && words.length === 2 && /^\d{1,15}$/.test(name) && !elements.has(kind)) {
      properties = new Map();
      elements.set(kind, { count: Number(name), properties });
    } else if (first === "property" && words.length === 2 && Object.hasOwn(PLY_KINDS, kind) && isNew) {
      properties.set(label, PLY_KINDS[kind]);
    } else if (first === "property" && words.length === 4 && kind === "list" && isNew) {
      properties.set(label, "");
    } else {
      refuseSplats(`the line ${quotedText(line)} of its PLY header is not understood`);
    }
  }
  if (!order) refuseSplats("its PLY header does not say in which format its rows are; it is damaged");
  return { order, elements, length: end.index + end[0].length };
}

/**
 * Rows of those elements that are wanted and there; others are skipped.
 * @param {Uint8Array} bytes the whole file
 * @param {PlyHeader} header
 * @param {string[]} wanted
 * @returns {Map<string, PlyRows>}
 */
export function readPlyRows(bytes, { order, elements, length }, wanted) {
  const rows = new Map(), text = order === "ascii" ? new TextNumbers(bytes.subarray(length)) : null;
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  let place = length;
  for (const [label, { count, properties }] of elements) {
    if (wanted.every((name) => rows.has(name))) break;
    const kinds = [...properties.values()], isWanted = wanted.includes(label);
    if (kinds.includes("") && count && (!text || isWanted)) {
      const what = `its element ${quotedText(label)} has properties that are lists`;
      refuseSplats(`${what}; no file of Gaussians needs them, export it again as a plain one`);
    }
    if (text) {
      const table = text.rows(label, count, isWanted ? kinds.length : -1);
      if (isWanted) rows.set(label, tableRowsOfPly(table, properties, count));
      continue;
    }
    const size = kinds.reduce((sum, kind) => sum + (KIND_BYTES[kind] ?? 0), 0);
    if (count * size > bytes.length - place) endsBeforeRows(label, count);
    if (isWanted) rows.set(label, binaryRowsOfPly(view, place, size, properties, count, order === PLY_ORDERS[0]));
    place += count * size;
  }
  return rows;
}

function endsBeforeRows(label, count) {
  refuseSplats(`it ends before the ${groupedDigits(count)} rows of its element ${quotedText(label)}; it is truncated`);
}

function binaryRowsOfPly(view, place, size, properties, count, little) {
  const offsets = new Map();
  let offset = 0;
  for (const [name, kind] of properties) {
    offsets.set(name, offset);
    offset += KIND_BYTES[kind] ?? 0;
  }
  const column = (name) => {
    const get = view[`get${properties.get(name)}`].bind(view), start = place + offsets.get(name);
    return (i) => get(start + i * size, little);
  };
  return { count: size ? count : 0, column };
}

function tableRowsOfPly(table, properties, count) {
  const names = [...properties.keys()];
  const column = (name) => {
    const at = names.indexOf(name);
    return (i) => table[i * names.length + at];
  };
  return { count: names.length ? count : 0, column };
}

// Rows in text, each a line; empty lines do not count.
class TextNumbers {
  constructor(bytes) {
    this.bytes = bytes;
    this.place = 0;
    this.decoder = new TextDecoder("latin1");
  }

  // The next line that holds something, or null.
  line() {
    while (this.place < this.bytes.length) {
      const found = this.bytes.indexOf(10, this.place), end = found < 0 ? this.bytes.length : found;
      const line = this.decoder.decode(this.bytes.subarray(this.place, end)).trim();
      this.place = end + 1;
      if (line) return line;
    }
    return null;
  }

  // `count` rows of so many numbers, or, with -1, passed over.
  rows(label, count, width) {
    // A row has as many characters as numbers at least, and their gaps.
    if (count * Math.max(1, 2 * width) > this.bytes.length - this.place + 1) endsBeforeRows(label, count);
    const table = new Float64Array(width > 0 ? count * width : 0);
    for (let row = 0; row < count; row++) {
      const line = this.line();
      if (line === null) endsBeforeRows(label, count);
      if (width > 0) this.fill(table, row * width, line.split(/\s+/), width, label);
    }
    return table;
  }

  fill(table, at, words, width, label) {
    const what = `its element ${quotedText(label)}`;
    if (words.length !== width) {
      refuseSplats(`rows of ${what} have ${words.length} numbers, and the header says ${width}; it is damaged`);
    }
    for (const word of words) {
      const bare = word.replace(/^[+-]/, "").toLowerCase();
      const known = Object.hasOwn(NO_NUMBER, bare);
      if (!known && !PLAIN_NUMBER.test(word)) refuseSplats(`a row of ${what} is not made of numbers; it is damaged`);
      table[at++] = known ? (word[0] === "-" ? -1 : 1) * NO_NUMBER[bare] : Number(word);
    }
  }
}
