// Writes the container of `.hyrf` files (docs/reference/format.md, part 1).

import { ENTRY_BYTES, HEADER_BYTES, MAGIC_BYTES } from "../../hyrf/container.js";
import { crc32 } from "../../hyrf/crc.js";

const MAJOR_VERSION = 1;
const SECTION_ALIGNMENT_BYTES = 8;

const padded = (length) => SECTION_ALIGNMENT_BYTES * Math.ceil(length / SECTION_ALIGNMENT_BYTES);

// Returns the bytes of a file of sections {type, codec, flags, raw: their decoded length, data}.
export function writeContainer(sections, minor) {
  const start = HEADER_BYTES + ENTRY_BYTES * sections.length;
  const length = sections.reduce((end, { data }) => end + padded(data.length), start), file = new Uint8Array(length);
  const view = new DataView(file.buffer), setLength = (at, value) => view.setBigUint64(at, BigInt(value), true);
  let offset = start;
  sections.forEach(({ type, codec, flags, raw, data }, number) => {
    const entry = HEADER_BYTES + ENTRY_BYTES * number;
    file.set(new TextEncoder().encode(type), entry);
    view.setUint16(entry + 4, codec, true);
    view.setUint16(entry + 6, flags, true);
    setLength(entry + 8, offset);
    setLength(entry + 16, data.length);
    setLength(entry + 24, raw);
    view.setUint32(entry + 32, crc32(data), true);
    file.set(data, offset);
    offset += padded(data.length);
  });
  file.set(MAGIC_BYTES);
  view.setUint16(8, MAJOR_VERSION, true);
  view.setUint16(10, minor, true);
  setLength(16, length);
  setLength(24, HEADER_BYTES);
  view.setUint32(32, start - HEADER_BYTES, true);
  view.setUint32(36, sections.length, true);
  view.setUint32(40, crc32(file.subarray(HEADER_BYTES, start)), true);
  view.setUint32(44, crc32(file.subarray(0, 44)), true);
  return file;
}
