// Shows `.hyrf` files in scenes of three.js as its own GaussianSplat, for WebGPURenderer. Spherical harmonics are
// fitted to the model's colours in the page. `hyrf-object.js` shows the model itself.

import {
  BackSide, DataTexture, Group, LinearFilter, Mesh, MeshBasicNodeMaterial, Quaternion, RepeatWrapping,
  SphereGeometry, Vector3,
} from "three/webgpu";
import { GaussianSplat } from "three/addons/objects/GaussianSplat.js";
import {
  createGaussianSplatGeometry, createPackedSphericalHarmonicsBand, writeCovariance,
} from "three/addons/utils/GaussianSplatUtils.js";
import { read } from "hyrf.js";
import { BACKGROUND_RADIUS, backgroundColors } from "hyrf.js/fields.js";
import { fitHarmonics } from "hyrf.js/harmonics.js";
import { IDENTITY_QUAT } from "hyrf.js/rotation.js";
import { viewpointOf } from "hyrf.js/viewpoint.js";

// Lengths are in the model's units.
const BACKGROUND_WIDTH_PX = 1024, BACKGROUND_HEIGHT_PX = 512;
const NEAR_PLANE = 0.01;
const WORK_SLICE_MS = 12; // then the page can react and render a frame

/**
 * Loads a file as an object in the file's world units, rotated so that up is +y. The object has one group in the
 * model's units, with the splats and, if the model has a background, its sphere. Merged files need `HyrfObject`.
 *
 * Colours are display-referred: render with `renderer.outputColorSpace = LinearSRGBColorSpace`, without tone mapping.
 *
 * @param {string | URL | Uint8Array} source the address or the bytes of the file
 * @param {{degree?: number, onCoarse?: (object: Group) => void, onProgress?: (done: number) => void}} [options]
 *   `degree` is that of the harmonics, 0 to 3 (default 2). `onCoarse` is called once, with the object, when it shows
 *   the scene with the colours seen from its first camera. `onProgress` is called with the finished part of the work, 0
 *   to 1.
 * @returns {Promise<Group>} with `userData.hyrf`: {metadata, cameras, up, target, near, far, solid}. `cameras` are for
 *   `lookFrom`; `up`, `target`, `near` and `far` are in the file's world units; `solid` is the clear colour (RGB in
 *   [0, 1]), or null if the model has a background.
 * @throws {Error} the file cannot be fetched or read; the message is a sentence for the user
 */
export async function loadHyrf(source, { degree = 2, onCoarse = () => {}, onProgress = () => {} } = {}) {
  const model = await read(source instanceof Uint8Array ? source : await fetchBytes(source));
  const { config, metadata } = model, { center, scale, rotation = IDENTITY_QUAT } = config.frame;
  const { cameras, fitted, up, target } = viewpointOf(metadata);
  const object = new Group(), frame = new Group();
  object.name = "hyrf";
  object.quaternion.copy(new Quaternion().setFromUnitVectors(new Vector3(...up), new Vector3(0, 1, 0)));
  const [w, ...vector] = rotation;
  frame.position.set(...center);
  frame.quaternion.set(...vector, w).normalize();
  frame.scale.setScalar(scale);
  object.add(frame);
  const near = NEAR_PLANE * scale, far = 2.5 * BACKGROUND_RADIUS * scale;
  object.userData.hyrf = { metadata, cameras, up, target, near, far, solid: config.background ? null : config.solid };

  const show = (splats) => {
    frame.children.filter((child) => child.isGaussianSplat).forEach(drop);
    if (splats.count) frame.add(new GaussianSplat(splatGeometry(splats)));
  };
  let lastPause = performance.now();
  const splats = await fitHarmonics(model, fitted, degree, async ({ done, coarse, splats: some }) => {
    if (coarse) {
      show(some);
      if (config.background) frame.add(backgroundSphere(model));
      onCoarse(object);
    }
    onProgress(done);
    if (performance.now() - lastPause < WORK_SLICE_MS) return;
    await new Promise((resolve) => setTimeout(resolve));
    lastPause = performance.now();
  });
  show(splats);
  if (config.background && !splats.count) frame.add(backgroundSphere(model));
  return object;
}

/**
 * Makes the geometry from which three.js draws splats, in the units of `splats.positions`.
 * @param {import("hyrf.js/harmonics.js").Splats} splats of degree 0 to 3
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
      for (let k = 0; k < length; k++) { // three.js stores harmonics with the range 1
        bytes[i * stride + k] = 128 + range * (harmonics[i * others + from + k] - 128);
      }
    }
    bands[`sh${band}`] = packed;
    from += length;
  }
  return createGaussianSplatGeometry(positions.slice(), covariances, new Uint8Array(tints.buffer), bands);
}

// Makes the background sphere with its colours as seen from the model's centre.
function backgroundSphere(model) {
  const places = new Float32Array(3 * BACKGROUND_WIDTH_PX), directions = new Float32Array(3 * BACKGROUND_WIDTH_PX);
  const pixels = new Uint8Array(4 * BACKGROUND_WIDTH_PX * BACKGROUND_HEIGHT_PX).fill(255);
  for (let row = 0; row < BACKGROUND_HEIGHT_PX; row++) {
    const polar = Math.PI * (1 - (row + 0.5) / BACKGROUND_HEIGHT_PX); // rows of SphereGeometry start at the bottom
    for (let column = 0; column < BACKGROUND_WIDTH_PX; column++) {
      const turn = (2 * Math.PI * (column + 0.5)) / BACKGROUND_WIDTH_PX, level = Math.sin(polar);
      directions.set([-Math.cos(turn) * level, Math.cos(polar), Math.sin(turn) * level], 3 * column);
    }
    places.set(directions.map((value) => BACKGROUND_RADIUS * value));
    const colors = backgroundColors(model, places, directions);
    for (let k = 0; k < colors.length; k++) {
      pixels[4 * (row * BACKGROUND_WIDTH_PX + Math.floor(k / 3)) + (k % 3)] = Math.round(255 * colors[k]);
    }
  }
  const texture = new DataTexture(pixels, BACKGROUND_WIDTH_PX, BACKGROUND_HEIGHT_PX);
  texture.wrapS = RepeatWrapping;
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.needsUpdate = true;
  const material = new MeshBasicNodeMaterial({ map: texture, side: BackSide, fog: false });
  return new Mesh(new SphereGeometry(BACKGROUND_RADIUS, 96, 48), material);
}

async function fetchBytes(address) {
  const answer = await fetch(address).catch(() => {
    throw new Error(`${address} cannot be fetched; check the address, and whether its server allows this page.`);
  });
  if (!answer.ok) throw new Error(`${address} cannot be fetched (${answer.status}); check the address.`);
  return new Uint8Array(await answer.arrayBuffer());
}

function drop(mesh) {
  mesh.removeFromParent();
  mesh.geometry.dispose();
  mesh.material.dispose();
}
