// Applies the exposure of the photos taken near the viewpoint, or a consistent one.

import { logGains } from "../hyrf/exposure.js";
import { viewFromPlace } from "../hyrf/places.js";

export const AS_PHOTOGRAPHED = "as-photographed", CONSISTENT = "consistent"; // the names in hyrfpack.RenderSettings
export const EXPOSURES = [AS_PHOTOGRAPHED, CONSISTENT];

// Returns whether a scene, or a part of it, has an exposure map.
export const hasExposureMap = (scene) => Boolean(scene.exposure || scene.parts?.some(({ exposure }) => exposure));

// Returns {gains} of red, green and blue for the picture of a view, where gains of 1 change nothing; or {partLogs}, the
// log gains of each part of a merged scene.
export function viewExposure(scene, view, exposure) {
  if (!hasExposureMap(scene) || exposure === CONSISTENT) return { gains: [1, 1, 1] };
  const logsOf = (map, { eye, rows }) => (map ? logGains(map, eye, rows[2]) : [0, 0, 0]);
  if (!scene.parts) return { gains: logsOf(scene.exposure, view).map(Math.exp) };
  return { partLogs: scene.parts.map(({ exposure: map, place }) => logsOf(map, viewFromPlace(view, place))) };
}
