// Shows a file in the page `harmonics.html?file=scene.hyrf`. With `&webgl`, uses WebGL 2 even if the browser has
// WebGPU.

import { Color, LinearSRGBColorSpace, PerspectiveCamera, Scene, Vector3, WebGPURenderer } from "three/webgpu";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import { followWindow } from "./follow-window.js";
import { loadHyrf } from "./hyrf-harmonics.js";
import { lookFrom } from "./look-from.js";

const params = new URLSearchParams(location.search), statusLine = document.getElementById("status");
const renderer = new WebGPURenderer({ forceWebGL: params.has("webgl") });
renderer.outputColorSpace = LinearSRGBColorSpace; // because the file's colours are display-referred
document.body.append(renderer.domElement);
const scene = new Scene(), camera = new PerspectiveCamera(), controls = new OrbitControls(camera, renderer.domElement);

const fit = () => {
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
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

followWindow(fit);
renderer.setAnimationLoop(() => renderer.render(scene, camera));
try {
  const onProgress = (done) => (statusLine.textContent = `${Math.round(100 * done)} %`);
  await loadHyrf(params.get("file") ?? "scene.hyrf", { onCoarse: show, onProgress });
  statusLine.textContent = "";
} catch (error) {
  statusLine.textContent = error.message;
}
