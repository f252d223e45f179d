// A worker: reads the file of an address as the player does, and answers with {error, kind}, or with the facts of its
// splats and, in base64, what `decode.mjs` writes.

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
