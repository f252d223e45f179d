// Streams a scene of several parts to a page that evaluates levels: `node stream_parts.mjs FOLDER GAUSSIANS`, with the
// budget GAUSSIANS until all is loaded that suits the view, and then without one. After the bytes of the long manifest,
// the first picture waits for one chunk alone.
//
// Prints, as JSON, `levels`: the number of levels that the page was sent; `most`: the largest number of further parts
// whose fields it held at a time; `again`: the number of parts that it was sent again; `early`: the number of levels that
// came without the fields of their part; `dropped`: the number of levels that were not evaluated when their fields were
// dropped; `kept`: the number of Gaussians that are drawn after the file of a part has become unusable; and `left`: of
// these, after the graphics device was lost.

import { readFileSync } from "node:fs";
import { setTimeout as wait } from "node:timers/promises";

import { streamScene } from "./copied_scene.mjs";

const [folder, budget] = process.argv.slice(2), POLL_MS = 20, EVALUATION_MS = 5, PADDING = 200_000;
globalThis.fetch = async (address) => new Response(readFileSync(`${folder}${new URL(address).pathname}`));
const manifest = JSON.parse(readFileSync(`${folder}/scene.json`));

const held = new Set(), everHeld = new Set(), waiting = [], levels = new Set();
const record = ({ chunk, level }) => levels.add(`${chunk} ${level}`);
const counts = { most: 0, again: 0, early: 0, dropped: 0 };
let state = null;
function hold({ part, model }) {
  if (!model) {
    held.delete(part);
    counts.dropped += waiting.filter((level) => level.part === part).length;
    return;
  }
  if (everHeld.has(part)) counts.again++;
  held.add(part);
  everHeld.add(part);
  counts.most = Math.max(counts.most, held.size);
}
const stream = streamScene(manifest, Number(budget), ({ content, part, chunk, state: newState }) => {
  for (const each of [...(content?.parts ?? []), ...(part ? [part] : [])]) hold(each);
  for (const first of content?.chunks ?? []) record(first);
  if (chunk) {
    if (chunk.part && !held.has(chunk.part)) counts.early++;
    record(chunk);
    waiting.push(chunk);
    setTimeout(() => {
      waiting.splice(waiting.indexOf(chunk), 1);
      stream.handle({ uploaded: chunk });
    }, EVALUATION_MS);
  }
  if (newState) state = newState;
}, PADDING);
while (!state?.isComplete) await wait(POLL_MS);
stream.handle({ gaussians: 1e9 });
while (!state.isComplete || state.gaussians !== manifest.gaussians) await wait(POLL_MS);
stream.reject(stream.parts[1].file, "it is gone.");
while (!state.isComplete || !state.problem) await wait(POLL_MS);
const kept = state.gaussians, answer = { levels: levels.size, ...counts, kept };
state = null;
stream.handle({ again: true }); // after the graphics device was lost
while (!state?.isComplete) await wait(POLL_MS);
stream.close();
console.log(JSON.stringify({ ...answer, left: state.gaussians }));
