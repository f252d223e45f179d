// Shows `.hyrf` files in scenes of three.js, by its own GaussianSplat: the model's Gaussians, with harmonics fitted to
// its colours here, in the page.

import {
  BackSide, DataTexture, Group, LinearFilter, Matrix4, Mesh, MeshBasicNodeMaterial, Quaternion, RepeatWrapping,
  SphereGeometry, Vector3,
} from "three/webgpu";
import { GaussianSplat } from "three/addons/objects/GaussianSplat.js";
import {
  createGaussianSplatGeometry, createPackedSphericalHarmonicsBand, writeCovariance,
} from "three/addons/utils/GaussianSplatUtils.js";
import { read } from "hyrf.js";
import { backgroundColors } from "hyrf.js/fields.js";
import { fitHarmonics } from "hyrf.js/harmonics.js";
import { viewpointOf } from "hyrf.js/viewpoint.js";

const SPHERE_RADIUS = 100; // of the background, in units of the model
const SPHERE_WIDTH = 1024, SPHERE_HEIGHT = 512; // pixels of its picture
const NEAREST = 0.01; // units of the model
const SLICE = 12; // ms of work until the page gets its turn

/**
 * A scene out of a file, in the file's world axes but turned so that up is +y. Below it lies one group in the model's
 * units, with the splats and, where the model has a background, its sphere.
 *
 * Colours are those of pictures: render with `renderer.outputColorSpace = LinearSRGBColorSpace`, without tone mapping.
 *
 * @param {string | URL | Uint8Array} source where the file is, or what is in it
 * @param {{degree?: number, onCoarse?: (object: Group) => void, onProgress?: (done: number) => void}} [options]
 *   `degree` of the harmonics, 0 to 3; `onCoarse` gets the object as soon as it shows the scene as it looks from its
 *   first camera; `onProgress` the part done, 0 to 1
 * @returns {Promise<Group>} with `userData.hyrf`: {metadata, cameras, up, target, near, far, solid}: `cameras` are for
 *   `lookFrom`, `solid` is a colour to clear with where there is no background, or null
 */
export async function loadHyrf(source, { degree = 2, onCoarse = () => {}, onProgress = () => {} } = {}) {
  const model = await read(source instanceof Uint8Array ? source : await fetched(source));
  const { config, metadata } = model, { center, scale } = config.frame;
  const { cameras, fitted, up, target } = viewpointOf(metadata);
  const object = new Group(), frame = new Group();
  object.name = "hyrf";
  object.quaternion.copy(new Quaternion().setFromUnitVectors(new Vector3(...up), new Vector3(0, 1, 0)));
  frame.position.set(...center);
  frame.scale.setScalar(scale);
  object.add(frame);
  const near = NEAREST * scale, far = 2.5 * SPHERE_RADIUS * scale;
  object.userData.hyrf = { metadata, cameras, up, target, near, far, solid: config.background ? null : config.solid };

  const show = (splats) => {
    frame.children.filter((child) => child.isGaussianSplat).forEach(drop);
    if (splats.count) frame.add(new GaussianSplat(splatGeometry(splats)));
  };
  let rested = performance.now();
  const splats = await fitHarmonics(model, fitted, degree, async ({ done, coarse, splats: some }) => {
    if (coarse) {
      show(some);
      if (config.background) frame.add(backgroundSphere(model));
      onCoarse(object);
    }
    onProgress(done);
    if (performance.now() - rested < SLICE) return;
    await new Promise((resolve) => setTimeout(resolve));
    rested = performance.now();
  });
  show(splats);
  if (config.background && !splats.count) frame.add(backgroundSphere(model));
  return object;
}

/**
 * Put a perspective camera where one of the file's cameras stands. Its picture's shape stays its own.
 * @param {import("three/webgpu").PerspectiveCamera} camera
 * @param {Group} object from `loadHyrf`
 * @param {import("hyrf.js/viewpoint.js").Camera} [from] one of `userData.hyrf.cameras`, or alike; else the first
 */
