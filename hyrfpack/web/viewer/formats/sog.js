// Reads PlayCanvas SOG, version 2 (developer.playcanvas.com, "The SOG Format"): meta.json and lossless WebP pictures in
// a zip archive. Each pixel of a picture belongs to a Gaussian, row by row from the top left.
//
//     means_l, means_u    RGB    low and high bytes of sign(x) log(1 + |x|), in 65535 steps from means.mins to
//                                means.maxs
//     scales              RGB    entries of scales.codebook: natural logarithms of standard deviations
//     quats               RGBA   127.5 + 127.5 sqrt(2) q for the three smallest components q, in the order wxyz; the
//                                largest is positive, and A = 252 + its index
//     sh0                 RGBA   entries of sh0.codebook: harmonics of band 0; A = 255 opacity
//     shN_labels          RG     low and high bytes of the index of a palette row
//     shN_centroids       RGB    the palette: 64 rows side by side, one pixel per coefficient of bands 1 and up, with
//                                entries of shN.codebook

import { groupedDigits, quotedText } from "../../hyrf/errors.js";
import { SH_BAND_0 } from "../../hyrf/basis.js";
import { HIGHER_HARMONICS_BY_DEGREE } from "../../hyrf/harmonics.js";
import { normalizeSplats, rejectSplats } from "./normalize.js";
import { readPicture } from "./picture.js";
import { writeQuat } from "./smallest_three.js";
import { ZipArchive } from "./zip.js";

const SOG_META_FILE = "meta.json";
const MAX_SOG_META_BYTES = 1 << 20;
const PICTURES_BY_GROUP = { means: 2, scales: 1, quats: 1, sh0: 1, shN: 2 };
const CODEBOOK_ENTRIES = 256;
const PALETTE_ROWS_PER_LINE = 64;
const MAX_PALETTE_ROWS = 65536; // because labels have 16 bits
const MAX_SOG_GAUSSIANS = 1 << 26;
// A picture of n Gaussians may have at most MAX_PIXELS_PER_GAUSSIAN n + BASE_PIXELS pixels.
const MAX_PIXELS_PER_GAUSSIAN = 4;
const BASE_PIXELS = 1 << 16;
// Pictures of n bytes may have at most n + BASE_SOG_GAUSSIANS Gaussians.
const BASE_SOG_GAUSSIANS = 1 << 20;

/**
 * Reads the splats of a SOG file.
 * @param {Uint8Array} bytes the whole file
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>}
 * @throws {import("../../hyrf/errors.js").HyrfFormatError} the file is damaged
 */
export async function decodeSog(bytes) {
  const archive = new ZipArchive(bytes), meta = parseSogMeta(await archive.file(SOG_META_FILE, MAX_SOG_META_BYTES));
  const files = new Map();
  // The zip archive saves little, because pictures are compressed already.
  let room = 2 * bytes.length + MAX_SOG_META_BYTES, size = 0;
  for (const [group, pictures] of Object.entries(PICTURES_BY_GROUP)) {
    for (let number = 0; number < pictures && (group !== "shN" || "shN" in meta); number++) {
      const name = pictureName(meta, group, number);
      if (files.has(name)) continue;
      files.set(name, await archive.file(name, room));
      room -= files.get(name).length;
      size += files.get(name).length;
    }
  }
  const { count } = meta;
  if (!Number.isInteger(count) || count < 0 || count > Math.min(MAX_SOG_GAUSSIANS, size + BASE_SOG_GAUSSIANS)) {
    const found = `a wrong count of Gaussians for ${groupedDigits(size)} bytes`;
    rejectSplats(`its ${SOG_META_FILE} gives ${found}; it is damaged`);
  }
  const codebooks = new Map([["scales", readCodebook(meta, "scales")], ["sh0", readCodebook(meta, "sh0")]]);
  const mins = readMetaNumbers(meta, "means", "mins", 3), maxs = readMetaNumbers(meta, "means", "maxs", 3);
  const pixels = async (group, number = 0) => {
    const name = pictureName(meta, group, number);
    const picture = await readPicture(files.get(name), MAX_PIXELS_PER_GAUSSIAN * count + BASE_PIXELS, quotedText(name));
    if (picture.width * picture.height >= count) return picture.pixels;
    return rejectSplats(`${quotedText(name)} in it has fewer pixels than it has Gaussians; it is damaged`);
  };

  const low = await pixels("means", 0), high = await pixels("means", 1), sizes = await pixels("scales");
  const turns = await pixels("quats"), tints = await pixels("sh0");
  const positions = new Float64Array(3 * count), scales = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count), opacities = new Float32Array(count), colors = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const at = 4 * i;
    for (let k = 0; k < 3; k++) {
      const steps = low[at + k] + 256 * high[at + k], logPosition = mins[k] + (steps / 65535) * (maxs[k] - mins[k]);
      positions[3 * i + k] = Math.sign(logPosition) * Math.expm1(Math.abs(logPosition));
      scales[3 * i + k] = Math.exp(codebooks.get("scales")[sizes[at + k]]);
      colors[3 * i + k] = 0.5 + SH_BAND_0 * codebooks.get("sh0")[tints[at + k]];
    }
    opacities[i] = tints[at + 3] / 255;
    const largest = turns[at + 3] - 252;
    if (largest < 0) rejectSplats(`a rotation has the tag ${turns[at + 3]}, not 252 to 255; its picture is damaged`);
    const part = (k) => (turns[at + k] / 127.5 - 1) * Math.SQRT1_2;
    writeQuat(largest, part(0), part(1), part(2), quats, at);
  }
  const { degree, harmonic } = "shN" in meta ? await readPalette(meta, files, pixels, count) : { degree: 0 };
  const antialiased = meta.antialias === true;
  return normalizeSplats({ count, degree, antialiased, positions, scales, quats, opacities, colors }, harmonic);
}

