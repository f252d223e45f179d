// Reads Niantic's SPZ (https://github.com/nianticlabs/spz), versions 1 to 4. A header of 16 bytes ("NGSP", version,
// count, degree, fractional bits, flags) is followed by the attributes, each with a few bytes for each Gaussian:
//
//     positions   3 x 24 bit   fixed point, little-endian (version 1: 3 float16)
//     opacities   1 byte       o * 255
//     colours     3 bytes      (0.5 + 0.15 k) * 255 of the harmonics k of degree 0
//     scales      3 bytes      (ln s + 10) * 16
//     rotations   4 bytes      smallest three (before version 3: 3 bytes, (q + 1) * 127.5 of x, y, z)
//     harmonics   3 (K - 1)    (k + 1) * 128 of the degrees from 1 on, as RGB for each basis function
//
// Up to version 3 the whole file is one gzip stream. Version 4 has an uncompressed header of 32 bytes, optional
// extensions, a table of the streams' lengths, and a zstd stream for each attribute that is not empty.
//
// The axes are right, up, back. They are rotated by half a turn about x, as other converters do.

import { groupedDigits } from "../../hyrf/errors.js";
import { SH_BAND_0 } from "../../hyrf/basis.js";
import { HIGHER_HARMONICS_BY_DEGREE } from "../../hyrf/harmonics.js";
import { halfToNumber } from "../../hyrf/plain.js";
import { normalizeSplats, rejectSplats } from "./normalize.js";
import { writeQuat } from "./smallest_three.js";
import { Unpacker } from "./unpack.js";

const SPZ_MAGIC = 0x5053474e; // "NGSP"
const SPZ_HEADER_BYTES = 16;
const SPZ_HEADER_BYTES_V4 = 32;
const STREAM_ENTRY_BYTES = 16;
const FLAG_ANTIALIASED = 0x01, FLAG_EXTENDED = 0x02, FLAG_LOD_TREE = 0x80;
const SPZ_HARMONICS_BY_DEGREE = [0, 3, 8, 15, 24]; // without degree 0; degree 4 is read but not used
// A file may unpack to BASE_UNPACKED_BYTES, or to MAX_UNPACKED_BYTES_PER_BYTE times its size. Real scenes need less
// than 20 times their size.
const BASE_UNPACKED_BYTES = 1 << 26;
const MAX_UNPACKED_BYTES_PER_BYTE = 100;
const WXYZ_INDEX_OF_XYZW = [1, 2, 3, 0]; // the components of a file's quaternion are x, y, z, w
// Half a turn about x multiplies the harmonics of degree 1 and higher by these factors.
const SIGNS_AFTER_HALF_TURN = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];

/**
 * Reads the splats of an SPZ file.
 * @param {Uint8Array} bytes the whole file
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>}
 * @throws {import("../../hyrf/errors.js").HyrfFormatError} the file is damaged
 */
export async function decodeSpz(bytes) {
  if (bytes[0] === 0x1f && bytes[1] === 0x8b) return decodeSections(...(await readGzipSections(bytes)));
  if (bytes.length >= 4 && dataView(bytes).getUint32(0, true) === SPZ_MAGIC) {
    return decodeSections(...(await readZstdSections(bytes)));
  }
  return rejectSplats("this is not an SPZ file, for it starts with neither gzip's nor SPZ's own mark");
}

const dataView = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.length);

// Decodes the sections of all attributes.
function decodeSections({ version, count, degree, bits, flags }, [places, alphas, tints, sizes, turns, rest]) {
  const positions = new Float64Array(3 * count), scales = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count), opacities = new Float32Array(count), colors = new Float32Array(3 * count);
  const words = dataView(turns), halfs = dataView(places), step = 2 ** -bits;
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
      const from = 3 * i + k, sign = k ? -1 : 1, at = 3 * from;
      const place = version === 1 ? halfToNumber(halfs.getUint16(2 * from, true)) : decodeInt24(places, at) * step;
      positions[from] = sign * place;
      scales[from] = Math.exp(sizes[from] / 16 - 10);
      colors[from] = 0.5 + (SH_BAND_0 * (tints[from] / 255 - 0.5)) / 0.15;
    }
    opacities[i] = alphas[i] / 255;
    const at = 4 * i;
    if (version >= 3) {
      const word = words.getUint32(at, true);
      const a = decodeQuatComponent(word >>> 20), b = decodeQuatComponent(word >>> 10), c = decodeQuatComponent(word);
      writeQuat(word >>> 30, a, b, c, quats, at, WXYZ_INDEX_OF_XYZW);
    } else {
      const x = turns[3 * i] / 127.5 - 1, y = turns[3 * i + 1] / 127.5 - 1, z = turns[3 * i + 2] / 127.5 - 1;
      writeQuat(3, x, y, z, quats, at, WXYZ_INDEX_OF_XYZW);
    }
    quats[at + 2] *= -1;
    quats[at + 3] *= -1;
  }
  const stride = 3 * SPZ_HARMONICS_BY_DEGREE[degree], shown = Math.min(degree, 3);
  const antialiased = (flags & FLAG_ANTIALIASED) > 0;
  const harmonic = (i, at) => (SIGNS_AFTER_HALF_TURN[Math.floor(at / 3)] * (rest[stride * i + at] - 128)) / 128;
  const numbers = { count, degree: shown, antialiased, positions, scales, quats, opacities, colors, range: 1 };
  return normalizeSplats(numbers, harmonic);
}