export function lookFrom(camera, object, from = object.userData.hyrf.cameras[0]) {
  const { near, far } = object.userData.hyrf;
  object.updateWorldMatrix(true, false);
  const pose = new Matrix4().set(...from.camera_from_world.flat()).invert();
  // OpenCV's cameras look along z with y down, those of three.js against z with y up.
  pose.premultiply(object.matrixWorld).multiply(new Matrix4().makeScale(1, -1, -1));
  pose.decompose(camera.position, camera.quaternion, new Vector3());
  const size = Math.cbrt(Math.abs(object.matrixWorld.determinant()));
  camera.fov = (2 * Math.atan(from.height / (2 * from.fy)) * 180) / Math.PI;
  camera.near = near * size;
  camera.far = far * size;
  camera.updateProjectionMatrix();
  camera.updateMatrixWorld();
}

/**
 * What three.js draws splats from.
 * @param {import("hyrf.js/harmonics.js").Splats} splats
 */
export function splatGeometry({ count, degree, positions, scales, quats, opacities, colors, harmonics, range }) {
  const covariances = new Float32Array(6 * count), tints = new Uint8ClampedArray(4 * count), bands = {};
  for (let i = 0; i < count; i++) {
    const [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4), [a, b, c] = scales.subarray(3 * i, 3 * i + 3);
    writeCovariance(covariances, 6 * i, a, b, c, x, y, z, w);
    for (let k = 0; k < 3; k++) tints[4 * i + k] = 255 * colors[3 * i + k];
    tints[4 * i + 3] = 255 * opacities[i];
  }
  const others = count ? harmonics.length / count : 0;
  for (let band = 1, from = 0; band <= degree; band++) {
    const { packed, bytes } = createPackedSphericalHarmonicsBand(count, band);
    const length = 3 * (2 * band + 1), stride = bytes.length / (count || 1);
    for (let i = 0; i < count; i++) {
      for (let k = 0; k < length; k++) { // theirs are of range 1, ours of their own
        bytes[i * stride + k] = 128 + range * (harmonics[i * others + from + k] - 128);
      }
    }
    bands[`sh${band}`] = packed;
    from += length;
  }
  return createGaussianSplatGeometry(positions.slice(), covariances, new Uint8Array(tints.buffer), bands);
}

// The sphere behind everything: as it looks from the model's middle, in its place far away.
function backgroundSphere(model) {
  const places = new Float32Array(3 * SPHERE_WIDTH), directions = new Float32Array(3 * SPHERE_WIDTH);
  const pixels = new Uint8Array(4 * SPHERE_WIDTH * SPHERE_HEIGHT).fill(255);
  for (let row = 0; row < SPHERE_HEIGHT; row++) {
    const polar = Math.PI * (1 - (row + 0.5) / SPHERE_HEIGHT); // rows from below, as SphereGeometry has them
    for (let column = 0; column < SPHERE_WIDTH; column++) {
      const turn = (2 * Math.PI * (column + 0.5)) / SPHERE_WIDTH, level = Math.sin(polar);
      directions.set([-Math.cos(turn) * level, Math.cos(polar), Math.sin(turn) * level], 3 * column);
    }
    places.set(directions.map((value) => SPHERE_RADIUS * value));
    const colors = backgroundColors(model, places, directions);
    for (let k = 0; k < colors.length; k++) {
      pixels[4 * (row * SPHERE_WIDTH + Math.floor(k / 3)) + (k % 3)] = Math.round(255 * colors[k]);
    }
  }
  const texture = new DataTexture(pixels, SPHERE_WIDTH, SPHERE_HEIGHT);
  texture.wrapS = RepeatWrapping;
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.needsUpdate = true;
  const material = new MeshBasicNodeMaterial({ map: texture, side: BackSide, fog: false });
  return new Mesh(new SphereGeometry(SPHERE_RADIUS, 96, 48), material);
}

async function fetched(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address} cannot be fetched (${answer.status}); check the address.`);
  return new Uint8Array(await answer.arrayBuffer());
}

function drop(mesh) {
  mesh.removeFromParent();
  mesh.geometry.dispose();
  mesh.material.dispose();
}
