// The page: `index.html?file=scene.hyrf`. `&webgl` takes WebGL 2 where there is WebGPU, too.

import { Color, LinearSRGBColorSpace, PerspectiveCamera, Scene, Vector3, WebGPURenderer } from "three/webgpu";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import { loadHyrf, lookFrom } from "./hyrf-three.js";

const asked = new URLSearchParams(location.search), said = document.getElementById("said");
const renderer = new WebGPURenderer({ forceWebGL: asked.has("webgl") });
renderer.outputColorSpace = LinearSRGBColorSpace; // the file's colours are those of pictures
renderer.setPixelRatio(devicePixelRatio);
document.body.append(renderer.domElement);
const scene = new Scene(), camera = new PerspectiveCamera(), controls = new OrbitControls(camera, renderer.domElement);

const fit = () => {
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
  renderer.setSize(innerWidth, innerHeight);
};

const show = (object) => {
  const { target, solid } = object.userData.hyrf;
  scene.add(object);
  if (solid) scene.background = new Color(...solid);
  lookFrom(camera, object);
  controls.target.copy(object.localToWorld(new Vector3(...target)));
  controls.update();
};

addEventListener("resize", fit);
fit();
renderer.setAnimationLoop(() => renderer.render(scene, camera));
try {
  const onProgress = (done) => (said.textContent = `${Math.round(100 * done)} %`);
  await loadHyrf(asked.get("file") ?? "scene.hyrf", { onCoarse: show, onProgress });
  said.textContent = "";
} catch (error) {
  said.textContent = error.message;
}
