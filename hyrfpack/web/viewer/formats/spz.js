// Niantic's SPZ (https://github.com/nianticlabs/spz), versions 1 to 4. After a header of 16 bytes ("NGSP", version,
// count, degree, fractional bits, flags) an attribute after the other, a few bytes for each Gaussian:
//
//     positions   3 x 24 bit   fixed point, little-endian (version 1: 3 float16)
//     opacities   1 byte       o * 255
//     colours     3 bytes      (0.5 + 0.15 k) * 255 of the harmonics k of degree 0
//     scales      3 bytes      (ln s + 10) * 16
//     rotations   4 bytes      smallest three (before version 3: 3 bytes, (q + 1) * 127.5 of x, y, z)
//     harmonics   3 (K - 1)    (k + 1) * 128 of the degrees from 1, one basis function after the other, RGB each
//
// Up to version 3 the whole is one gzip stream. Version 4 has a plain header of 32 bytes, perhaps extensions, a table
// of the streams' lengths, and a zstd stream for each attribute that is not empty.
//
// Axes are RUB; they are turned by half a turn about x, as all programs do that write other files from these.

import { groupedDigits } from "../../hyrf/errors.js";
import { HIGHER_HARMONICS_BY_DEGREE, SH_BAND_0 } from "../../hyrf/harmonics.js";
import { checkedSplats, refuseSplats } from "./checked.js";
import { writeQuat } from "./smallest_three.js";
import { Unpacker } from "./unpack.js";

const SPZ_MARK = 0x5053474e; // "NGSP"
const SPZ_HEADER = 16, SPZ_HEADER_4 = 32, STREAM_ENTRY = 16; // bytes
const FLAG_ANTIALIASED = 0x01, FLAG_EXTENDED = 0x02, FLAG_TREE = 0x80;
const TERMS_IN_FILE = [0, 3, 8, 15, 24]; // beside the first; degree 4 is left out here
// Sections far smaller than what they unpack to are a trap; real scenes do not even reach 20.
const FREE_SPZ_BYTES = 1 << 26, HIGHEST_SPZ_RATIO = 100;
const XYZW = [1, 2, 3, 0]; // where the components of a file's quaternion go in wxyz
// What half a turn about x does to each of the harmonics.
const TURNED_SIGNS = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];

/**
 * @param {Uint8Array} bytes
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>}
 * @throws {import("../../hyrf/errors.js").HyrfFormatError}
 */
export async function decodeSpz(bytes) {
  if (bytes[0] === 0x1f && bytes[1] === 0x8b) return splatsOfSpz(...(await gzippedSections(bytes)));
  if (bytes.length >= 4 && viewOfBytes(bytes).getUint32(0, true) === SPZ_MARK) {
    return splatsOfSpz(...(await zstdSections(bytes)));
  }
  return refuseSplats("this is not an SPZ file, for it starts with neither gzip's nor SPZ's own mark");
}

const viewOfBytes = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.length);

function splatsOfSpz({ version, count, degree, bits, flags }, [places, alphas, tints, sizes, turns, rest]) {
  const positions = new Float64Array(3 * count), scales = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count), opacities = new Float32Array(count), colors = new Float32Array(3 * count);
  const words = viewOfBytes(turns), halfs = viewOfBytes(places), step = 2 ** -bits;
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
      const from = 3 * i + k, sign = k ? -1 : 1, at = 3 * from;
      const place = version === 1 ? halfFloat(halfs.getUint16(2 * from, true)) : signed24(places, at) * step;
      positions[from] = sign * place;
      scales[from] = Math.exp(sizes[from] / 16 - 10);
      colors[from] = 0.5 + (SH_BAND_0 * (tints[from] / 255 - 0.5)) / 0.15;
    }
    opacities[i] = alphas[i] / 255;
    const at = 4 * i;
    if (version >= 3) {
      const word = words.getUint32(at, true);
      writeQuat(word >>> 30, signedSize(word >>> 20), signedSize(word >>> 10), signedSize(word), quats, at, XYZW);
    } else {
      const x = turns[3 * i] / 127.5 - 1, y = turns[3 * i + 1] / 127.5 - 1, z = turns[3 * i + 2] / 127.5 - 1;
      writeQuat(3, x, y, z, quats, at, XYZW);
    }
    quats[at + 2] *= -1;
    quats[at + 3] *= -1;
  }
  const stride = 3 * TERMS_IN_FILE[degree], shown = Math.min(degree, 3), antialiased = (flags & FLAG_ANTIALIASED) > 0;
  const harmonic = (i, at) => (TURNED_SIGNS[Math.floor(at / 3)] * (rest[stride * i + at] - 128)) / 128;
  const numbers = { count, degree: shown, antialiased, positions, scales, quats, opacities, colors, range: 1 };
  return checkedSplats(numbers, harmonic);
}

const signed24 = (bytes, at) => ((bytes[at] << 8) | (bytes[at + 1] << 16) | (bytes[at + 2] << 24)) >> 8;

