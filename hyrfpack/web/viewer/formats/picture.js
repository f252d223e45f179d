// Reads the stored pixels of WebP and PNG pictures. A 2D canvas would multiply colours by alpha, which loses precision.

import { HyrfFormatError, groupedDigits } from "../../hyrf/errors.js";
import { rejectSplats } from "./normalize.js";

const decodeLatin1 = (bytes) => String.fromCharCode(...bytes);

/**
 * Reads a picture.
 * @param {Uint8Array} bytes of a WebP or PNG file
 * @param {number} maxPixels the maximum number of pixels; larger pictures throw an error
 * @param {string} name the picture's name in messages
 * @returns {Promise<{width: number, height: number, pixels: Uint8Array}>} RGBA, row by row from the top
 */
export async function readPicture(bytes, maxPixels, name) {
  const size = parsePictureSize(bytes);
  if (!size) rejectSplats(`${name} in it is not a picture that can be read; get the file again`);
  const { width, height } = size;
  if (!(width > 0 && height > 0 && width * height <= maxPixels)) {
    const found = `${groupedDigits(width)} x ${groupedDigits(height)} pixels`;
    rejectSplats(`${name} in it has ${found}, too many; it is damaged`);
  }
  try {
    const options = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
    const bitmap = await createImageBitmap(new Blob([bytes]), options);
    try {
      if (bitmap.width !== width || bitmap.height !== height) throw new Error("another size");
      return { width, height, pixels: readPixels(bitmap) };
    } finally {
      bitmap.close();
    }
  } catch (error) {
    if (error instanceof HyrfFormatError) throw error;
    return rejectSplats(`${name} in it is not a picture that can be read here; get the file again`);
  }
}

// Reads the pixels of a bitmap through WebGL, which does not multiply them by alpha.
function readPixels(bitmap) {
  const { width, height } = bitmap, gl = new OffscreenCanvas(1, 1).getContext("webgl2");
  if (!gl || Math.max(width, height) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
    rejectSplats("this browser cannot unpack its pictures; convert it to .ply or .spz");
  }
  gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const failed = gl.getError() || gl.isContextLost();
  gl.getExtension("WEBGL_lose_context")?.loseContext(); // browsers allow only a few contexts at a time
  if (failed) rejectSplats("this browser has no room to unpack its pictures; convert it to .ply or .spz");
  return pixels;
}

// Returns {width, height} from the header of a picture, or null if it is neither WebP nor PNG.
function parsePictureSize(bytes) {
  if (bytes.length < 30) return null;
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  if (view.getUint32(0) === 0x89504e47 && decodeLatin1(bytes.subarray(12, 16)) === "IHDR") {
    return { width: view.getUint32(16), height: view.getUint32(20) };
  }
  if (decodeLatin1(bytes.subarray(0, 4)) !== "RIFF" || decodeLatin1(bytes.subarray(8, 12)) !== "WEBP") return null;
  const kind = decodeLatin1(bytes.subarray(12, 16));
  if (kind === "VP8L" && bytes[20] === 0x2f) { // lossless WebP: 14 bits for each side
    const bits = view.getUint32(21, true);
    return { width: (bits & 0x3fff) + 1, height: ((bits >>> 14) & 0x3fff) + 1 };
  }
  if (kind === "VP8X") { // extended WebP: 24 bits for each side
    const side = (at) => 1 + bytes[at] + (bytes[at + 1] << 8) + (bytes[at + 2] << 16);
    return { width: side(24), height: side(27) };
  }
  if (kind === "VP8 ") return { width: view.getUint16(26, true) & 0x3fff, height: view.getUint16(28, true) & 0x3fff };
  return null;
}
