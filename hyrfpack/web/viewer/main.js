// Connects the player, the controls, the panel and the opener of scenes.

import { formatCamera, parseCamera, parseHash, parseSearch } from "./address.js";
import { Controls } from "./controls.js";
import { element, elementText } from "./dom.js";
import { AS_PHOTOGRAPHED, CONSISTENT } from "./exposure.js";
import { Help } from "./help.js";
import { Damper, Glide, Turntable, prefersReducedMotion } from "./motion.js";
import { announce, dismiss, fail, progress, remark, toast } from "./notifications.js";
import { Opener, postToParent } from "./opener.js";
import { Panel } from "./panel.js";
import { Player } from "./player.js";
import { savePicture, shareView } from "./share.js";

const FADE_MS = 600; // the duration in style.css
const APPROACH_FACTOR = 0.5; // of the distance to a place that was tapped twice
const IGNORED_TEXTS = {
  wheel: "Click the scene, then the wheel zooms.",
  finger: "Tap the scene, then fingers move it.",
};

// Shows a picture until the scene is drawn.
function showPoster(address) {
  if (!address) return;
  const poster = element("poster") ?? Object.assign(document.createElement("img"), { id: "poster", alt: "" });
  poster.src = address;
  document.body.append(poster);
}

// Fades in the canvas over the poster after the first frame.
function revealCanvas(player) {
  if (player.times.first === null && !player.idle) return requestAnimationFrame(() => revealCanvas(player));
  document.body.classList.add("there");
  setTimeout(() => element("poster")?.remove(), FADE_MS);
}

// Marks the picked point for a moment.
function showRing(x, y) {
  const ring = element("ring");
  Object.assign(ring.style, { left: `${x}px`, top: `${y}px` });
  ring.hidden = true;
  ring.getBoundingClientRect(); // restarts the animation by forcing a layout
  ring.hidden = false;
  ring.onanimationend = () => (ring.hidden = true);
}

// Fills the screen with the page, or ends that; a browser may refuse it.
function toggleFullscreen() {
  const page = document.documentElement;
  const changed = document.fullscreenElement ? document.exitFullscreen() : page.requestFullscreen?.();
  changed?.catch(() => {});
}

