// PlayCanvas SOG, version 2 (developer.playcanvas.com, "The SOG Format"): meta.json and lossless WebP pictures, bundled
// in a zip. A pixel of a picture belongs to a Gaussian, row by row from the top left.
//
//     means_l, means_u    RGB    low and high bytes of steps between means.mins and means.maxs, 65535 of them, of
//                                sign(x) log(1 + |x|)
//     scales              RGB    entries of scales.codebook: natural logarithms of standard deviations
//     quats               RGBA   127.5 + 127.5 sqrt(2) times the components but the largest, which is positive, in the
//                                order wxyz; A = 252 + the number of the largest
//     sh0                 RGBA   entries of sh0.codebook: harmonics of band 0; A = 255 opacity
//     shN_labels          RG     low and high bytes of the number of a palette row
//     shN_centroids       RGB    the palette, 64 rows side by side, a pixel for each coefficient of bands 1 and up:
//                                entries of shN.codebook

import { groupedDigits, quotedText } from "../../hyrf/errors.js";
import { HIGHER_HARMONICS_BY_DEGREE, SH_BAND_0 } from "../../hyrf/harmonics.js";
import { checkedSplats, refuseSplats } from "./checked.js";
import { readPicture } from "./picture.js";
import { writeQuat } from "./smallest_three.js";
import { ZipArchive } from "./zip.js";

const SOG_META = "meta.json", MOST_META = 1 << 20; // bytes
const SOG_PICTURES = { means: 2, scales: 1, quats: 1, sh0: 1, shN: 2 }; // of each group
const BOOK_ENTRIES = 256;
const ABREAST = 64; // palette rows side by side
const LARGEST_PALETTE = 65536; // that labels of 16 bits can name
const MOST_SOG_GAUSSIANS = 1 << 26;
const PADDED_PIXELS = 4, FREE_PIXELS = 1 << 16; // a picture has at most so many a Gaussian, and these
const UNEARNED = 1 << 20; // Gaussians that pictures of no size may hold; more need a byte each

/**
 * @param {Uint8Array} bytes
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>}
 * @throws {import("../../hyrf/errors.js").HyrfFormatError}
 */
export async function decodeSog(bytes) {
  const archive = new ZipArchive(bytes), meta = parseMeta(await archive.file(SOG_META, MOST_META));
  const files = new Map();
  let room = 2 * bytes.length + MOST_META, size = 0; // pictures are packed already: a zip gains little
  for (const [group, pictures] of Object.entries(SOG_PICTURES)) {
    for (let number = 0; number < pictures && (group !== "shN" || "shN" in meta); number++) {
      const name = pictureName(meta, group, number);
      if (files.has(name)) continue;
      files.set(name, await archive.file(name, room));
      room -= files.get(name).length;
      size += files.get(name).length;
    }
  }
  const { count } = meta;
  if (!Number.isInteger(count) || count < 0 || count > Math.min(MOST_SOG_GAUSSIANS, size + UNEARNED)) {
    refuseSplats(`its ${SOG_META} gives a wrong count of Gaussians for ${groupedDigits(size)} bytes; it is damaged`);
  }
  const books = new Map([["scales", book(meta, "scales")], ["sh0", book(meta, "sh0")]]);
  const mins = metaNumbers(meta, "means", "mins", 3), maxs = metaNumbers(meta, "means", "maxs", 3);
  const pixels = async (group, number = 0) => {
    const name = pictureName(meta, group, number);
    const picture = await readPicture(files.get(name), PADDED_PIXELS * count + FREE_PIXELS, quotedText(name));
    if (picture.width * picture.height >= count) return picture.pixels;
    return refuseSplats(`${quotedText(name)} in it has fewer pixels than it has Gaussians; it is damaged`);
  };

  const low = await pixels("means", 0), high = await pixels("means", 1), sizes = await pixels("scales");
  const turns = await pixels("quats"), tints = await pixels("sh0");
  const positions = new Float64Array(3 * count), scales = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count), opacities = new Float32Array(count), colors = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const at = 4 * i;
    for (let k = 0; k < 3; k++) {
      const steps = low[at + k] + 256 * high[at + k], drawnIn = mins[k] + (steps / 65535) * (maxs[k] - mins[k]);
      positions[3 * i + k] = Math.sign(drawnIn) * Math.expm1(Math.abs(drawnIn));
      scales[3 * i + k] = Math.exp(books.get("scales")[sizes[at + k]]);
      colors[3 * i + k] = 0.5 + SH_BAND_0 * books.get("sh0")[tints[at + k]];
    }
    opacities[i] = tints[at + 3] / 255;
    const largest = turns[at + 3] - 252;
    if (largest < 0) refuseSplats(`a rotation has the tag ${turns[at + 3]}, not 252 to 255; its picture is damaged`);
    const part = (k) => (turns[at + k] / 127.5 - 1) * Math.SQRT1_2;
    writeQuat(largest, part(0), part(1), part(2), quats, at);
  }
  const { degree, harmonic } = "shN" in meta ? await paletteOf(meta, files, pixels, count) : { degree: 0 };
  const antialiased = meta.antialias === true;
  return checkedSplats({ count, degree, antialiased, positions, scales, quats, opacities, colors }, harmonic);
}

