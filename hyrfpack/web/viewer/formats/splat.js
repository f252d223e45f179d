// Reads the .splat format of antimatter15's viewer, which has no header. Each Gaussian has 32 bytes, little-endian:
// position and scale as 3 float32 each, colour and opacity as 4 bytes, and the rotation wxyz as 4 bytes (q * 128 +
// 128).

import { groupedDigits } from "../../hyrf/errors.js";
import { normalizeSplats, rejectSplats } from "./normalize.js";

const BYTES_PER_SPLAT = 32;

/**
 * Reads the splats of a .splat file.
 * @param {Uint8Array} bytes the whole file
 * @returns {Promise<import("../../hyrf/harmonics.js").Splats>} of degree 0
 * @throws {import("../../hyrf/errors.js").HyrfFormatError} the file is damaged
 */
export async function decodeSplat(bytes) {
  if (bytes.length % BYTES_PER_SPLAT) {
    const length = groupedDigits(bytes.length);
    const found = `${length} bytes are not a whole number of Gaussians of 32 bytes`;
    rejectSplats(`${found}; this is not a .splat file, or it is truncated`);
  }
  const count = bytes.length / BYTES_PER_SPLAT, view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  const positions = new Float64Array(3 * count), scales = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count), opacities = new Float32Array(count), colors = new Float32Array(3 * count);
  for (let i = 0, at = 0; i < count; i++, at += BYTES_PER_SPLAT) {
    for (let k = 0; k < 3; k++) {
      positions[3 * i + k] = view.getFloat32(at + 4 * k, true);
      const scale = view.getFloat32(at + 12 + 4 * k, true);
      if (scale < 0) rejectSplats("a scale is negative; this is not a .splat file, or it is damaged");
      scales[3 * i + k] = scale;
      colors[3 * i + k] = bytes[at + 24 + k] / 255;
    }
    opacities[i] = bytes[at + 27] / 255;
    for (let k = 0; k < 4; k++) quats[4 * i + k] = (bytes[at + 28 + k] - 128) / 128;
  }
  return normalizeSplats({ count, degree: 0, antialiased: false, positions, scales, quats, opacities, colors });
}
