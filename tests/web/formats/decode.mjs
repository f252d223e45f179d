// Reads files of splats with the player's readers: `node decode.mjs OUTPUTS FILE...`. For file number k, writes to
// OUTPUTS/k positions, scales, quats, opacities and colours as float32, then the bytes of the harmonics.
//
// Prints {answers, kilobytes} as JSON. `answers` has, for each file, {error, kind} or the other properties of its
// splats. `kilobytes` is the maximum memory of the process (0 on other systems than Linux).

import { readFile, writeFile } from "node:fs/promises";
import { basename } from "node:path";

import { decodeSplats } from "../../../hyrfpack/web/viewer/formats/index.js";

const [folder, ...files] = process.argv.slice(2), answers = [];
for (const [number, file] of files.entries()) {
  try {
    const splats = await decodeSplats(basename(file), new Uint8Array(await readFile(file)));
    const { positions, scales, quats, opacities, colors, harmonics, ...rest } = splats;
    const parts = [positions, scales, quats, opacities, colors, harmonics];
    await writeFile(`${folder}/${number}`, Buffer.concat(parts.map((part) => new Uint8Array(part.buffer))));
    answers.push(rest);
  } catch (error) {
    answers.push({ error: error.message, kind: error.name });
  }
}
const status = await readFile("/proc/self/status", "utf-8").catch(() => "");
console.log(JSON.stringify({ answers, kilobytes: Number(/VmHWM:\s*(\d+)/.exec(status)?.[1] ?? 0) }));
