// Reads files of splats in a worker. A message is the address of a file. The answer is {error, kind}, or {facts, data}:
// the properties of its splats without their arrays, and in base64 the arrays in the order of decode.mjs.

import { decodeSplats } from "../../../hyrfpack/web/viewer/formats/index.js";

const base64 = async (parts) => {
  const reader = new FileReaderSync();
  return reader.readAsDataURL(new Blob(parts)).split(",")[1] ?? "";
};

onmessage = async ({ data: address }) => {
  try {
    const bytes = new Uint8Array(await (await fetch(address)).arrayBuffer());
    const { positions, scales, quats, opacities, colors, harmonics, ...facts } = await decodeSplats(address, bytes);
    const data = await base64([positions, scales, quats, opacities, colors, harmonics]);
    postMessage({ facts, data });
  } catch (error) {
    postMessage({ error: error.message, kind: error.name });
  }
};
