// Reads merged files: `node read_parts.mjs FILE...`.
//
// Prints, as JSON, for each file: a list of {name, count, hashes: SHA-256 of each array}, or {refused: the message}.

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

import { HyrfFormatError, describe, read, readParts } from "../../../hyrfpack/web/hyrf/index.js";

const hash = (array) => createHash("sha256").update(new Uint8Array(array.buffer, array.byteOffset, array.byteLength)).digest("hex");

const answers = [];
for (const file of process.argv.slice(2)) {
  const bytes = new Uint8Array(readFileSync(file));
  try {
    const parts = await readParts(bytes);
    answers.push(parts.map(({ name, model: { count, positions, colorLogits, geometry, radiance, exposure } }) => {
      const arrays = [positions, colorLogits, geometry.table, geometry.decoder, radiance.table, radiance.decoder];
      return { name, count, hashes: arrays.map(hash), hasMap: exposure !== null };
    }));
    if (parts.length > 1) {
      const message = await read(bytes).then(() => "", (error) => error instanceof HyrfFormatError && error.message);
      answers[answers.length - 1].push({ single: message, needed: describe(bytes).firstLayer });
    }
  } catch (error) {
    if (!(error instanceof HyrfFormatError)) throw error;
    answers.push({ refused: error.message });
  }
}
console.log(JSON.stringify(answers));