// Reads the harmonics of bands 1 and up. Returns their degree, and a function of Gaussian i and the index of a number.
async function readPalette(meta, files, pixels, count) {
  const name = pictureName(meta, "shN", 0), values = readCodebook(meta, "shN");
  const picture = await readPicture(files.get(name), MAX_PALETTE_ROWS * 15, quotedText(name));
  const { width, height, pixels: entries } = picture;
  const degree = HIGHER_HARMONICS_BY_DEGREE.indexOf(width / PALETTE_ROWS_PER_LINE);
  const rows = height * PALETTE_ROWS_PER_LINE;
  if (degree < 1 || rows > MAX_PALETTE_ROWS) {
    rejectSplats(`${quotedText(name)} in it is ${width} x ${height}, no palette of degree 1 to 3; it is damaged`);
  }
  const labels = await pixels("shN", 1), terms = HIGHER_HARMONICS_BY_DEGREE[degree];
  const label = (i) => labels[4 * i] + 256 * labels[4 * i + 1];
  for (let i = 0; i < count; i++) {
    if (label(i) >= rows) rejectSplats(`a label names row ${label(i)} of ${rows} of its palette; it is damaged`);
  }
  // The pixels of a palette row are adjacent, and 64 adjacent rows fill a line of the picture.
  return { degree, harmonic: (i, at) => values[entries[4 * (label(i) * terms + Math.floor(at / 3)) + (at % 3)]] };
}

// --- meta.json -------------------------------------------------------------------------------------------------------

// Parses meta.json and checks its version.
function parseSogMeta(bytes) {
  let meta;
  try {
    meta = JSON.parse(new TextDecoder().decode(bytes));
  } catch {
    rejectSplats(`its ${SOG_META_FILE} is not JSON; get the file again`);
  }
  if (typeof meta !== "object" || meta === null || Array.isArray(meta)) {
    rejectSplats(`its ${SOG_META_FILE} holds no SOG; it is damaged`);
  }
  if (meta.version !== 2) rejectSplats("it is not of version 2 of SOG, the one that is read; convert it");
  return meta;
}

// Returns the file name of a picture of a group.
function pictureName(meta, group, number) {
  const name = meta[group]?.files?.[number];
  if (typeof name === "string" && name && name !== ".." && !/[/\\:\p{C}]/u.test(name)) return name;
  return rejectSplats(`its ${SOG_META_FILE} names no picture ${number + 1} of ${group}; it is damaged`);
}

// Returns a list of numbers of meta.json that are finite in float32.
function readMetaNumbers(meta, group, key, length) {
  const values = meta[group]?.[key];
  if (Array.isArray(values) && values.length === length) {
    const numbers = [...values];
    const isFirstLost = length === CODEBOOK_ENTRIES && numbers[0] === null; // old writers lost the first entry
    if (isFirstLost) numbers[0] = 0;
    if (numbers.every((value) => typeof value === "number" && Math.abs(value) < 1e38)) {
      // PlayCanvas restores a lost entry as this value.
      if (isFirstLost) numbers[0] = numbers[1] + (numbers[1] - numbers[length - 1]) / 255;
      return numbers;
    }
  }
  return rejectSplats(`its ${SOG_META_FILE} needs ${length} finite numbers as ${group}.${key}; it is damaged`);
}

// Returns the codebook of a group.
const readCodebook = (meta, group) => Float32Array.from(readMetaNumbers(meta, group, "codebook", CODEBOOK_ENTRIES));
