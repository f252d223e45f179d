// PLY as 3D Gaussian Splatting writes it: one element `vertex` of x y z, f_dc_0..2 (harmonics of degree 0, RGB),
// f_rest_0.. (higher ones, channel after channel), opacity (its logit), scale_0..2 (natural logarithms) and rot_0..3
// (wxyz). Rows may be binary or text, properties in any order and of any type.

import { HIGHER_HARMONICS_BY_DEGREE, SH_BAND_0 } from "../../hyrf/harmonics.js";
import { checkedSplats, refuseSplats } from "./checked.js";
import { decodeCompressedPly, isCompressedPly } from "./compressed_ply.js";
import { readPlyHeader, readPlyRows } from "./ply_elements.js";

const PLY_PLACE = ["x", "y", "z"], PLY_COLOR = ["f_dc_0", "f_dc_1", "f_dc_2"];
const PLY_SCALE = ["scale_0", "scale_1", "scale_2"], PLY_TURN = ["rot_0", "rot_1", "rot_2", "rot_3"];
const PLY_NEEDED = [...PLY_PLACE, ...PLY_COLOR, "opacity", ...PLY_SCALE, ...PLY_TURN];
const REST_COUNTS = [0, 9, 24, 45, 72]; // by degree; the last is cut to 3

/**
 * @param {Uint8Array} bytes
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>}
 * @throws {import("../../hyrf/errors.js").HyrfFormatError}
 */
export async function decodePly(bytes) {
  const header = readPlyHeader(bytes);
  return isCompressedPly(header) ? decodeCompressedPly(bytes, header) : decodePlainPly(bytes, header);
}

function decodePlainPly(bytes, header) {
  const have = header.elements.get("vertex")?.properties ?? new Map();
  const missing = PLY_NEEDED.filter((name) => !have.get(name));
  if (missing.length) {
    const shown = missing.slice(0, 4).join(", ") + (missing.length > 4 ? ` and ${missing.length - 4} more` : "");
    const what = `this PLY file holds no Gaussians, for its vertices have no ${shown}`;
    refuseSplats(`${what}; give one that a program for 3D Gaussian Splatting wrote`);
  }
  const rest = [...have.keys()].filter((name) => name.startsWith("f_rest_")).length, found = REST_COUNTS.indexOf(rest);
  const names = Array.from({ length: rest }, (_, k) => `f_rest_${k}`);
  if (found < 0 || !names.every((name) => have.get(name))) {
    const what = `${rest} properties f_rest_ fit no degree of harmonics`;
    refuseSplats(`${what}; 0, 9, 24, 45 or 72 of them do, counted from 0`);
  }
  const rows = readPlyRows(bytes, header, ["vertex"]).get("vertex"), { count } = rows;
  const values = (labels, change, array = new Float32Array(labels.length * count)) => {
    labels.forEach((label, k) => {
      const number = rows.column(label);
      for (let i = 0; i < count; i++) array[i * labels.length + k] = change(number(i));
    });
    return array;
  };
  const degree = Math.min(found, 3), higher = names.map((name) => rows.column(name));
  const numbers = {
    count, degree,
    antialiased: false,
    positions: values(PLY_PLACE, (value) => value, new Float64Array(3 * count)),
    scales: values(PLY_SCALE, Math.exp),
    quats: values(PLY_TURN, (value) => value),
    opacities: values(["opacity"], (logit) => 1 / (1 + Math.exp(-logit))),
    colors: values(PLY_COLOR, (value) => 0.5 + SH_BAND_0 * Math.fround(value)),
  };
  const columns = Array.from({ length: 3 * HIGHER_HARMONICS_BY_DEGREE[degree] }, (_, at) => {
    return higher[(at % 3) * (rest / 3) + Math.floor(at / 3)];
  });
  return checkedSplats(numbers, (i, at) => Math.fround(columns[at](i)));
}
