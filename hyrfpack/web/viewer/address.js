// Parses the parameters of the page's address, ?content=URL&camera=...&poster=URL&title=...&exposure=consistent&noui
// &autorotate and #camera=..., and formats cameras for links.

import { cameraOf, toWorld, viewOf } from "./camera.js";
import { EXPOSURES } from "./exposure.js";
import { normalizedQuat, quatOf, rowsOf } from "../hyrf/rotation.js";

const LINK_SIDE_PIXELS = 1000; // links do not store a picture's size
// Limits of the focal length divided by the square root of the picture's area.
// Lenses are far inside; outside, pictures would be a pixel of the scene, or all directions in one pixel.
const MIN_FOCAL_RATIO = 0.001;
const MAX_FOCAL_RATIO = 100_000;
const MAX_TITLE_LETTERS = 200;

// Resolves an address against the page's. Throws an Error with a message for the user if it cannot be fetched.
export function resolveAddress(text, what) {
  let address;
  try {
    address = new URL(text, document.baseURI);
  } catch {
    throw new Error(`The ${what} in the address, ${shortenForMessage(text)}, is no address of a file.`);
  }
  if (!["http:", "https:", location.protocol].includes(address.protocol) || address.username || address.password) {
    const found = shortenForMessage(text);
    throw new Error(`The ${what} in the address must be an http or https address without a password, not ${found}.`);
  }
  return address.href;
}

// Shortens a text from the address for a message.
const shortenForMessage = (text) => (text.length > 60 ? `${text.slice(0, 60)}…` : text || "an empty one");

// Parses what follows "?". Returns {content, poster, title, camera, exposure, gaussians, noui, autorotate, wrong}: the
// flags noui and autorotate are boolean, and other absent parameters are null. `wrong` has a sentence for each invalid
// parameter; invalid addresses become "", an invalid exposure or number null.
export function parseSearch(search) {
  const parameters = new URLSearchParams(search), wrong = [];
  const readAddress = (name, what) => {
    if (!parameters.has(name)) return null;
    try {
      return resolveAddress(parameters.get(name), what);
    } catch ({ message }) {
      wrong.push(message);
      return "";
    }
  };
  const exposure = parameters.get("exposure");
  if (exposure !== null && !EXPOSURES.includes(exposure)) {
    wrong.push(`The exposure in the address must be ${EXPOSURES.join(" or ")}, not ${shortenForMessage(exposure)}.`);
  }
  const gaussians = parameters.get("gaussians"), isCount = /^[1-9]\d{0,8}$/.test(gaussians ?? "1");
  if (!isCount) {
    wrong.push(`The number of Gaussians in the address must be 1 to 999,999,999, not ${shortenForMessage(gaussians)}.`);
  }
  const readFlag = (name) => {
    return parameters.has(name) && !["0", "false", "no", "off"].includes(parameters.get(name).toLowerCase());
  };
  return {
    content: readAddress("content", "content"),
    poster: readAddress("poster", "poster"),
    title: parameters.get("title")?.trim().slice(0, MAX_TITLE_LETTERS) || null,
    camera: parameters.get("camera"),
    exposure: EXPOSURES.includes(exposure) ? exposure : null,
    gaussians: gaussians !== null && isCount ? Number(gaussians) : null,
    noui: readFlag("noui"),
    autorotate: readFlag("autorotate"),
    wrong,
  };
}

// Returns the text of the camera in #camera=..., or null if there is none.
export function parseHash(hash) {
  const [name, ...values] = hash.slice(1).split("=");
  return name === "camera" ? values.join("=") : null;
}

// Parses the text of a camera. Returns {number}, an index into the scene's cameras, or {view, depth}: another camera
// and, if the text has it, the depth of the point to orbit about. Throws an Error whose message is the reason.
export function parseCamera(text, scene) {
  text = decodeURIComponent(text).trim();
  if (/^\d{1,6}$/.test(text)) {
    const count = scene.cameras.length;
    if (text < 1 || text > count) throw new Error(`there is no camera ${text}, only ${count}`);
    return { number: text - 1 };
  }
  if (text.startsWith("{")) return { view: viewOf(JSON.parse(text), scene) };
  return parseCompactCamera(text, scene);
}

// Formats the eye as nine numbers for a link: position (world units), rotation (camera from world: w, x, y, z), focal
// length divided by the square root of the picture's area, and depth of the target (world units). Lengths are rounded
// to 1e-4 of the viewing distance or finer.
export function formatCamera(eye, scene) {
  const { fy, camera_from_world: pose } = cameraOf(eye.view(LINK_SIDE_PIXELS, LINK_SIDE_PIXELS), scene);
  const position = toWorld(eye.position, scene);
  const digits = Math.min(100, Math.max(0, 5 - Math.floor(Math.log10(scene.unit * Math.max(eye.pace, 1e-9)))));
  const lengths = [...position, scene.unit * eye.depth].map((value) => Number(value.toFixed(digits)));
  const quat = quatOf(pose.slice(0, 3).map((row) => row.slice(0, 3))).map((value) => Number(value.toFixed(6)));
  return [...lengths.slice(0, 3), ...quat, Number((fy / LINK_SIDE_PIXELS).toPrecision(6)), lengths[3]].join(",");
}

// Parses the numbers that formatCamera writes; the depth may be missing. Returns {view, depth}.
function parseCompactCamera(text, scene) {
  const numbers = text.split(",").map((part) => (part.trim() ? Number(part) : NaN));
  if (![8, 9].includes(numbers.length) || !numbers.every(Number.isFinite)) {
    throw new Error("it must be a camera's number, JSON, or 9 numbers as in share links");
  }
  const position = numbers.slice(0, 3), quat = numbers.slice(3, 7), [focal, depth = 0] = numbers.slice(7);
  if (!(Math.hypot(...quat) > 0.5)) throw new Error("its rotation is no unit quaternion");
  if (!(focal >= MIN_FOCAL_RATIO && focal <= MAX_FOCAL_RATIO)) {
    throw new Error(`its focal length must be ${MIN_FOCAL_RATIO} to ${MAX_FOCAL_RATIO}`);
  }
  const rows = rowsOf(normalizedQuat(quat));
  const pose = rows.map((row) => [...row, -row.reduce((sum, value, k) => sum + value * position[k], 0)]);
  const side = LINK_SIDE_PIXELS, fx = side * focal;
  const intrinsics = { width: side, height: side, fx, fy: fx, cx: side / 2, cy: side / 2 };
  const view = viewOf({ ...intrinsics, camera_from_world: [...pose, [0, 0, 0, 1]] }, scene);
  return { view, depth: Math.max(0, depth) / scene.unit };
}
