// Describes the objects that hyrf-harmonics.js adds to a scene: `node describe.mjs MODEL.hyrf DEGREE`, in a folder with
// three, hyrf.js and the example's modules. Prints, as JSON, the splats in the axes of the file's world, and the pose of
// three's camera after `lookFrom`.

import { readFile } from "node:fs/promises";

import { PerspectiveCamera, Scene, Vector3 } from "three/webgpu";

import { loadHyrf } from "./hyrf-harmonics.js";
import { lookFrom } from "./look-from.js";

const [file, degree] = process.argv.slice(2), scene = new Scene(), progress = [];
let early = null;
const onCoarse = (some) => (early = some.children[0].children.filter((child) => child.isGaussianSplat).length);
const bytes = new Uint8Array(await readFile(file));
const options = { degree: Number(degree), onCoarse, onProgress: (done) => progress.push(done) };
const object = await loadHyrf(bytes, options), camera = new PerspectiveCamera();
scene.add(object);
scene.updateMatrixWorld(true);
lookFrom(camera, object);

const meshes = [];
object.traverse((child) => child.isGaussianSplat && meshes.push(child));
const [{ splatGeometry: geometry, matrixWorld }] = meshes, position = geometry.getAttribute("position");
const world = matrixWorld.clone().premultiply(object.matrixWorld.clone().invert());
const places = Array.from({ length: position.count }, (_, i) => {
  return new Vector3().fromBufferAttribute(position, i).applyMatrix4(world).toArray();
});
const numbers = (name) => Array.from(geometry.getAttribute(name)?.array ?? []);
const bytesOf = (band) => Array.from(new Uint8Array(Uint32Array.from(numbers(`sphericalHarmonics${band}`)).buffer));
const sphere = object.children[0].children.find((child) => !child.isGaussianSplat);
console.log(JSON.stringify({
  early, progress,
  meshes: meshes.length,
  places,
  covariances: numbers("covariance"),
  colors: numbers("color"),
  bands: [1, 2, 3].map(bytesOf),
  unit: Math.cbrt(world.determinant()),
  eye: object.worldToLocal(camera.position.clone()).toArray(),
  forward: camera.getWorldDirection(new Vector3()).transformDirection(object.matrixWorld.clone().invert()).toArray(),
  up: new Vector3(...object.userData.hyrf.up).transformDirection(object.matrixWorld).toArray(),
  fov: camera.fov,
  sphere: sphere ? Array.from(sphere.material.map.image.data) : null,
}));
