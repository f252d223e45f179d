// Describes the scene of a file that has no page of its own, in the same form as the JSON in pages.

import { backgroundColors } from "../hyrf/fields.js";
import { CULL_MARGIN_RATIO, NEAR_PLANE_LOCAL } from "../hyrf/frustum.js";
import { viewpointOf } from "../hyrf/viewpoint.js";
import { BACKGROUND_RADIUS } from "./constants.js";

const MIN_SAMPLED_SPLATS = 10000;
export const BACKGROUND_HEIGHT_PIXELS = 128;

// Returns the scene of a model.
export function modelScene({ metadata, config, count }, name) {
  const { cameras, up, target } = viewpointOf(metadata), { center, scale, rotation } = config.frame;
  return {
    kind: "hyrf", title: name, count, center, unit: scale, rotation, near: NEAR_PLANE_LOCAL,
    tolerance: CULL_MARGIN_RATIO, up, target, solid: config.solid, cameras,
  };
}

// Returns the scene of splats. Their files have no cameras, so the camera looks at their median position, from a
// distance that shows most of them.
export function splatsScene({ count, center, unit, positions }, name) {
  const step = Math.max(1, Math.floor(count / MIN_SAMPLED_SPLATS)), axes = [[], [], []];
  for (let i = 0; i < count; i += step) axes.forEach((values, axis) => values.push(positions[3 * i + axis]));
  const middle = axes.map((values) => percentile(values, 0.5));
  const reach = axes.map((values, axis) => percentile(values.map((value) => Math.abs(value - middle[axis])), 0.9));
  const size = Math.max(...reach) || 1;
  const target = middle.map((value, axis) => center[axis] + unit * value);
  const viewpoint = viewpointOf({ config: { frame: { center: target, scale: size * unit } } });
  return {
    kind: "splats", title: name, count, center, unit, near: NEAR_PLANE_LOCAL * size, tolerance: CULL_MARGIN_RATIO,
    up: viewpoint.up, target, solid: [0, 0, 0], cameras: viewpoint.cameras,
  };
}

const percentile = (values, part) => Float32Array.from(values).sort()[Math.floor(part * (values.length - 1))] ?? 0;

// Returns the background of a model, seen from its centre, as an equirectangular picture {width, height, rgba}, or null
// if there is none. The picture is for the first frame, and for devices that cannot evaluate the background.
export function backgroundPicture(model, height) {
  if (!model.config.background) return null;
  const width = 2 * height, directions = new Float32Array(3 * width * height);
  for (let v = 0, at = 0; v < height; v++) {
    const latitude = Math.PI * (0.5 - (v + 0.5) / height);
    for (let u = 0; u < width; u++) {
      const longitude = Math.PI * ((2 * (u + 0.5)) / width - 1);
      directions[at++] = Math.cos(latitude) * Math.sin(longitude);
      directions[at++] = -Math.sin(latitude);
      directions[at++] = Math.cos(latitude) * Math.cos(longitude);
    }
  }
  const colors = backgroundColors(model, directions.map((value) => BACKGROUND_RADIUS * value), directions);
  const rgba = new Uint8Array(4 * width * height).fill(255);
  for (let k = 0; k < width * height; k++) {
    for (let c = 0; c < 3; c++) rgba[4 * k + c] = Math.round(255 * colors[3 * k + c]);
  }
  return { width, height, rgba };
}
