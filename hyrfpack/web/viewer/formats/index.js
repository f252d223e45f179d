// Files of splats that the player takes: which reader is for which, by how they begin and what they are called.

import { refuseSplats } from "./checked.js";
import { decodePly } from "./ply.js";
import { decodeSog } from "./sog.js";
import { decodeSplat } from "./splat.js";
import { decodeSpz } from "./spz.js";

/** Endings of their names. */
export const SPLAT_ENDINGS = [".ply", ".spz", ".splat", ".sog"];

const READERS = [decodePly, decodeSpz, decodeSplat, decodeSog];
const MARKS = [["ply", decodePly], ["\x1f\x8b", decodeSpz], ["NGSP", decodeSpz], ["PK", decodeSog]];

/**
 * Read a file of splats. A worker is the place for it: large files take seconds.
 * @param {string} name of the file, of which the ending counts; without one, how it begins
 * @param {Uint8Array} bytes
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>} axes are those of the file's world
 * @throws {import("../../hyrf/errors.js").HyrfFormatError}
 */
export async function decodeSplats(name, bytes) {
  const ending = SPLAT_ENDINGS.findIndex((known) => name.toLowerCase().endsWith(known));
  const starts = ([mark]) => [...mark].every((letter, k) => bytes[k] === letter.charCodeAt(0));
  const reader = READERS[ending] ?? MARKS.find(starts)?.[1];
  return reader ? reader(bytes) : refuseSplats(`it is none of ${SPLAT_ENDINGS.join(", ")}; convert it to one of them`);
}
