// Shows a HyrfObject for tests, which call the functions of `globalThis.page`.

import * as THREE from "three";

import { HyrfObject } from "./hyrf-object.js";
import { lookFrom } from "./look-from.js";

const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
document.body.append(renderer.domElement);

const longTasks = [];
new PerformanceObserver((list) => longTasks.push(...list.getEntries().map(({ duration }) => duration)))
  .observe({ type: "longtask" });

export const page = {
  THREE, renderer, scene, camera, longTasks,
  Kind: HyrfObject,
  object: null,

  async load(file, options) {
    const object = (page.object = await page.Kind.load(file, options)), { solid } = object.userData.hyrf;
    scene.background = solid ? new THREE.Color().setRGB(...solid, THREE.SRGBColorSpace) : null;
    scene.add(object);
    object.updateMatrixWorld(true);
  },

  // Moves the camera to one of hyrfpack's, with its principal point, and draws until the picture is complete.
  async show(view) {
    const { width, height, fx, fy, cx, cy } = view;
    renderer.setSize(width, height);
    lookFrom(camera, page.object, view);
    const { near, far } = camera, x = near / fx, y = near / fy;
    camera.projectionMatrix.makePerspective(-cx * x, (width - cx) * x, cy * y, (cy - height) * y, near, far);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    await page.draw();
  },

  async draw() {
    do {
      renderer.render(scene, camera);
      await new Promise(requestAnimationFrame);
    } while (!page.object.isComplete);
    renderer.render(scene, camera);
  },

  // Returns the picture's RGB bytes as base64, the top row first.
  read() {
    const gl = renderer.getContext(), { drawingBufferWidth: width, drawingBufferHeight: height } = gl;
    const rgba = new Uint8Array(4 * width * height), rows = [];
    renderer.setRenderTarget(null);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    for (let row = height - 1; row >= 0; row--) {
      rows.push(rgba.subarray(4 * row * width, 4 * (row + 1) * width).filter((_, k) => (k & 3) !== 3));
    }
    return btoa(rows.map((row) => Array.from(row, (byte) => String.fromCharCode(byte)).join("")).join(""));
  },

  // Draws into a target of floats and returns its numbers, the bottom row first.
  readLinear() {
    const { width, height } = renderer.domElement;
    const target = new THREE.WebGLRenderTarget(width, height, { type: THREE.FloatType });
    const numbers = new Float32Array(4 * width * height);
    renderer.setRenderTarget(target);
    renderer.render(scene, camera);
    renderer.readRenderTargetPixels(target, 0, 0, width, height, numbers);
    renderer.setRenderTarget(null);
    target.dispose();
    return Array.from(numbers);
  },

  // Adds an unlit ball at a place of the file's world.
  addBall([x, y, z], radius, color) {
    const material = new THREE.MeshBasicMaterial({ color });
    const ball = new THREE.Mesh(new THREE.SphereGeometry(radius, 48, 24), material);
    ball.position.copy(page.object.localToWorld(new THREE.Vector3(x, y, z)));
    scene.add(ball);
    return ball;
  },
};
globalThis.page = page;
