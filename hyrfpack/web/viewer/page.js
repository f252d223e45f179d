// Connects the player, its navigation, the panel and the opener of scenes.

import { formatCamera, parseCamera, parseHash, parseSearch, resolveAddress } from "./address.js";
import { element, elementText } from "./dom.js";
import { AS_PHOTOGRAPHED, CONSISTENT } from "./exposure.js";
import { Help } from "./help.js";
import { prefersReducedMotion } from "./motion.js";
import { Navigation } from "./navigation.js";
import { announce, dismiss, fail, progress, remark, toast } from "./notifications.js";
import { Opener, findFirstFile, postToParent } from "./opener.js";
import { Panel } from "./panel.js";
import { Player } from "./player.js";
import { Poster } from "./poster.js";
import { savePicture, shareView } from "./share.js";
import { setTextSource } from "./texts.js";

const FADE_MS = 600; // a little longer than the transition in style.css
const IGNORED_TEXTS = {
  wheel: "Click the scene, then the wheel zooms.",
  finger: "Tap the scene, then fingers move it.",
};

// Shows the picture that the address names, or else the page's, and returns it. The page's is one of its own file from
// the first camera; if the address names another file or camera, it is removed. Returns null without a picture.
function showPoster(parameters, embedded, { isOwn, views }) {
  const named = namedCamera(parameters);
  const isFirstView = named === null || named === "1", picture = element("poster");
  const address = embedded ? null : parameters.poster; // the policy of a page of one file forbids other pictures
  if (!address && !(isFirstView && (embedded || isOwn))) picture?.remove();
  else if (address || picture) {
    const image = picture ?? Object.assign(new Image(), { id: "poster", alt: "" });
    if (address) image.src = address;
    document.body.append(image);
    return new Poster(image, element("view"), isFirstView ? (embedded ?? views)?.cameras[0] : null);
  }
  return null;
}

// Fades in the canvas over the poster after the first frame.
function revealCanvas(player, poster) {
  if (player.times.first === null && !player.idle) return requestAnimationFrame(() => revealCanvas(player, poster));
  document.body.classList.add("there");
  setTimeout(() => poster?.remove(), FADE_MS);
}

// Returns the text of the camera that the page's address names, or null.
const namedCamera = (parameters) => parseHash(location.hash) ?? parameters.camera;

// Marks the picked point for a moment.
function showRing(x, y) {
  const ring = element("ring");
  Object.assign(ring.style, { left: `${x}px`, top: `${y}px` });
  ring.hidden = true;
  ring.getBoundingClientRect(); // restarts the animation by forcing a layout
  ring.hidden = false;
  ring.onanimationend = () => (ring.hidden = true);
}

// Shows an error, also to the page around this one.
function report(error) {
  fail(error);
  postToParent("error", error.message);
}

// Fills the screen with the page, or ends that; a browser may refuse it.
function toggleFullscreen() {
  const page = document.documentElement;
  const changed = document.fullscreenElement ? document.exitFullscreen() : page.requestFullscreen?.();
  changed?.catch(() => {});
}

// Shows the page in place of its text that the player has not started. In pages of one file, boot.js has done so.
function showPage() {
  if (!element("stalled")) return;
  document.body.classList.add("started");
  element("page").hidden = false;
  element("stalled").remove();
  postToParent("start");
}

