// Applies the exposure of the photos taken near the viewpoint, or a consistent one.

import { logGains } from "../hyrf/exposure.js";

export const AS_PHOTOGRAPHED = "as-photographed", CONSISTENT = "consistent"; // the names in hyrfpack.RenderSettings
export const EXPOSURES = [AS_PHOTOGRAPHED, CONSISTENT];

// Returns the gains of red, green and blue for the picture of a view. Gains of 1 change nothing.
export function viewGains(scene, view, exposure) {
  if (!scene.exposure || exposure === CONSISTENT) return [1, 1, 1];
  return logGains(scene.exposure, view.eye, view.rows[2]).map(Math.exp);
}
