// The exposure maps of files, evaluated in JavaScript: `node log_gains.mjs CASES`.
//
// CASES is JSON, a list of {file, partial, positions, directions}: path, number of bytes of the file's start to be read
// or 0 for all, viewpoints. Printed is JSON: of each file its log gains at each viewpoint, null where it has no map.

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
