// Passes wrong arguments to hyrf.js: `node wrong_arguments.mjs FILE CHUNK MANIFEST`, the last two of a scene folder.
//
// Prints, as JSON, {name of a function: {what it was given: "the error's name: its message", "" for none}}.

import { readFileSync } from "node:fs";
import { runInNewContext } from "node:vm";

import { fitHarmonics } from "../../../hyrfpack/web/hyrf/harmonics.js";
import { describe, read, readParts } from "../../../hyrfpack/web/hyrf/index.js";
import { parseManifest } from "../../../hyrfpack/web/hyrf/manifest.js";

const [file, chunk, manifest] = process.argv.slice(2).map((path) => readFileSync(path));
const copyOfFrame = (bytes) => runInNewContext("Uint8Array.from(numbers)", { numbers: [...bytes] });
const inputs = (bytes) => ({
  "a Buffer": bytes,
  "an array of a frame": copyOfFrame(bytes),
  undefined,
  null: null,
  "a string": "scene.hyrf",
  "a number": 5,
  "an Array": [...bytes.subarray(0, 9)],
  "an ArrayBuffer": bytes.buffer,
  "a Float32Array": new Float32Array(9),
  "a Response": new Response("bytes"),
  "a Promise": Promise.resolve(bytes),
});
const model = await read(file);
const cases = {
  describe: [describe, inputs(file)],
  read: [read, inputs(file)],
  readParts: [readParts, inputs(file)],
  parseManifest: [parseManifest, inputs(manifest)],
  openFile: [(value) => read(chunk, { openFile: () => value }), { undefined, "a Response": new Response("bytes") }],
  fitHarmonics: [
    (degree) => fitHarmonics({ ...model, count: 0 }, [], degree),
    { 0: 0, 3: 3, undefined, null: null, "-1": -1, 1.5: 1.5, 4: 4, "a string": "1" },
  ],
};
const answers = {};
for (const [name, [call, values]] of Object.entries(cases)) {
  answers[name] = {};
  for (const [what, value] of Object.entries(values)) {
    const run = async () => call(value);
    answers[name][what] = await run().then(() => "", (error) => `${error.name}: ${error.message}`);
  }
}
console.log(JSON.stringify(answers));
