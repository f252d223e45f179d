// Evaluates the fields of a model: `node evaluate.mjs MODEL.hyrf INPUTS OUTPUTS`.
//
// INPUTS has float32 numbers: a unit direction for each Gaussian, then points on the background sphere and a unit
// direction for each point. Writes float32 numbers to OUTPUTS: opacities, scales, quats, colours along the directions,
// background colours. Prints the lengths of the arrays. Gaussians are evaluated in two calls, the second of which
// starts at an index other than 0.

import { readFile, writeFile } from "node:fs/promises";

import { backgroundColors, colorsAlong, decodeGeometry, firstLayers } from "../../../hyrfpack/web/hyrf/fields.js";
import { read } from "../../../hyrfpack/web/hyrf/index.js";

const [file, inputs, outputs] = process.argv.slice(2);
const model = await read(new Uint8Array(await readFile(file)));
const { buffer } = new Uint8Array(await readFile(inputs));
const numbers = new Float32Array(buffer), { count } = model;
const pointsEnd = 3 * count + (numbers.length - 3 * count) / 2;
const points = numbers.subarray(3 * count, pointsEnd), pointDirections = numbers.subarray(pointsEnd);

const partEnd = Math.floor(count / 3), parts = [[0, partEnd], [partEnd, count]];
const shapes = parts.map(([start, stop]) => decodeGeometry(model, start, stop));
const colors = parts.map(([start, stop]) => {
  const layers = firstLayers(model, start, stop);
  return colorsAlong(model, layers, start, stop, numbers.subarray(3 * start, 3 * stop));
});
const arrays = ["opacities", "scales", "quats"].flatMap((name) => shapes.map((shape) => shape[name]));
arrays.push(...colors, backgroundColors(model, points, pointDirections));
await writeFile(outputs, Buffer.concat(arrays.map((array) => new Uint8Array(array.buffer))));
console.log(JSON.stringify(arrays.map((array) => array.length)));
