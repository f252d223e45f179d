// Reads chunks of scene folders: `node read_chunks.mjs FILE...`.
//
// Prints, as JSON, for each file: {count, hashes: SHA-256 of each array, hasMap, provenance, opened: names of the other
// files that were read}, or {refused: the message}.

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { dirname, join } from "node:path";

import { HyrfFormatError, read } from "../../../hyrfpack/web/hyrf/index.js";

const hash = ({ buffer, byteOffset, byteLength }) =>
  createHash("sha256").update(new Uint8Array(buffer, byteOffset, byteLength)).digest("hex");
const load = (path) => new Uint8Array(readFileSync(path));
const open = new Map(); // path -> its bytes

const answers = [];
for (const file of process.argv.slice(2)) {
  const opened = [];
  const openFile = (name) => {
    opened.push(name);
    const path = join(dirname(file), name);
    if (!open.has(path)) open.set(path, load(path));
    return open.get(path);
  };
  try {
    const { count, positions, colorLogits, scaleLogits, opacityLogits, geometry, radiance, exposure, metadata } =
      await read(load(file), { openFile });
    const fields = [geometry.table, geometry.decoder, radiance.table, radiance.decoder];
    const hashes = [positions, colorLogits, scaleLogits, opacityLogits, ...fields].map(hash);
    answers.push({ count, hashes, hasMap: exposure !== null, provenance: metadata.provenance, opened });
  } catch (error) {
    if (!(error instanceof HyrfFormatError)) throw error;
    answers.push({ refused: error.message });
  }
}
console.log(JSON.stringify(answers));
