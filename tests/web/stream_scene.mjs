// Streams a scene of copies of a chunk to a page that evaluates nothing at first: `node stream_scene.mjs FOLDER COPIES`.
//
// Prints, as JSON, `waiting`: the number of chunks that the page was sent until no more came; `all`: the number after it
// has evaluated them and those that came then; and `requests`: the number of requests for files.

import { readFileSync } from "node:fs";
import { setTimeout as wait } from "node:timers/promises";

globalThis.self = globalThis;
self.addEventListener = self.removeEventListener = () => {};
const { SceneStream } = await import("../../hyrfpack/web/viewer/stream/scene_stream.js");

const [folder, copies] = process.argv.slice(2), QUIET_MS = 1000;
const manifest = JSON.parse(readFileSync(`${folder}/scene.json`)), [chunk] = manifest.chunks, [level] = chunk.levels;
const rename = (_, number) => ({ ...chunk, levels: [{ ...level, file: `copy-${number}.hyrf` }] });
manifest.chunks = Array.from({ length: Number(copies) }, rename);
manifest.gaussians = copies * level.gaussians;

let requests = 0, isEvaluating = false;
globalThis.fetch = async (address) => {
  requests++;
  const name = new URL(address).pathname.slice(1);
  return new Response(readFileSync(`${folder}/${name.startsWith("copy-") ? level.file : name}`));
};
const sent = [];
const evaluate = ({ number, chunk, level }) => stream.handle({ uploaded: { number, chunk, level } });
const receive = (message) => {
  if (message.error) throw new Error(message.error);
  if (message.content) sent.push(...message.content.chunks);
  if (message.swap) setTimeout(() => stream.handle({ faded: message.swap }));
  if (!message.chunk) return;
  sent.push(message.chunk);
  if (isEvaluating) setTimeout(() => evaluate(message.chunk));
};
const request = { manifest: Buffer.from(JSON.stringify(manifest)), address: "http://host/scene.json", name: "scene" };
const sorter = { add: () => {} };
const stream = new SceneStream({ ...request, stage: null, gaussians: 1e6, maxRows: 4096 }, sorter, receive);

const countUntilQuiet = async () => {
  for (let before = -1; !sent.length || before !== sent.length;) {
    before = sent.length;
    await wait(QUIET_MS);
  }
  return sent.length;
};
const waiting = await countUntilQuiet();
isEvaluating = true;
for (const chunk of [...sent]) evaluate(chunk);
const all = await countUntilQuiet();
stream.close();
console.log(JSON.stringify({ waiting, all, requests }));
