// Runs Khronos' glTF validator: `node gltf_validator.mjs a.glb b.glb`. The last line printed is a JSON list of its
// reports.

import { readFile } from "node:fs/promises";

import { validateBytes } from "gltf-validator";

const reports = [];
for (const path of process.argv.slice(2)) reports.push(await validateBytes(new Uint8Array(await readFile(path))));
console.log(`\n${JSON.stringify(reports)}`);
