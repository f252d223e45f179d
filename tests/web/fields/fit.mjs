// Fits splats to a model: `node fit.mjs MODEL.hyrf CAMERAS.json DEGREE OUTPUTS`. If CAMERAS.json is `null`, the cameras
// are those that `viewpointOf` chooses for fitting.
//
// Writes to OUTPUTS positions, scales, quats, opacities and colours as float32, then the bytes of the harmonics.
// Prints, as JSON, the other properties of the splats, all `progress` values, the `coarse` result ({after: the number
// of reports until then, colors: of the first 10 splats}) and the time in seconds.

import { readFile, writeFile } from "node:fs/promises";

import { fitHarmonics } from "../../../hyrfpack/web/hyrf/harmonics.js";
import { read } from "../../../hyrfpack/web/hyrf/index.js";
import { viewpointOf } from "../../../hyrfpack/web/hyrf/viewpoint.js";

const [file, cameras, degree, outputs] = process.argv.slice(2);
const model = await read(new Uint8Array(await readFile(file)));
const givenCameras = JSON.parse(await readFile(cameras, "utf-8"));
const progress = [], started = performance.now();
let coarse = null;
const splats = await fitHarmonics(model, givenCameras ?? viewpointOf(model.metadata).fitted, Number(degree), (step) => {
  progress.push(step.done);
  if (step.coarse) coarse = { after: progress.length, colors: Array.from(step.splats.colors.slice(0, 30)) };
});
const { positions, scales, quats, opacities, colors, harmonics, ...rest } = splats;
const parts = [positions, scales, quats, opacities, colors, harmonics];
await writeFile(outputs, Buffer.concat(parts.map((part) => new Uint8Array(part.buffer))));
console.log(JSON.stringify({ ...rest, progress, coarse, seconds: (performance.now() - started) / 1e3 }));
