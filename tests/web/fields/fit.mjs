// Splats of a model: `node fit.mjs MODEL.hyrf CAMERAS.json DEGREE OUTPUTS`. For `null` in place of the list, those are
// taken that the file keeps, or else rings about it.
//
// OUTPUTS gets, one after the other, positions, scales, quats, opacities and colours as float32, and the bytes of the
// harmonics. Prints the rest of the splats, and how the work went.

import { readFile, writeFile } from "node:fs/promises";

import { fitHarmonics } from "../../../hyrfpack/web/hyrf/harmonics.js";
import { read } from "../../../hyrfpack/web/hyrf/index.js";
import { viewpointOf } from "../../../hyrfpack/web/hyrf/viewpoint.js";

const [file, cameras, degree, outputs] = process.argv.slice(2);
const model = await read(new Uint8Array(await readFile(file)));
const given = JSON.parse(await readFile(cameras, "utf-8"));
const progress = [], started = performance.now();
let coarse = null;
const splats = await fitHarmonics(model, given ?? viewpointOf(model.metadata).fitted, Number(degree), (step) => {
  progress.push(step.done);
  if (step.coarse) coarse = { after: progress.length, colors: Array.from(step.splats.colors.slice(0, 30)) };
});
const { positions, scales, quats, opacities, colors, harmonics, ...rest } = splats;
const parts = [positions, scales, quats, opacities, colors, harmonics];
await writeFile(outputs, Buffer.concat(parts.map((part) => new Uint8Array(part.buffer))));
console.log(JSON.stringify({ ...rest, progress, coarse, seconds: (performance.now() - started) / 1e3 }));
