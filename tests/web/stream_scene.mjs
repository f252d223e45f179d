// Streams a scene of copies of a chunk to a page that evaluates nothing at first: `node stream_scene.mjs FOLDER COPIES`.
//
// Prints, as JSON, `waiting`: the number of chunks that the page was sent until no more came; `all`: the number after it
// has evaluated them and those that came then; and `requests`: the number of requests for files.

import { setTimeout as wait } from "node:timers/promises";

import { copyManifest, requests, streamScene } from "./copied_scene.mjs";

const [folder, copies] = process.argv.slice(2), QUIET_MS = 1000;
const sent = [];
let isEvaluating = false;
const evaluate = ({ number, chunk, level }) => stream.handle({ uploaded: { number, chunk, level } });
const stream = streamScene(copyManifest(folder, Number(copies), () => ({})), 1e6, ({ content, chunk }) => {
  if (content) sent.push(...content.chunks);
  if (!chunk) return;
  sent.push(chunk);
  if (isEvaluating) setTimeout(() => evaluate(chunk));
});

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
