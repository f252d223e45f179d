// Rewrites a file in the browser: edits that change only its metadata. All other sections keep their bytes.

import { Container, ENTRY_BYTES, EXPOSURE_TYPE, HEADER_BYTES } from "../../hyrf/container.js";
import { crc32 } from "../../hyrf/crc.js";
import { readMetadata } from "../../hyrf/metadata.js";
import { placementAfter } from "./actions.js";
import { moveMetadata } from "./moved_metadata.js";

const METADATA_OPTIONS = ["up", "upright", "scale"];
const CODEC_DEFLATED = 5;
const COMPACT_CODECS = [5, 6, 7, 8];
const ALIGNMENT = 8; // of sections, in bytes

// Returns whether `rewriteFile` can apply actions.
export const canRewrite = (actions) => actions.every(({ option }) => METADATA_OPTIONS.includes(option));

// Returns the bytes of a file after actions. `writer` is the name of this program, as files state it.
export async function rewriteFile(bytes, actions, writer) {
  const container = new Container(bytes, false), metadata = readMetadata(container);
  const stated = metadata.provenance.viewpoint?.up ?? [0, -1, 0]; // `upright` follows an `up`, which replaces it
  const placement = placementAfter(actions, { up: stated }), statesUp = actions.some(({ option }) => option === "up");
  const edited = { ...moveMetadata(metadata, placement, statesUp), writer };
  const text = new TextEncoder().encode(asciiJson(edited));
  const entries = [...container.entries.values()], { codec } = container.entries.get("META");
  const data = codec === CODEC_DEFLATED ? await deflate(text) : text;
  const sections = entries.map((entry) => {
    if (entry.type === "META") return { ...entry, data, raw: text.length };
    return { ...entry, data: container.stored(entry.type) };
  });
  return writeContainer(bytes, sections, lowestMinorVersion(entries, edited.config));
}

// Returns JSON of ASCII letters only.
const asciiJson = (value) =>
  JSON.stringify(value).replace(/[\u0080-\uffff]/g, (letter) => {
    return `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`;
  });

async function deflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new CompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// As in hyrfpack/format/versions.py.
function lowestMinorVersion(entries, { frame }) {
  if (frame.rotation) return 3;
  if (entries.some(({ type }) => type === EXPOSURE_TYPE)) return 2;
  const isLater = (type) => /^(POS|COL|SCA|OPA)\d$/.test(type);
  return Number(entries.some(({ type, codec }) => COMPACT_CODECS.includes(codec) || isLater(type)));
}

// Returns a file with the header and the flags of another one, and new sections in the same order.
function writeContainer(bytes, sections, minor) {
  const start = HEADER_BYTES + ENTRY_BYTES * sections.length;
  const padded = (length) => ALIGNMENT * Math.ceil(length / ALIGNMENT);
  const length = sections.reduce((end, { data }) => end + padded(data.length), start), file = new Uint8Array(length);
  file.set(bytes.subarray(0, start));
  const view = new DataView(file.buffer);
  const setLength = (at, value) => view.setBigUint64(at, BigInt(value), true);
  let offset = start;
  sections.forEach(({ data, raw }, number) => {
    const entry = HEADER_BYTES + ENTRY_BYTES * number;
    setLength(entry + 8, offset);
    setLength(entry + 16, data.length);
    setLength(entry + 24, raw);
    view.setUint32(entry + 32, crc32(data), true);
    file.set(data, offset);
    offset += padded(data.length);
  });
  view.setUint16(10, minor, true);
  setLength(16, length);
  view.setUint32(40, crc32(file.subarray(HEADER_BYTES, start)), true);
  view.setUint32(44, crc32(file.subarray(0, 44)), true);
  return file;
}
