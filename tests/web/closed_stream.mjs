// Streams a scene of copies of a chunk and closes the stream while chunks are decoded: `node closed_stream.mjs FOLDER`.
//
// Prints, as JSON, `late`: the number of requests for files after that; `refused`: for an answer that is longer than the
// manifest says, and for one of a missing file, whether its request is cancelled; `partials`: the number of files whose
// beginnings are kept after the requests for 100 files were cancelled one after the other; `breaks`: how often the
// connection breaks within a file before it is given up, if its request was cancelled 25 times before; `bytes`: of a
// file of 10 bytes that was received twice; and `sentence`: what the page is told if memory is too short for the first
// picture.

import { setTimeout as wait } from "node:timers/promises";

import { copyManifest, requests, streamScene } from "./copied_scene.mjs";
import { crc32 } from "../../hyrfpack/web/hyrf/crc.js";
import { ScenePart } from "../../hyrfpack/web/viewer/stream/scene_part.js";
import { FileQueue } from "../../hyrfpack/web/viewer/stream/file_queue.js";

const QUIET_MS = 500;
let requested = null;
const stream = streamScene(copyManifest(process.argv[2], 700, () => ({})), 1e6, ({ chunk }) => {
  if (!chunk || requested !== null) return;
  stream.handle({ close: true });
  requested = requests;
});
while (requested === null) await wait(20);
await wait(QUIET_MS);
const late = requests - requested;

const file = { file: "a.hyrf", bytes: 10, crc32: "00000000" };
const refused = [];
for (const [length, status] of [[11, 200], [0, 404]]) {
  const queue = new FileQueue("http://host/", {
    received: () => {}, failed: () => {}, changed: () => {},
    send: async (_, { signal }) => {
      const start = (controller) => controller.enqueue(new Uint8Array(length || 1)); // and it never ends
      signal.addEventListener("abort", () => refused.push(status));
      return new Response(new ReadableStream({ start }), { status });
    },
  });
  queue.want([file]);
  await wait(20);
}

const queue = new FileQueue("http://host/", {
  received: () => {}, failed: () => {}, changed: () => {},
  send: async () => new Response(new ReadableStream({ start: (controller) => controller.enqueue(new Uint8Array(1)) })),
});
for (let number = 0; number < 100; number++) {
  queue.want([{ ...file, file: `${number}.hyrf` }]);
  await wait(1);
}
queue.close();

let body = null, isGivenUp = false, breaks = 0;
const broken = new FileQueue("http://host/", {
  received: () => {}, failed: () => (isGivenUp = true), changed: () => {},
  send: async (_, { signal }) => {
    const start = (controller) => {
      body = controller;
      body.enqueue(new Uint8Array(1));
    };
    signal.addEventListener("abort", () => body.error(signal.reason));
    return new Response(new ReadableStream({ start }));
  },
});
for (let count = 0; count < 25; count++) {
  broken.want([file]);
  await wait(5);
  broken.want([]);
  await wait(5);
}
broken.want([file]);
while (!isGivenUp && breaks < 100) {
  await wait(5);
  body.error(new Error("the connection was reset"));
  breaks++;
  await wait(5);
  broken.resume();
}

const data = new Uint8Array(10), whole = { ...file, crc32: crc32(data).toString(16).padStart(8, "0") };
let times = 0;
const repeated = new FileQueue("http://host/", {
  received: () => times++, failed: () => {}, changed: () => {}, send: async () => new Response(data),
});
for (const wanted of [1, 2]) {
  repeated.want([whole]);
  while (times < wanted) await wait(5);
}

let sentence = null;
ScenePart.prototype.pack = async () => {
  throw new RangeError("Array buffer allocation failed");
};
process.once("unhandledRejection", ({ message }) => (sentence = message)); // streamScene throws what the page is told
streamScene(copyManifest(process.argv[2], 5, () => ({})), 1e6, () => {});
while (sentence === null) await wait(20);
console.log(JSON.stringify({ sentence, late, refused, partials: queue.partials.size, breaks, bytes: repeated.bytes }));
process.exit();
