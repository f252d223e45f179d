// Files of splats, read as the player reads them: `node decode.mjs OUTPUTS FILE...`. OUTPUTS is a folder that gets, for
// the file of each number, float32 positions, scales, quats, opacities, colours, one after the other, and the bytes of
// the harmonics. Prints a list with one entry a file: {error, kind}, or the rest of the splats. `kilobytes` is the
// most memory that the process had.

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
const status = await readFile("/proc/self/status", "utf-8").catch(() => ""); // of Linux
console.log(JSON.stringify({ answers, kilobytes: Number(/VmHWM:\s*(\d+)/.exec(status)?.[1] ?? 0) }));