// A component of a rotation: a sign and 9 bits of the magnitude, of which 511 is sqrt(1/2).
const signedSize = (code) => ((code & 512 ? -1 : 1) * (code & 511)) / (511 * Math.SQRT2);

function halfFloat(bits) {
  const sign = bits >> 15 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction);
}

// --- containers ------------------------------------------------------------------------------------------------------

function readSpzHeader(bytes, versions, stored) {
  if (bytes.length < SPZ_HEADER) refuseSplats("it ends within its header; it is truncated");
  const view = viewOfBytes(bytes), [magic, version, count] = [0, 4, 8].map((at) => view.getUint32(at, true));
  const [degree, bits, flags, streams] = [12, 13, 14, 15].map((at) => bytes[at]);
  if (magic !== SPZ_MARK) refuseSplats("this is not an SPZ file, for its contents do not start with 'NGSP'");
  if (!versions.includes(version)) {
    const known = "versions 1 to 3 (gzip) and 4 (plain header) can be read";
    refuseSplats(`this is SPZ version ${version}, and ${known}; export it as one of these`);
  }
  if (degree >= TERMS_IN_FILE.length || bits > 31) {
    const found = `harmonics of degree ${degree} and ${bits} fractional bits`;
    refuseSplats(`its header says ${found}, and 4 and 31 are the most; it is damaged`);
  }
  if (flags & FLAG_TREE) refuseSplats("it holds a tree of coarse copies for levels of detail; export it without them");
  const each = [version === 1 ? 6 : 9, 1, 3, 3, version >= 3 ? 4 : 3, 3 * TERMS_IN_FILE[degree]];
  const lengths = each.map((length) => count * length), length = lengths.reduce((sum, own) => sum + own);
  if (length > FREE_SPZ_BYTES && length > HIGHEST_SPZ_RATIO * stored) {
    const found = `${groupedDigits(count)} Gaussians, far more than ${groupedDigits(stored)} bytes can hold`;
    refuseSplats(`its header says ${found}; it is damaged`);
  }
  return { version, count, degree, bits, flags, streams, lengths, length };
}

const endsBefore = (count) => refuseSplats(`it ends before its ${groupedDigits(count)} Gaussians do; it is truncated`);

// Header and sections of versions 1 to 3.
async function gzippedSections(bytes) {
  const unpacker = new Unpacker(bytes, "gzip");
  try {
    const header = readSpzHeader(await unpacker.take(SPZ_HEADER), [1, 2, 3], bytes.length), { count, length } = header;
    const content = await unpacker.take(length);
    if (content.length < length) endsBefore(count);
    if (!(header.flags & FLAG_EXTENDED) && (await unpacker.more())) {
      refuseSplats(`it goes on after its ${groupedDigits(count)} Gaussians; it is damaged`);
    }
    let place = 0;
    return [header, header.lengths.map((own) => content.subarray(place, (place += own)))];
  } finally {
    unpacker.close();
  }
}

// Header and sections of version 4.
async function zstdSections(bytes) {
  const header = readSpzHeader(bytes, [4], bytes.length), { count, degree, streams, lengths } = header;
  if (bytes.length < SPZ_HEADER_4) refuseSplats("it ends within its header; it is truncated");
  if (streams !== lengths.filter(Boolean).length) {
    const wanted = `harmonics of degree ${degree} and ${groupedDigits(count)} Gaussians`;
    refuseSplats(`${streams} streams do not fit ${wanted}; it is damaged`);
  }
  const view = viewOfBytes(bytes), table = view.getUint32(SPZ_HEADER, true);
  let entry = table, place = table + streams * STREAM_ENTRY;
  if (table < SPZ_HEADER_4 || place > bytes.length) {
    refuseSplats("its table of contents lies outside of it; it is damaged or truncated");
  }
  const sections = [];
  for (const length of lengths) {
    if (!length) {
      sections.push(new Uint8Array(0));
      continue;
    }
    const [stored, raw] = [entry, entry + 8].map((at) => Number(view.getBigUint64(at, true)));
    entry += STREAM_ENTRY;
    if (raw !== length) {
      const wanted = `where ${groupedDigits(count)} Gaussians need ${groupedDigits(length)}`;
      refuseSplats(`a stream of ${groupedDigits(raw)} bytes stands ${wanted}; it is damaged`);
    }
    if (stored > bytes.length - place) endsBefore(count);
    sections.push(await unpackedSection(bytes.subarray(place, place + stored), length));
    place += stored;
  }
  return [header, sections];
}

async function unpackedSection(bytes, length) {
  const unpacker = new Unpacker(bytes, "zstd");
  try {
    const content = await unpacker.take(length);
    if (content.length < length || (await unpacker.more())) {
      refuseSplats(`a zstd stream does not hold the ${groupedDigits(length)} bytes it should; it is damaged`);
    }
    return content;
  } finally {
    unpacker.close();
  }
}
