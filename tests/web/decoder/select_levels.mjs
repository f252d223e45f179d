// Chooses levels of detail: `node select_levels.mjs CASES`, a JSON file of {manifest: text, camera, options}.
//
// Prints, as JSON, for each case: the selection, or {refused: the message} for a manifest that is not valid. Without a
// camera, only the manifest is read.

import { readFileSync } from "node:fs";

import { HyrfFormatError } from "../../../hyrfpack/web/hyrf/errors.js";
import { selectLevels } from "../../../hyrfpack/web/hyrf/levels.js";
import { parseManifest } from "../../../hyrfpack/web/hyrf/manifest.js";

const answers = JSON.parse(readFileSync(process.argv[2])).map(({ manifest, camera, options, missing }) => {
  try {
    const parsed = parseManifest(Uint8Array.from(Buffer.from(manifest, "base64")));
    const isAvailable = (chunk, level) => !(missing ?? []).some(([c, l]) => c === chunk && l === level);
    return camera ? selectLevels(parsed, camera, { ...options, isAvailable }) : parsed;
  } catch (error) {
    if (!(error instanceof HyrfFormatError)) throw error;
    return { refused: error.message };
  }
});
console.log(JSON.stringify(answers));
