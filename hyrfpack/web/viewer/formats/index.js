// Chooses the reader of a file of splats by the ending of its name or by its first bytes.

import { rejectSplats } from "./normalize.js";
import { decodePly } from "./ply.js";
import { decodeSog } from "./sog.js";
import { decodeSplat } from "./splat.js";
import { decodeSpz } from "./spz.js";

/** The endings of the names of files of splats. */
export const SPLAT_ENDINGS = [".ply", ".spz", ".splat", ".sog"];

const NO_FORMAT_TEXT =
  `it is neither a .hyrf file nor one of ${SPLAT_ENDINGS.join(", ")}; fetch it again, or convert it`;
const READERS_BY_ENDING = [decodePly, decodeSpz, decodeSplat, decodeSog];
const READERS_BY_SIGNATURE = [["ply", decodePly], ["\x1f\x8b", decodeSpz], ["NGSP", decodeSpz], ["PK", decodeSog]];

/**
 * Reads a file of splats. Large files take seconds, so it should be called in a worker.
 * @param {string} name the file's name; if its ending is unknown, the first bytes determine the format
 * @param {Uint8Array} bytes the whole file
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>} in the axes of the file
 * @throws {import("../../hyrf/errors.js").HyrfFormatError} the file is damaged, or its format is unknown
 */
export async function decodeSplats(name, bytes) {
  const ending = SPLAT_ENDINGS.findIndex((known) => name.toLowerCase().endsWith(known));
  const isAtStart = ([mark]) => [...mark].every((letter, k) => bytes[k] === letter.charCodeAt(0));
  const reader = READERS_BY_ENDING[ending] ?? READERS_BY_SIGNATURE.find(isAtStart)?.[1];
  return reader ? reader(bytes) : rejectSplats(NO_FORMAT_TEXT);
}