const decodeInt24 = (bytes, at) => ((bytes[at] << 8) | (bytes[at + 1] << 16) | (bytes[at + 2] << 24)) >> 8;

// Decodes a component of a rotation: a sign, and 9 bits of magnitude in units of sqrt(1/2) / 511.
const decodeQuatComponent = (code) => ((code & 512 ? -1 : 1) * (code & 511)) / (511 * Math.SQRT2);

// --- containers ------------------------------------------------------------------------------------------------------

// Parses and checks the header; `stored` is the file's length in bytes.
function readSpzHeader(bytes, versions, stored) {
  if (bytes.length < SPZ_HEADER_BYTES) rejectSplats("it ends within its header; it is truncated");
  const view = dataView(bytes), [magic, version, count] = [0, 4, 8].map((at) => view.getUint32(at, true));
  const [degree, bits, flags, streams] = [12, 13, 14, 15].map((at) => bytes[at]);
  if (magic !== SPZ_MAGIC) rejectSplats("this is not an SPZ file, for its contents do not start with 'NGSP'");
  if (!versions.includes(version)) {
    const known = "versions 1 to 3 (gzip) and 4 (plain header) can be read";
    rejectSplats(`this is SPZ version ${version}, and ${known}; export it as one of these`);
  }
  if (degree >= SPZ_HARMONICS_BY_DEGREE.length || bits > 31) {
    const found = `harmonics of degree ${degree} and ${bits} fractional bits`;
    rejectSplats(`its header says ${found}, and 4 and 31 are the most; it is damaged`);
  }
  if (flags & FLAG_LOD_TREE) {
    rejectSplats("it holds a tree of coarse copies for levels of detail; export it without them");
  }
  const each = [version === 1 ? 6 : 9, 1, 3, 3, version >= 3 ? 4 : 3, 3 * SPZ_HARMONICS_BY_DEGREE[degree]];
  const lengths = each.map((length) => count * length), length = lengths.reduce((sum, own) => sum + own);
  if (length > BASE_UNPACKED_BYTES && length > MAX_UNPACKED_BYTES_PER_BYTE * stored) {
    const found = `${groupedDigits(count)} Gaussians, far more than ${groupedDigits(stored)} bytes can hold`;
    rejectSplats(`its header says ${found}; it is damaged`);
  }
  return { version, count, degree, bits, flags, streams, lengths, length };
}

// Throws the error for a file that ends too early.
const rejectTruncatedSpz = (count) => {
  rejectSplats(`it ends before its ${groupedDigits(count)} Gaussians do; it is truncated`);
};

// Returns the header and the sections of a file of version 1 to 3.
async function readGzipSections(bytes) {
  const unpacker = new Unpacker(bytes, "gzip");
  try {
    const header = readSpzHeader(await unpacker.take(SPZ_HEADER_BYTES), [1, 2, 3], bytes.length);
    const { count, length } = header;
    const content = await unpacker.take(length);
    if (content.length < length) rejectTruncatedSpz(count);
    if (!(header.flags & FLAG_EXTENDED) && (await unpacker.more())) {
      rejectSplats(`it continues after its ${groupedDigits(count)} Gaussians; it is damaged`);
    }
    let place = 0;
    return [header, header.lengths.map((own) => content.subarray(place, (place += own)))];
  } finally {
    unpacker.close();
  }
}

// Returns the header and the sections of a file of version 4.
async function readZstdSections(bytes) {
  const header = readSpzHeader(bytes, [4], bytes.length), { count, degree, streams, lengths } = header;
  if (bytes.length < SPZ_HEADER_BYTES_V4) rejectSplats("it ends within its header; it is truncated");
  if (streams !== lengths.filter(Boolean).length) {
    const wanted = `harmonics of degree ${degree} and ${groupedDigits(count)} Gaussians`;
    rejectSplats(`${streams} streams do not fit ${wanted}; it is damaged`);
  }
  const view = dataView(bytes), table = view.getUint32(SPZ_HEADER_BYTES, true);
  let entry = table, place = table + streams * STREAM_ENTRY_BYTES;
  if (table < SPZ_HEADER_BYTES_V4 || place > bytes.length) {
    rejectSplats("its table of contents lies outside of it; it is damaged or truncated");
  }
  const sections = [];
  for (const length of lengths) {
    if (!length) {
      sections.push(new Uint8Array(0));
      continue;
    }
    const [stored, raw] = [entry, entry + 8].map((at) => Number(view.getBigUint64(at, true)));
    entry += STREAM_ENTRY_BYTES;
    if (raw !== length) {
      const wanted = `where ${groupedDigits(count)} Gaussians need ${groupedDigits(length)}`;
      rejectSplats(`a stream of ${groupedDigits(raw)} bytes stands ${wanted}; it is damaged`);
    }
    if (stored > bytes.length - place) rejectTruncatedSpz(count);
    sections.push(await unpackZstdSection(bytes.subarray(place, place + stored), length));
    place += stored;
  }
  return [header, sections];
}

// Decompresses a section of exactly `length` bytes.
async function unpackZstdSection(bytes, length) {
  const unpacker = new Unpacker(bytes, "zstd");
  try {
    const content = await unpacker.take(length);
    if (content.length < length || (await unpacker.more())) {
      rejectSplats(`a zstd stream does not hold the ${groupedDigits(length)} bytes it should; it is damaged`);
    }
    return content;
  } finally {
    unpacker.close();
  }
}