function start({ startEditing = () => {}, streaming = null, watchTraining }) {
  showPage();
  // In a folder, hyrfpack.web.player writes the constant EMBEDDED_TEXTS in front of this script.
  const isInFolder = typeof EMBEDDED_TEXTS !== "undefined";
  setTextSource(isInFolder ? (name) => EMBEDDED_TEXTS[name] : elementText);
  const workerAddress = isInFolder ? resolveAddress("player-worker.js", "worker") : null;
  const parameters = parseSearch(location.search);
  document.body.classList.toggle("bare", parameters.noui);
  const embedded = element("scene") ? JSON.parse(elementText("scene")) : null;
  const served = element("content") ? JSON.parse(elementText("content")) : null;

  const firstFile = findFirstFile(served, parameters), { isOwn } = firstFile;
  const poster = showPoster(parameters, embedded, firstFile);
  const maxGaussians = parameters.gaussians;
  const player = new Player(element("view"), { scene: embedded, workerAddress, streaming, maxGaussians });
  const help = new Help();
  const navigation = new Navigation(player, {
    keyTarget: window,
    isEmbedded: window.parent !== window,
    press: (key) => panel.press(key),
    ignored: (kind) => toast(IGNORED_TEXTS[kind]),
    acted: () => help.acted(),
    picked: showRing,
  });

  // ---- cameras

  // Moves the eye to the camera of a text from the address (null for none), and shows an error if it is invalid.
  const followCamera = (text, smoothly) => {
    if (text === null || !player.scene) return;
    try {
      navigation.moveTo(parseCamera(text, player.scene), smoothly ? undefined : 0);
      if (smoothly) dismiss();
    } catch ({ message }) {
      report({ message: `The camera in the address cannot be used: ${message}.` });
    }
  };

  // Moves the eye to the camera that the page's address names, if it names one.
  const followNamedCamera = () => followCamera(namedCamera(parameters), false);

  const setTurning = (isOn) => {
    navigation.turntable.turn(isOn);
    element("turn").setAttribute("aria-pressed", isOn);
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
  const chooseNext = (step) => {
    const { length } = player.cameras;
    navigation.choose((player.camera + length + step) % length);
  };
  const panel = new Panel(player, {
    choose: (number) => navigation.choose(number),
    N: () => chooseNext(1),
    P: () => chooseNext(-1),
    R: () => chooseNext(0),
    O: () => navigation.pick(player.canvas.clientWidth / 2, player.canvas.clientHeight / 2),
    T: () => setTurning(!navigation.turntable.on),
    F: toggleFullscreen,
    X: ifLoaded(switchExposure),
    L: ifLoaded(share),
    C: ifLoaded(async () => savePicture(await player.capture(), opener.shown.title)),
    H: () => panel.toggle(),
    M: () => panel.toggleSettings(),
    V: () => player.cameras.length > 1 && panel.strip.toggle(),
    "?": () => help.show(),
    Escape: () => {
      dismiss();
      panel.toggleSettings(false);
    },
  });
  const title = embedded ? (parameters.title ?? embedded.title) : document.title;
  const opener = new Opener(player, panel, { title, watchTraining });
  const isCredited = embedded || isOwn || firstFile.views;
  const { file } = embedded ?? (isOwn && served) ?? {};
  const editor = startEditing({ player, navigation, panel, opener, file });
  if (parameters.exposure) player.exposure = parameters.exposure;

  // ---- events of the player

  const on = (event, listener) => player.addEventListener(event, ({ detail }) => listener(detail));
  on("progress", ({ part }) => progress(part));
  on("remark", remark);
  on("failed", report);
  on("camera", (number) => {
    if (player.loaded) announce(`Camera ${number + 1} of ${player.cameras.length}`);
  });
  on("opened", (scene) => {
    navigation.stop();
    opener.shown = player.loader.origin ?? opener.shown;
    if (scene.isStreamed && !opener.shown.isNamed) opener.shown.title = scene.title; // the manifest has it
    panel.describe(scene, opener.shown.title);
    element("credit").hidden = !(opener.shown.isOwn && isCredited);
    if (opener.shown.isOwn) followNamedCamera();
  });
  on("count", (scene) => panel.setTitle(scene, opener.shown.title));
  on("loaded", () => {
    document.body.classList.remove("empty"); // the page's own scene may be loaded after a file failed
    revealCanvas(player, poster);
    help.greet();
    if (!player.whole) return;
    element("loading").hidden = true;
    announce(`${opener.shown.title} is shown.`);
  });

  // ---- opening scenes

  const openFile = (file) => {
    if (!file) return;
    poster?.remove();
    opener.openFile(file);
  };
  element("file").onchange = ({ target }) => {
    openFile(target.files[0]);
    target.value = ""; // so that choosing the same file again fires an event
  };
  for (const button of document.querySelectorAll(".choose")) button.onclick = () => element("file").click();
  for (const type of ["dragover", "drop"]) {
    addEventListener(type, (event) => {
      if (!event.dataTransfer.types.includes("Files")) return; // text may be dropped into fields
      event.preventDefault();
      document.body.classList.toggle("dropping", type === "dragover");
      if (type === "drop") openFile(event.dataTransfer.files[0]);
    });
  }
  addEventListener("dragleave", ({ relatedTarget }) => relatedTarget ?? document.body.classList.remove("dropping"));
  addEventListener("hashchange", () => followCamera(parseHash(location.hash), true));
  element("dismiss").onclick = element("enough").onclick = dismiss;
  if (parameters.autorotate && !prefersReducedMotion()) setTurning(true);

  if (embedded) {
    panel.describe(embedded, opener.shown.title);
    followNamedCamera();
  }
  element("credit").hidden = !isCredited;
  const ready = opener.openFirst(Boolean(embedded), served, parameters, firstFile);
  ready.catch(report);
  if (parameters.wrong.length) report({ message: parameters.wrong.join(" ") });

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
    editor, // of pages that edit scenes
  };
}

// Starts the page. `startEditing(parts)` is called with its player, navigation, panel, opener, and the name of its file
// if the page states it, and returns the editor. `streaming` is for Player, and `watchTraining` for Opener.
export function startPage(options = {}) {
  try {
    start(options);
  } catch (error) {
    document.body.classList.add("bare"); // hides the controls, which would have no effect
    report(error);
  }
}