// The harmonics of bands 1 and up: their degree, and what gives the number `at` of those of Gaussian i.
async function paletteOf(meta, files, pixels, count) {
  const name = pictureName(meta, "shN", 0), values = book(meta, "shN");
  const { width, height, pixels: entries } = await readPicture(files.get(name), LARGEST_PALETTE * 15, quotedText(name));
  const degree = HIGHER_HARMONICS_BY_DEGREE.indexOf(width / ABREAST), rows = height * ABREAST;
  if (degree < 1 || rows > LARGEST_PALETTE) {
    refuseSplats(`${quotedText(name)} in it is ${width} x ${height}, no palette of degree 1 to 3; it is damaged`);
  }
  const labels = await pixels("shN", 1), terms = HIGHER_HARMONICS_BY_DEGREE[degree];
  const label = (i) => labels[4 * i] + 256 * labels[4 * i + 1];
  for (let i = 0; i < count; i++) {
    if (label(i) >= rows) refuseSplats(`a label names row ${label(i)} of ${rows} of its palette; it is damaged`);
  }
  // Pixels of a row of the palette follow one another, and rows too: 64 of them fill a line of the picture.
  return { degree, harmonic: (i, at) => values[entries[4 * (label(i) * terms + Math.floor(at / 3)) + (at % 3)]] };
}

// --- meta.json -------------------------------------------------------------------------------------------------------

function parseMeta(bytes) {
  let meta;
  try {
    meta = JSON.parse(new TextDecoder().decode(bytes));
  } catch {
    refuseSplats(`its ${SOG_META} is not JSON; get the file again`);
  }
  if (typeof meta !== "object" || meta === null || Array.isArray(meta)) {
    refuseSplats(`its ${SOG_META} holds no SOG; it is damaged`);
  }
  if (meta.version !== 2) refuseSplats("it is not of version 2 of SOG, the one that is read; convert it");
  return meta;
}

// The name of a picture.
function pictureName(meta, group, number) {
  const name = meta[group]?.files?.[number];
  if (typeof name === "string" && name && name !== ".." && !/[/\\:\p{C}]/u.test(name)) return name;
  return refuseSplats(`its ${SOG_META} names no picture ${number + 1} of ${group}; it is damaged`);
}

// Finite numbers that float32 can hold.
function metaNumbers(meta, group, key, length) {
  const values = meta[group]?.[key];
  if (Array.isArray(values) && values.length === length) {
    const numbers = [...values], lost = length === BOOK_ENTRIES && numbers[0] === null; // by old writers
    if (lost) numbers[0] = 0;
    if (numbers.every((value) => typeof value === "number" && Math.abs(value) < 1e38)) {
      if (lost) numbers[0] = numbers[1] + (numbers[1] - numbers[length - 1]) / 255; // as PlayCanvas puts it back
      return numbers;
    }
  }
  return refuseSplats(`its ${SOG_META} needs ${length} finite numbers as ${group}.${key}; it is damaged`);
}

const book = (meta, group) => Float32Array.from(metaNumbers(meta, group, "codebook", BOOK_ENTRIES));
