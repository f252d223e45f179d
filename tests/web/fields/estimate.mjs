// Estimates the Gaussians of a model: `node estimate.mjs MODEL.hyrf EYE OUTPUTS`; EYE is a JSON list in local units.
//
// Writes float32 numbers to OUTPUTS: opacities, scales, quats, colours.

import { readFile, writeFile } from "node:fs/promises";

import { read } from "../../../hyrfpack/web/hyrf/index.js";
import { estimateGaussians } from "../../../hyrfpack/web/viewer/estimate.js";

const [file, eye, outputs] = process.argv.slice(2);
const model = await read(new Uint8Array(await readFile(file)));
const { opacities, scales, quats, colors } = estimateGaussians(model, JSON.parse(eye));
const arrays = [opacities, scales, quats, colors];
await writeFile(outputs, Buffer.concat(arrays.map((array) => new Uint8Array(array.buffer))));
console.log(JSON.stringify(arrays.map((array) => array.length)));
