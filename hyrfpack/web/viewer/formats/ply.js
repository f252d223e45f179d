// Reads the PLY files of 3D Gaussian Splatting: one element `vertex` of x y z, f_dc_0..2 (harmonics of degree 0, RGB),
// f_rest_0.. (higher ones, channel after channel), opacity (its logit), scale_0..2 (natural logarithms) and rot_0..3
// (wxyz). Rows may be binary or text; properties may be in any order and of any type.

import { SH_BAND_0 } from "../../hyrf/basis.js";
import { HIGHER_HARMONICS_BY_DEGREE } from "../../hyrf/harmonics.js";
import { normalizeSplats, rejectSplats } from "./normalize.js";
import { decodeCompressedPly, isCompressedPly } from "./compressed_ply.js";
import { readPlyHeader, readPlyRows } from "./ply_elements.js";

const PLY_POSITION_NAMES = ["x", "y", "z"];
const PLY_COLOR_NAMES = ["f_dc_0", "f_dc_1", "f_dc_2"];
const PLY_SCALE_NAMES = ["scale_0", "scale_1", "scale_2"];
const PLY_ROTATION_NAMES = ["rot_0", "rot_1", "rot_2", "rot_3"];
const PLY_REQUIRED_NAMES = [
  ...PLY_POSITION_NAMES, ...PLY_COLOR_NAMES, "opacity", ...PLY_SCALE_NAMES, ...PLY_ROTATION_NAMES,
];
const REST_NUMBERS_BY_DEGREE = [0, 9, 24, 45, 72]; // degree 4 is read, but only degrees up to 3 are used

/**
 * Reads the splats of a PLY file, compressed or not.
 * @param {Uint8Array} bytes the whole file
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>}
 * @throws {import("../../hyrf/errors.js").HyrfFormatError} the file is damaged
 */
export async function decodePly(bytes) {
  const header = readPlyHeader(bytes);
  return isCompressedPly(header) ? decodeCompressedPly(bytes, header) : decodePlainPly(bytes, header);
}

// Reads the splats of a PLY file that is not compressed.
function decodePlainPly(bytes, header) {
  const properties = header.elements.get("vertex")?.properties ?? new Map();
  const missing = PLY_REQUIRED_NAMES.filter((name) => !properties.get(name));
  if (missing.length) {
    const shown = missing.slice(0, 4).join(", ") + (missing.length > 4 ? ` and ${missing.length - 4} more` : "");
    const what = `this PLY file holds no Gaussians, for its vertices have no ${shown}`;
    rejectSplats(`${what}; give one that a program for 3D Gaussian Splatting wrote`);
  }
  const rest = [...properties.keys()].filter((name) => name.startsWith("f_rest_")).length;
  const storedDegree = REST_NUMBERS_BY_DEGREE.indexOf(rest);
  const names = Array.from({ length: rest }, (_, k) => `f_rest_${k}`);
  if (storedDegree < 0 || !names.every((name) => properties.get(name))) {
    const what = `${rest} properties f_rest_ fit no degree of harmonics`;
    rejectSplats(`${what}; 0, 9, 24, 45 or 72 of them do, counted from 0`);
  }
  const rows = readPlyRows(bytes, header, ["vertex"]).get("vertex"), { count } = rows;
  const values = (labels, convert, array = new Float32Array(labels.length * count)) => {
    labels.forEach((label, k) => {
      const number = rows.column(label);
      for (let i = 0; i < count; i++) array[i * labels.length + k] = convert(number(i));
    });
    return array;
  };
  const degree = Math.min(storedDegree, 3), higher = names.map((name) => rows.column(name));
  const numbers = {
    count, degree,
    antialiased: false,
    positions: values(PLY_POSITION_NAMES, (value) => value, new Float64Array(3 * count)),
    scales: values(PLY_SCALE_NAMES, Math.exp),
    quats: values(PLY_ROTATION_NAMES, (value) => value),
    opacities: values(["opacity"], (logit) => 1 / (1 + Math.exp(-logit))),
    colors: values(PLY_COLOR_NAMES, (value) => 0.5 + SH_BAND_0 * Math.fround(value)),
  };
  const columns = Array.from({ length: 3 * HIGHER_HARMONICS_BY_DEGREE[degree] }, (_, at) => {
    return higher[(at % 3) * (rest / 3) + Math.floor(at / 3)];
  });
  return normalizeSplats(numbers, (i, at) => Math.fround(columns[at](i)));
}
