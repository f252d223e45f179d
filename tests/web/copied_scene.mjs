// Streams scenes of copies of a chunk, without a browser.

import { readFileSync } from "node:fs";

globalThis.self = globalThis;
self.addEventListener = self.removeEventListener = () => {};
const { SceneStream } = await import("../../hyrfpack/web/viewer/stream/scene_stream.js");

export let requests = 0; // for files

// Returns a manifest of copies of the first level of the first chunk of a folder; `boxOf(number)` is {low, high}.
export function copyManifest(folder, copies, boxOf) {
  const manifest = JSON.parse(readFileSync(`${folder}/scene.json`)), [chunk] = manifest.chunks, [level] = chunk.levels;
  const copy = (_, number) => ({ ...chunk, ...boxOf(number), levels: [{ ...level, file: `copy-${number}.hyrf` }] });
  const gaussians = copies * level.gaussians;
  globalThis.fetch = async (address) => {
    requests++;
    const name = new URL(address).pathname.slice(1);
    return new Response(readFileSync(`${folder}/${name.startsWith("copy-") ? level.file : name}`));
  };
  return { ...manifest, gaussians, chunks: Array.from({ length: copies }, copy) };
}

// Streams a scene with at most `gaussians` in a view; `receive` gets the messages to the page. `padding` is the number of
// bytes after the manifest.
export function streamScene(manifest, gaussians, receive, padding = 0) {
  const text = JSON.stringify(manifest) + " ".repeat(padding);
  const request = { manifest: Buffer.from(text), address: "http://host/scene.json", name: "scene" };
  const sorter = { add: () => {} };
  const stream = new SceneStream({ ...request, views: null, gaussians, maxRows: 4096 }, sorter, (message) => {
    if (message.error) throw new Error(message.error);
    if (message.swap) setTimeout(() => stream.handle({ faded: message.swap }));
    receive(message);
  });
  return stream;
}
