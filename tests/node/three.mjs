// Reads splats with three.js: `node three.mjs a.spz b.glb c.ply d.splat`. The last line printed is a JSON list with one
// entry per file, in order: {error} with the message of its loader, or the splats that its GaussianSplat object draws:
//
//     positions     3 numbers per splat
//     covariances   6 numbers per splat: xx xy xz yy yz zz
//     colors        4 bytes per splat, as numbers in [0, 1]: RGB of harmonic 0, opacity
//     harmonics     for each band, 3, 5 or 7 coefficients per splat, each as 3 colour channels
//     matrix        16 numbers, column by column: from these positions to the scene's; only for glTF

import { readFile } from "node:fs/promises";

import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { GaussianSplatPLYLoader } from "three/addons/loaders/GaussianSplatPLYLoader.js";
import { SPLATLoader } from "three/addons/loaders/SPLATLoader.js";
import { SPZLoader } from "three/addons/loaders/SPZLoader.js";

globalThis.self ??= globalThis; // because GLTFLoader reads self.URL

const readers = {
  spz: async (bytes) => described(await new SPZLoader().parse(bytes)),
  ply: (bytes) => described(new GaussianSplatPLYLoader().parse(bytes)),
  splat: (bytes) => described(new SPLATLoader().parse(bytes)),
  glb: async (bytes) => {
    const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    const { scene } = await loader.parseAsync(bytes, "");
    scene.updateMatrixWorld(true);
    const meshes = [];
    scene.traverse((object) => object.isGaussianSplat && meshes.push(object));
    if (meshes.length !== 1) throw new Error(`${meshes.length} objects of splats`);
    return { ...described(meshes[0].splatGeometry), matrix: meshes[0].matrixWorld.elements };
  },
};

function described(geometry) {
  const numbers = (name) => Array.from(geometry.getAttribute(name).array);
  const harmonics = [];
  for (const band of [1, 2, 3]) {
    const attribute = geometry.getAttribute(`sphericalHarmonics${band}`);
    if (!attribute) break;
    const stride = 4 * attribute.itemSize; // in bytes, padded to whole words
    const bytes = new Uint8Array(attribute.array.buffer);
    harmonics.push(Array.from(bytes, (byte) => (byte - 128) / 128).filter((_, i) => i % stride < 3 * (2 * band + 1)));
  }
  return {
    positions: numbers("position"),
    covariances: numbers("covariance"),
    colors: numbers("color").map((byte) => byte / 255),
    harmonics,
  };
}

const answers = [];
for (const path of process.argv.slice(2)) {
  try {
    const bytes = await readFile(path);
    const read = readers[path.split(".").pop()];
    answers.push(await read(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength)));
  } catch (error) {
    answers.push({ error: String(error) });
  }
}
console.log(`\n${JSON.stringify(answers)}`);
