// What the page's address asks for: ?content=URL&camera=...&poster=URL&title=...&exposure=consistent&noui&autorotate,
// and #camera=...

import { cameraOf, viewOf } from "./camera.js";
import { EXPOSURES } from "./exposure.js";
import { normalizedQuat, quatOf, rowsOf } from "./rotation.js";

const SIDE = 1000; // pixels of the picture of a camera that is told without one
const LEAST_FOCAL = 0.05, MOST_FOCAL = 50; // of the square root of the picture's area
const LONGEST = 200; // letters of a title

// Throws an Error with a sentence where a web address is not one that can be fetched.
export function webAddress(text, what) {
  let address;
  try {
    address = new URL(text, document.baseURI);
  } catch {
    throw new Error(`The ${what} in the address, ${shortened(text)}, is no address of a file.`);
  }
  if (!["http:", "https:", location.protocol].includes(address.protocol) || address.username || address.password) {
    throw new Error(`The ${what} in the address must be an http or https address without a password, not ${shortened(text)}.`);
  }
  return address.href;
}

const shortened = (text) => (text.length > 60 ? `${text.slice(0, 60)}…` : text || "an empty one");

// {content, poster, title, camera, exposure, noui, autorotate}, null where nothing is said, and `wrong`: sentences
// about what cannot be used; addresses are "" then, the exposure is null.
export function readSearch(search) {
  const asked = new URLSearchParams(search), wrong = [];
  const web = (name, what) => {
    if (!asked.has(name)) return null;
    try {
      return webAddress(asked.get(name), what);
    } catch ({ message }) {
      wrong.push(message);
      return "";
    }
  };
  const exposure = asked.get("exposure");
  if (exposure !== null && !EXPOSURES.includes(exposure)) {
    wrong.push(`The exposure in the address must be ${EXPOSURES.join(" or ")}, not ${shortened(exposure)}.`);
  }
  const flag = (name) => asked.has(name) && !["0", "false", "no", "off"].includes(asked.get(name).toLowerCase());
  return {
    content: web("content", "content"),
    poster: web("poster", "poster"),
    title: asked.get("title")?.trim().slice(0, LONGEST) || null,
    camera: asked.get("camera"),
    exposure: EXPOSURES.includes(exposure) ? exposure : null,
    noui: flag("noui"),
    autorotate: flag("autorotate"),
    wrong,
  };
}

// The camera in #camera=..., null without.
export function readHash(hash) {
  const [name, ...values] = hash.slice(1).split("=");
  return name === "camera" ? values.join("=") : null;
}

// What a camera's text stands for: {number} of the list, {view} or {view, depth} of the point to orbit about.
export function parseCamera(text, scene) {
  try {
    text = decodeURIComponent(text).trim();
    if (/^\d{1,6}$/.test(text)) {
      const count = scene.cameras.length;
      if (text < 1 || text > count) throw new Error(`there is no camera ${text}, only ${count}`);
      return { number: text - 1 };
    }
    if (text.startsWith("{")) return { view: viewOf(JSON.parse(text), scene) };
    return compactView(text, scene);
  } catch ({ message }) {
    throw new Error(`The address names no camera that can be used: ${message}.`);
  }
}

// Position (world), rotation (camera from world: w, x, y, z), focal length by the root of the picture's area, depth of
// the target: short, and within 1e-4 of the truth.
export function compactCamera(eye, scene) {
  const { fy, camera_from_world: pose } = cameraOf(eye.view(SIDE, SIDE), scene);
  const position = eye.position.map((value, axis) => scene.center[axis] + scene.unit * value);
  const digits = Math.min(15, Math.max(0, 5 - Math.floor(Math.log10(scene.unit * Math.max(eye.pace, 1e-9)))));
  const lengths = [...position, scene.unit * eye.depth].map((value) => Number(value.toFixed(digits)));
  const quat = quatOf(pose.slice(0, 3).map((row) => row.slice(0, 3))).map((value) => Number(value.toFixed(6)));
  return [...lengths.slice(0, 3), ...quat, Number((fy / SIDE).toPrecision(6)), lengths[3]].join(",");
}

function compactView(text, scene) {
  const numbers = text.split(",").map((part) => (part.trim() ? Number(part) : NaN));
  if (![8, 9].includes(numbers.length) || !numbers.every(Number.isFinite)) {
    throw new Error("it is a camera's number, JSON, or 9 numbers as the share link writes them");
  }
  const position = numbers.slice(0, 3), quat = numbers.slice(3, 7), [focal, depth = 0] = numbers.slice(7);
  if (!(Math.hypot(...quat) > 0.5)) throw new Error("its rotation is no unit quaternion");
  if (!(focal >= LEAST_FOCAL && focal <= MOST_FOCAL)) throw new Error(`its focal length must be ${LEAST_FOCAL} to ${MOST_FOCAL}`);
  const rows = rowsOf(normalizedQuat(quat));
  const pose = rows.map((row) => [...row, -row.reduce((sum, value, k) => sum + value * position[k], 0)]);
  const size = { width: SIDE, height: SIDE, fx: SIDE * focal, fy: SIDE * focal, cx: SIDE / 2, cy: SIDE / 2 };
  return { view: viewOf({ ...size, camera_from_world: [...pose, [0, 0, 0, 1]] }, scene), depth: Math.max(0, depth) / scene.unit };
}
