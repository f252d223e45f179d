// Writes the edited file in the browser. An edit of the metadata alone keeps the bytes of all other sections. If
// Gaussians are removed, the numbers of the others are stored as they are, as float32 (profile "raw").

import { Container, ENTRY_BYTES, EXPOSURE_TYPE, HEADER_BYTES } from "../../hyrf/container.js";
import { readMetadata } from "../../hyrf/metadata.js";
import { placementAfter } from "./actions.js";
import { writeContainer } from "./container_writer.js";
import { moveMetadata } from "./moved_metadata.js";

const METADATA_OPTIONS = ["up", "upright", "scale"];
const CODEC_JSON = 0, CODEC_FLOAT32 = 1, CODEC_DEFLATED = 5;
const COMPACT_CODECS = [5, 6, 7, 8], SHARED_CODECS = [11, 12]; // 5 is CODEC_DEFLATED, which came with the others
const REQUIRED_FLAG = 1;

// Returns whether actions remove no Gaussians.
export const keepsGaussians = (actions) => actions.every(({ option }) => METADATA_OPTIONS.includes(option));

// Returns the bytes of a file after actions that remove no Gaussians. `writer` is the name of this program, as files
// state it.
export async function rewriteFile(bytes, actions, writer) {
  const container = new Container(bytes, false), view = new DataView(bytes.buffer, bytes.byteOffset);
  const metadata = { ...editMetadata(readMetadata(container), actions), writer };
  const sections = [...container.entries.values()].map((entry, number) => {
    const flags = view.getUint16(HEADER_BYTES + ENTRY_BYTES * number + 6, true);
    return { ...entry, flags, data: container.stored(entry.type) };
  });
  const own = sections.find(({ type }) => type === "META"), text = encodeJson(metadata);
  Object.assign(own, { raw: text.length, data: own.codec === CODEC_DEFLATED ? await deflate(text) : text });
  return writeContainer(sections, lowestMinorVersion(sections, metadata.config));
}

// Returns the bytes of a file of profile "raw" after actions that remove Gaussians. `bytes` are those of the file
// before, and `model` is what they decode to. `kept` has a byte for each Gaussian, 0 if it is removed.
export function writeKept(bytes, { model, kept }, actions, writer) {
  const { config, rules, provenance } = editMetadata(model.metadata, actions);
  if ("psnr" in provenance) provenance.psnr_before = "an edit"; // which has changed the model since it was measured
  const take = (numbers) => {
    const columns = numbers.length / kept.length;
    return numbers.filter((_, at) => kept[Math.floor(at / columns)]);
  };
  const count = kept.reduce((sum, byte) => sum + byte, 0), { geometry, radiance } = model;
  const metadata = { profile: "raw", gaussians: count, config, rules, settings: {}, provenance, writer };
  const text = encodeJson(metadata), container = new Container(bytes, false);
  const arrays = {
    POSI: take(model.positions), COLO: take(model.colorLogits), SCAL: take(model.scaleLogits),
    OPAC: take(model.opacityLogits),
    ...(model.shapeResiduals ? { SHAP: take(model.shapeResiduals), HARM: take(model.colorResiduals) } : {}),
    GTAB: geometry.table, GMLP: geometry.decoder, RTAB: radiance.table, RMLP: radiance.decoder,
  };
  const sections = [{ type: "META", codec: CODEC_JSON, flags: REQUIRED_FLAG, raw: text.length, data: text }];
  const exposure = container.entries.get(EXPOSURE_TYPE);
  if (exposure) sections.push({ ...exposure, flags: 0, data: container.stored(EXPOSURE_TYPE) });
  for (const [type, { buffer, byteOffset, byteLength }] of Object.entries(arrays)) {
    const data = new Uint8Array(buffer, byteOffset, byteLength); // all devices of today are little-endian
    sections.push({ type, codec: CODEC_FLOAT32, flags: REQUIRED_FLAG, raw: byteLength, data });
  }
  return writeContainer(sections, lowestMinorVersion(sections, config));
}

// Returns the metadata of a file after actions.
function editMetadata(metadata, actions) {
  const stated = metadata.provenance.viewpoint?.up ?? [0, -1, 0]; // `upright` follows an `up`, which replaces it
  const placement = placementAfter(actions, { up: stated });
  return moveMetadata(metadata, placement, actions.some(({ option }) => option === "up"));
}

// Returns JSON of ASCII letters only, as bytes.
function encodeJson(value) {
  const escape = (letter) => `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`;
  return new TextEncoder().encode(JSON.stringify(value).replace(/[\u0080-\uffff]/g, escape));
}

// Returns bytes compressed as a zlib stream.
async function deflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new CompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Returns the lowest minor version that has the sections of a file and its configuration, as in
// hyrfpack/format/versions.py.
export function lowestMinorVersion(entries, { frame, residual_degree: degree }) {
  if (degree !== undefined) return 6;
  return Math.max(...entries.map(({ type, codec }) => {
    if (SHARED_CODECS.includes(codec)) return 5;
    if (frame.rotation) return 3;
    if (type === EXPOSURE_TYPE) return 2;
    return Number(COMPACT_CODECS.includes(codec) || /\d$/.test(type)); // a digit is the number of a later layer
  }));
}