function start() {
  const parameters = parseSearch(location.search);
  document.body.classList.toggle("bare", parameters.noui);
  showPoster(parameters.poster);
  const embedded = element("scene") ? JSON.parse(elementText("scene")) : null;
  const served = element("content") ? JSON.parse(elementText("content")) : null;

  const player = new Player(element("view"), embedded);
  const damper = new Damper(player), glide = new Glide(player), turntable = new Turntable(player), help = new Help();

  // ---- cameras

  const choose = (camera) => {
    if (player.scene && camera < player.cameras.length) glide.to(() => player.choose(camera));
  };

  const pick = (x, y) => {
    const isHit = player.pick(x, y);
    if (isHit) showRing(x, y);
    return isHit;
  };

  const approach = (x, y) => {
    if (!pick(x, y)) return;
    glide.to(() => {
      player.eye.approach(player.eye.target, APPROACH_FACTOR);
      player.changed();
    });
  };

  // Moves the eye to the camera of a text from the address.
  const moveTo = (text, smoothly) => {
    const { number: camera, view, depth } = parseCamera(text, player.scene);
    const move = () => {
      if (camera !== undefined) return player.choose(camera);
      player.eye.setView(view);
      if (depth) player.eye.target = player.eye.point(0, 0, depth);
      player.changed();
    };
    if (smoothly) glide.to(move);
    else move();
  };

  // Moves the eye to the camera of a text from the address (null for none), and shows an error if it is invalid.
  const followCamera = (text, smoothly) => {
    if (text === null || !player.scene) return;
    try {
      moveTo(text, smoothly);
      if (smoothly) dismiss();
    } catch (error) {
      fail(error);
    }
  };

  // Moves the eye to the camera that the page's address names, if it names one.
  const followNamedCamera = () => followCamera(parseHash(location.hash) ?? parameters.camera, false);

  const setTurning = (isOn) => {
    turntable.turn(isOn);
    element("turn").setAttribute("aria-pressed", String(isOn));
  };

  const switchExposure = () => {
    if (!player.hasExposureMap) return;
    player.exposure = player.exposure === CONSISTENT ? AS_PHOTOGRAPHED : CONSISTENT;
    announce(`Exposure: ${player.exposure.replace("-", " ")}`);
  };

  const share = () => {
    const exposure = player.hasExposureMap && player.exposure === CONSISTENT ? CONSISTENT : null;
    return shareView(formatCamera(player.eye, player.scene), exposure, opener.shown.isOwn);
  };

  const ifLoaded = (action) => () => player.loaded && action();
  const panel = new Panel(player, {
    choose,
    N: () => choose((player.camera + 1) % player.cameras.length),
    P: () => choose((player.camera + player.cameras.length - 1) % player.cameras.length),
    R: () => choose(player.camera),
    O: () => pick(player.canvas.clientWidth / 2, player.canvas.clientHeight / 2),
    T: () => setTurning(!turntable.on),
    F: toggleFullscreen,
    X: ifLoaded(switchExposure),
    L: ifLoaded(share),
    C: ifLoaded(async () => savePicture(await player.capture(), opener.shown.title)),
    H: () => panel.toggle(),
    "?": () => help.show(),
    Escape: dismiss,
  });
  const opener = new Opener(player, panel, embedded ? (parameters.title ?? embedded.title) : document.title);
  const acted = () => {
    glide.stop();
    turntable.pause();
    help.acted();
    player.schedule();
  };
  const controls = new Controls(player, damper, {
    acted, approach, press: (key) => panel.press(key), ignored: (kind) => toast(IGNORED_TEXTS[kind]),
  });
  player.movers.push(controls, damper, glide, turntable);
  if (parameters.exposure) player.exposure = parameters.exposure;

  // ---- events of the player

  player.addEventListener("progress", ({ detail }) => progress(detail.part));
  player.addEventListener("remark", ({ detail }) => remark(detail));
  player.addEventListener("failed", ({ detail }) => fail(detail));
  player.addEventListener("camera", ({ detail }) => {
    if (player.loaded) announce(`Camera ${detail + 1} of ${player.cameras.length}`);
  });
  player.addEventListener("opened", ({ detail }) => {
    for (const mover of [damper, glide]) mover.stop();
    opener.shown = opener.loading;
    panel.describe(detail, opener.shown.title);
    if (opener.shown.isOwn) followNamedCamera();
  });
  player.addEventListener("count", ({ detail }) => panel.describe(detail, opener.shown.title));
  player.addEventListener("loaded", () => {
    document.body.classList.remove("empty"); // the page's own scene may be loaded after a file failed
    revealCanvas(player);
    help.greet();
    if (!player.whole) return;
    element("loading").hidden = true;
    announce(`${opener.shown.title} is shown.`);
  });

  // ---- opening scenes

  element("file").onchange = ({ target }) => {
    opener.openFile(target.files[0]);
    target.value = ""; // so that choosing the same file again fires an event
  };
  for (const button of document.querySelectorAll(".choose")) button.onclick = () => element("file").click();
  addEventListener("dragover", (event) => {
    if (!event.dataTransfer.types.includes("Files")) return;
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  addEventListener("dragleave", ({ relatedTarget }) => relatedTarget ?? document.body.classList.remove("dropping"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    opener.openFile(event.dataTransfer.files[0]);
  });
  addEventListener("hashchange", () => followCamera(parseHash(location.hash), true));
  element("dismiss").onclick = element("enough").onclick = dismiss;
  if (parameters.autorotate && !prefersReducedMotion()) setTurning(true);

  if (embedded) {
    panel.describe(embedded, opener.shown.title);
    followNamedCamera();
  }
  const ready = opener.openFirst(Boolean(embedded), served, parameters);
  ready.catch((error) => {
    fail(error);
    postToParent("error", error.message);
  });
  if (parameters.wrong.length) fail(new Error(parameters.wrong.join(" ")));

  // The interface for scripts. Cameras are {width, height, fx, fy, cx, cy, camera_from_world: 4 x 4}, with OpenCV axes;
  // poses are in world units, the rest in pixels.
  let lastPicture = null;
  window.hyrfpack = {
    ready, // a promise that resolves when the scene is loaded
    show: async (camera) => { // moves the eye to a camera and draws its picture
      await ready;
      lastPicture = await player.show(camera);
    },
    pixels: () => lastPicture, // the RGB bytes of the last picture of `show`, top row first
    camera: () => player.viewed, // the camera of the window's picture
    frames: () => player.frames, // the number of frames drawn to the window
    player,
  };
}

try {
  start();
} catch (error) {
  document.body.classList.add("bare"); // hides the controls, which would have no effect
  fail(error);
  postToParent("error", error.message);
}
