// Reads the PLY container (Turk 1994): a text header that lists elements and their properties, then their rows.

import { groupedDigits, quotedText } from "../../hyrf/errors.js";
import { rejectSplats } from "./normalize.js";

const MAX_PLY_HEADER_BYTES = 1 << 16;
const PLY_FORMATS = ["binary_little_endian", "binary_big_endian", "ascii"];
const DATAVIEW_TYPE_BY_PLY_TYPE = {
  char: "Int8", uchar: "Uint8", short: "Int16", ushort: "Uint16", int: "Int32", uint: "Uint32", float: "Float32",
  double: "Float64", int8: "Int8", uint8: "Uint8", int16: "Int16", uint16: "Uint16", int32: "Int32", uint32: "Uint32",
  float32: "Float32", float64: "Float64",
};
const BYTES_BY_DATAVIEW_TYPE = { Int8: 1, Uint8: 1, Int16: 2, Uint16: 2, Int32: 4, Uint32: 4, Float32: 4, Float64: 8 };
const FINITE_NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$/;
const NON_FINITE_NUMBERS = { nan: NaN, inf: Infinity, infinity: Infinity };

/**
 * The header of a PLY file: the format of the rows (`order`); for each element the number of its rows and its
 * properties (name -> type in the method names of DataView, "" for a list); and the header's length in bytes.
 * @typedef {{order: string, elements: Map<string, {count: number, properties: Map<string, string>}>, length: number}}
 *   PlyHeader
 *
 * The rows of an element: `count` is their number; `column` returns the function that reads a property in row i.
 * @typedef {{count: number, column: (name: string) => (i: number) => number}} PlyRows
 */

/**
 * Parses the header of a PLY file.
 * @param {Uint8Array} bytes the file, or its start
 * @returns {PlyHeader}
 */
export function readPlyHeader(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, MAX_PLY_HEADER_BYTES));
  if (!/^ply\r?\n/.test(text)) rejectSplats("this is not a PLY file, for its first line is not 'ply'");
  const end = /^end_header\r?\n/m.exec(text);
  const limit = groupedDigits(MAX_PLY_HEADER_BYTES);
  if (!end) rejectSplats(`its PLY header has no end within ${limit} bytes; it is damaged`);
  let order = null, properties = null;
  const elements = new Map();
  for (const line of text.slice(0, end.index).split("\n").slice(1)) {
    const [first, ...words] = line.split(/\s+/).filter(Boolean), [kind, name] = words, label = words[words.length - 1];
    const isNew = properties && !properties.has(label);
    if (first === undefined || first === "comment" || first === "obj_info") continue;
    if (first === "format" && words.length === 2 && PLY_FORMATS.includes(kind)) {
      order = kind;
    } else if (first === "element" && words.length === 2 && /^\d{1,15}$/.test(name) && !elements.has(kind)) {
      properties = new Map();
      elements.set(kind, { count: Number(name), properties });
    } else if (first === "property" && words.length === 2 && Object.hasOwn(DATAVIEW_TYPE_BY_PLY_TYPE, kind) && isNew) {
      properties.set(label, DATAVIEW_TYPE_BY_PLY_TYPE[kind]);
    } else if (first === "property" && words.length === 4 && kind === "list" && isNew) {
      properties.set(label, "");
    } else {
      rejectSplats(`the line ${quotedText(line)} of its PLY header is not understood`);
    }
  }
  if (!order) rejectSplats("its PLY header does not say in which format its rows are; it is damaged");
  return { order, elements, length: end.index + end[0].length };
}

/**
 * Reads the rows of the wanted elements that the file has. Other elements are skipped.
 * @param {Uint8Array} bytes the whole file
 * @param {PlyHeader} header
 * @param {string[]} wanted the names of the elements
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
      rejectSplats(`${what}; no file of Gaussians needs them, export it again as a plain one`);
    }
    if (text) {
      const table = text.rows(label, count, isWanted ? kinds.length : -1);
      if (isWanted) rows.set(label, tableRowsOfText(table, properties, count));
      continue;
    }
    const size = kinds.reduce((sum, kind) => sum + (BYTES_BY_DATAVIEW_TYPE[kind] ?? 0), 0);
    if (count * size > bytes.length - place) rejectTruncatedRows(label, count);
    if (isWanted) rows.set(label, binaryRows(view, place, size, properties, count, order === PLY_FORMATS[0]));
    place += count * size;
  }
  return rows;
}

// Throws the error for a file that ends within the rows of an element.
function rejectTruncatedRows(label, count) {
  rejectSplats(`it ends before the ${groupedDigits(count)} rows of its element ${quotedText(label)}; it is truncated`);
}

// Returns the rows of an element that is stored in binary.
function binaryRows(view, place, size, properties, count, little) {
  const offsets = new Map();
  let offset = 0;
  for (const [name, kind] of properties) {
    offsets.set(name, offset);
    offset += BYTES_BY_DATAVIEW_TYPE[kind] ?? 0;
  }
  const column = (name) => {
    const get = view[`get${properties.get(name)}`].bind(view), start = place + offsets.get(name);
    return (i) => get(start + i * size, little);
  };
  return { count: size ? count : 0, column };
}

// Returns the rows of an element whose numbers were parsed from text.
function tableRowsOfText(table, properties, count) {
  const names = [...properties.keys()];
  const column = (name) => {
    const at = names.indexOf(name);
    return (i) => table[i * names.length + at];
  };
  return { count: names.length ? count : 0, column };
}

// Parses rows of text, one row per line. Empty lines are skipped.
class TextNumbers {
  constructor(bytes) {
    this.bytes = bytes;
    this.place = 0;
    this.decoder = new TextDecoder("latin1");
  }

  // Returns the next line that is not empty, or null.
  line() {
    while (this.place < this.bytes.length) {
      const found = this.bytes.indexOf(10, this.place), end = found < 0 ? this.bytes.length : found;
      const line = this.decoder.decode(this.bytes.subarray(this.place, end)).trim();
      this.place = end + 1;
      if (line) return line;
    }
    return null;
  }

  // Parses `count` rows of `width` numbers. With a width of -1 the rows are skipped.
  rows(label, count, width) {
    // A row of n numbers has at least 2 n - 1 characters and a line end, so this bounds the memory for the table.
    if (count * Math.max(1, 2 * width) > this.bytes.length - this.place + 1) rejectTruncatedRows(label, count);
    const table = new Float64Array(width > 0 ? count * width : 0);
    for (let row = 0; row < count; row++) {
      const line = this.line();
      if (line === null) rejectTruncatedRows(label, count);
      if (width > 0) this.fill(table, row * width, line.split(/\s+/), width, label);
    }
    return table;
  }

  // Parses the words of a row into `table` from index `at` on.
  fill(table, at, words, width, label) {
    const what = `its element ${quotedText(label)}`;
    if (words.length !== width) {
      rejectSplats(`rows of ${what} have ${words.length} numbers, and the header says ${width}; it is damaged`);
    }
    for (const word of words) {
      const bare = word.replace(/^[+-]/, "").toLowerCase();
      const known = Object.hasOwn(NON_FINITE_NUMBERS, bare);
      if (!known && !FINITE_NUMBER.test(word)) rejectSplats(`a row of ${what} is not made of numbers; it is damaged`);
      table[at++] = known ? (word[0] === "-" ? -1 : 1) * NON_FINITE_NUMBERS[bare] : Number(word);
    }
  }
}
