// The fields of a model, evaluated in JavaScript: `node evaluate.mjs MODEL.hyrf INPUTS OUTPUTS`.
//
// INPUTS holds float32: a unit direction for each Gaussian, then places on the background sphere and as many unit
// directions. OUTPUTS gets float32: opacities, scales, quats, colours along the directions, background colours.
// Gaussians go in two calls, so that a start other than 0 is met, too.

import { readFile, writeFile } from "node:fs/promises";

import { backgroundColors, colorsAlong, decodeGeometry, firstLayers } from "../../../hyrfpack/web/hyrf/fields.js";
import { read } from "../../../hyrfpack/web/hyrf/index.js";

const [file, inputs, outputs] = process.argv.slice(2);
const model = await read(new Uint8Array(await readFile(file)));
const { buffer } = new Uint8Array(await readFile(inputs));
const numbers = new Float32Array(buffer), { count } = model;
const others = (numbers.length - 3 * count) / 2;
const places = numbers.subarray(3 * count, 3 * count + others), behind = numbers.subarray(3 * count + others);

const cut = Math.floor(count / 3), parts = [[0, cut], [cut, count]];
const shapes = parts.map(([start, stop]) => decodeGeometry(model, start, stop));
const colors = parts.map(([start, stop]) => {
  const layers = firstLayers(model, start, stop);
  return colorsAlong(model, layers, start, stop, numbers.subarray(3 * start, 3 * stop));
});
const arrays = ["opacities", "scales", "quats"].flatMap((name) => shapes.map((shape) => shape[name]));
arrays.push(...colors, backgroundColors(model, places, behind));
await writeFile(outputs, Buffer.concat(arrays.map((array) => new Uint8Array(array.buffer))));
console.log(JSON.stringify(arrays.map((array) => array.length)));
