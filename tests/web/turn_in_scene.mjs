// Looks ahead and then back in a scene of copies of a chunk: `node turn_in_scene.mjs FOLDER COPIES GAUSSIANS`. They lie in
// a square on the ground around the eye; GAUSSIANS is the budget.
//
// Prints, as JSON, `rows`: the height of the textures; `nearest`: the numbers of the 9 chunks around the eye; and `views`,
// for each view: the numbers of the `drawn` chunks, `resident`: the Gaussians in memory, and `ahead`: the part of the
// drawn chunks that are not behind the eye.

import { setTimeout as wait } from "node:timers/promises";

import { copyManifest, streamScene } from "./copied_scene.mjs";
import { viewOf } from "../../hyrfpack/web/viewer/camera.js";

const [folder, copies, budget] = process.argv.slice(2), side = Math.round(Math.sqrt(copies)), middle = side >> 1;
const POLL_MS = 20;
const placeOf = (number) => [(number % side) - middle, Math.floor(number / side) - middle];
const boxOf = (number) => {
  const [x, z] = placeOf(number);
  return { low: [x - 0.5, -0.5, z - 0.5], high: [x + 0.5, 0.5, z + 0.5] };
};
const manifest = copyManifest(folder, Number(copies), boxOf);
manifest.frame = { center: [0, 0, 0], scale: 1, half_extent: [1, 1, 1] };

const drawn = new Set();
let state = null, scene = null, rows = 0;
const stream = streamScene(manifest, Number(budget), ({ content, chunk, swap, state: newState }) => {
  if (content) {
    ({ scene, models: [{ height: rows }] } = content);
    for (const first of content.chunks) drawn.add(first.chunk);
  }
  if (chunk) setTimeout(() => stream.handle({ uploaded: chunk }));
  if (swap?.to.length) drawn.add(swap.chunk);
  else if (swap) drawn.delete(swap.chunk);
  if (newState) state = newState;
});
while (!scene) await wait(POLL_MS);

const look = async (ticket, sign) => {
  const camera_from_world = [[sign, 0, 0, 0], [0, 1, 0, 0], [0, 0, sign, 0]];
  const camera = { width: 100, height: 100, fx: 50, fy: 50, cx: 50, cy: 50, camera_from_world };
  stream.handle({ look: { ticket, view: viewOf(camera, scene) } });
  while (state?.ticket !== ticket || !state.isComplete) await wait(POLL_MS);
  const ahead = [...drawn].filter((number) => sign * placeOf(number)[1] >= 0).length / drawn.size;
  return { drawn: [...drawn], resident: state.resident, ahead };
};
const views = [await look(1, 1), await look(2, -1)];
const numbers = Array.from({ length: Number(copies) }, (_, number) => number);
const nearest = numbers.filter((number) => placeOf(number).every((value) => Math.abs(value) <= 1));
stream.close();
console.log(JSON.stringify({ rows, views, nearest }));
