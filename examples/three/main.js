// Shows a file in the page `index.html?file=scene.hyrf`.

import { Color, PerspectiveCamera, SRGBColorSpace, Scene, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import { followWindow } from "./follow-window.js";
import { HyrfObject } from "./hyrf-object.js";
import { lookFrom } from "./look-from.js";

const file = new URLSearchParams(location.search).get("file") ?? "scene.hyrf";
const statusLine = document.getElementById("status");
const renderer = new WebGLRenderer({ antialias: true }), scene = new Scene(), camera = new PerspectiveCamera();
const controls = new OrbitControls(camera, renderer.domElement);
document.body.append(renderer.domElement);

// Frames are drawn only when something changes.
let isRequested = false;
const requestFrame = () => {
  if (isRequested) return;
  isRequested = true;
  requestAnimationFrame(() => {
    isRequested = false;
    renderer.render(scene, camera);
  });
};

const fit = () => {
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setSize(innerWidth, innerHeight);
  requestFrame();
};

controls.addEventListener("change", requestFrame);
followWindow(fit);
try {
  const object = await HyrfObject.load(file, {
    onProgress: ({ step, part }) => (statusLine.textContent = `${step} ${Math.round(100 * part)} %`),
  });
  const { target, solid } = object.userData.hyrf;
  if (solid) scene.background = new Color().setRGB(...solid, SRGBColorSpace);
  scene.add(object);
  lookFrom(camera, object);
  controls.target.copy(object.localToWorld(new Vector3(...target)));
  controls.update();
  object.addEventListener("change", requestFrame);
  object.addEventListener("error", ({ error }) => (statusLine.textContent = error.message));
  statusLine.textContent = "";
  fit();
} catch (error) {
  statusLine.textContent = error.message;
}
