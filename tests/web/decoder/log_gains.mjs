// Evaluates the exposure maps of files: `node log_gains.mjs CASES.json`.
//
// CASES.json is a list of {file, partial, positions, directions}: the path, the number of bytes to read from the start
// of the file (0 for the whole file), and the viewpoints. Prints, as JSON, the log gains of each file at each
// viewpoint, or null for a file without a map.

import { readFileSync } from "node:fs";

import { logGains } from "../../../hyrfpack/web/hyrf/exposure.js";
import { read } from "../../../hyrfpack/web/hyrf/index.js";

const answers = [];
for (const { file, partial, positions, directions } of JSON.parse(readFileSync(process.argv[2], "utf8"))) {
  const bytes = new Uint8Array(readFileSync(file));
  const { exposure } = await read(partial ? bytes.subarray(0, partial) : bytes, { partial: partial > 0 });
  answers.push(exposure && positions.map((position, k) => logGains(exposure, position, directions[k])));
}
console.log(JSON.stringify(answers));
