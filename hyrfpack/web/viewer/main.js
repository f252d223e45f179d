// Connects the player, the controls, the panel and the source of the scene.

import { formatCamera, parseCamera, parseHash, parseSearch, resolveAddress } from "./address.js";
import { Controls } from "./controls.js";
import { AS_PHOTOGRAPHED, CONSISTENT } from "./exposure.js";
import { Help } from "./help.js";
import { Damper, Glide, Turntable, prefersReducedMotion } from "./motion.js";
import { announce, dismiss, fail, progress, remark, toast } from "./notifications.js";
import { Panel } from "./panel.js";
import { element, elementText } from "./dom.js";
import { readPayload } from "./payload.js";
import { Player } from "./player.js";
import { savePicture, shareView } from "./share.js";
import { chosenFile, fetchedFile } from "./source.js";
import { followTraining, trainingTitle } from "./training.js";

const FADE_MS = 600; // the duration in style.css
const NOT_STARTED_TEXT = "The training has not taken its first step yet.";
const TRAINING_ENDED_TEXT = "The training does not answer any more; this is its last snapshot.";
const IGNORED_TEXTS = {
  wheel: "Click the scene, then the wheel zooms.",
  finger: "Tap the scene, then fingers move it.",
};

// Reports a load or an error to the page around this one, where <hyrf-viewer> handles it.
const postToParent = (hyrf, message = "") => {
  if (window.parent !== window) window.parent.postMessage({ hyrf, message }, "*");
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
  // Whether the shown scene and the loading one were named by the page or its address, and not chosen by the user.
  let isOwn = true, isNextOwn = true;
  let title = embedded ? (parameters.title ?? embedded.title) : document.title;
  let nextTitle = title; // the title of the scene that is loading
  let openCount = 0; // identifies the scene that was opened last
  let lastPicture = null;

  // ---- cameras

  const choose = (camera) => {
    if (player.scene && camera < player.cameras.length) glide.to(() => player.choose(camera));
  };

  const pick = (x, y) => {
    if (player.pick(x, y)) showRing(x, y);
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
    return shareView(formatCamera(player.eye, player.scene), exposure, isOwn);
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
    C: ifLoaded(async () => savePicture(await player.capture(), title)),
    H: () => panel.toggle(),
    "?": () => help.show(),
    Escape: dismiss,
  });
  const acted = () => {
    glide.stop();
    turntable.pause();
    help.acted();
    player.schedule();
  };
  const controls = new Controls(player, damper, {
    acted, pick, press: (key) => panel.press(key), ignored: (kind) => toast(IGNORED_TEXTS[kind]),
  });
  player.movers.push(controls, damper, glide, turntable);
  if (parameters.exposure) player.exposure = parameters.exposure;

  // ---- events of the player

  player.addEventListener("progress", ({ detail }) => progress(detail));
  player.addEventListener("remark", ({ detail }) => remark(detail));
  player.addEventListener("failed", ({ detail }) => fail(detail));
  player.addEventListener("camera", ({ detail }) => {
    if (player.loaded) announce(`Camera ${detail + 1} of ${player.cameras.length}`);
  });
  player.addEventListener("opened", ({ detail }) => {
    for (const mover of [damper, glide]) mover.stop();
    [title, isOwn] = [nextTitle, isNextOwn];
    panel.describe(detail, title);
    if (isOwn) followCamera(parseHash(location.hash) ?? parameters.camera, false);
  });
  player.addEventListener("count", ({ detail }) => panel.describe(detail, title)); // more layers were loaded
  player.addEventListener("loaded", () => {
    document.body.classList.remove("empty"); // the page's own scene may be loaded after a file failed
    revealCanvas(player);
    help.greet();
    if (!player.whole) return;
    element("loading").hidden = true;
    announce(`${title} is shown.`);
  });

  // ---- opening scenes

  // Opens a scene. `fetchFile` returns a promise of {name, stream}. `name` is the scene's title; if it is null, the
  // file's name is. `isGiven` is true if the page or its address names the scene.
  const open = async (fetchFile, name = null, isGiven = true) => {
    const thisOpen = ++openCount;
    dismiss();
    document.body.classList.remove("empty");
    try {
      progress({ what: "loading", part: 0 });
      const file = await fetchFile();
      if (thisOpen !== openCount) return;
      [nextTitle, isNextOwn] = [name ?? file.name.replace(/\.\w+$/, ""), isGiven];
      await player.open(file);
      postToParent("load");
    } catch (error) {
      if (thisOpen !== openCount) return; // another scene was opened meanwhile
      document.body.classList.toggle("empty", !player.loaded);
      throw error;
    }
  };

  const openFile = (file) => {
    if (!file) return;
    open(async () => chosenFile(file), null, false).catch(fail);
  };

  // Returns the cameras of a file in the page's folder, {cameras, up, target}, or null if the page has none for it.
  const findStage = (address) => {
    const stages = Object.entries(served?.stages ?? {});
    return stages.find(([name]) => new URL(encodeURI(name), document.baseURI).href === address)?.[1] ?? null;
  };

  // Shows a model that is being trained. Newer snapshots replace it without moving the eye.
  const watchTraining = (address, updates) => new Promise((shown, failed) => {
    let thisOpen = openCount, isShown = false; // changes when the user opens a file
    const isWanted = () => thisOpen === openCount;
    const show = async (progress) => {
      const name = trainingTitle(served.title, progress);
      if (!isShown) {
        remark("");
        const opening = open(() => fetchedFile(address), name);
        thisOpen = openCount;
        await opening;
        isShown = true;
        return shown();
      }
      const file = await fetchedFile(address);
      if (!isWanted()) return;
      await player.open({ ...file, update: true });
      if (!isWanted()) return;
      title = nextTitle = name;
      panel.setTitle(player.scene, title);
    };
    const ended = followTraining(updates, { show, waiting: () => remark(NOT_STARTED_TEXT), isWanted });
    ended.then(() => isWanted() && remark(TRAINING_ENDED_TEXT), failed);
  });

  const openFirst = async () => {
    if (embedded) {
      panel.describe(embedded, title);
      followCamera(parseHash(location.hash) ?? parameters.camera, false);
      await player.load(readPayload(), element("background"));
      postToParent("load");
      return;
    }
    const address = parameters.content ?? (served?.content ? resolveAddress(served.content, "content") : null);
    const updates = parameters.content || !served?.updates ? null : resolveAddress(served.updates, "content");
    if (updates) return watchTraining(address, updates);
    if (address) {
      const name = parameters.title ?? (parameters.content ? null : served.title);
      return open(async () => ({ ...(await fetchedFile(address)), stage: findStage(address) }), name);
    }
    element("loading").hidden = true;
    document.body.classList.add("empty");
  };

  element("file").onchange = ({ target }) => {
    openFile(target.files[0]);
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
    openFile(event.dataTransfer.files[0]);
  });
  addEventListener("hashchange", () => followCamera(parseHash(location.hash), true));
  element("dismiss").onclick = element("enough").onclick = dismiss;
  if (parameters.autorotate && !prefersReducedMotion()) setTurning(true);

  const ready = openFirst();
  ready.catch((error) => {
    fail(error);
    postToParent("error", error.message);
  });
  if (parameters.wrong.length) fail(new Error(parameters.wrong.join(" ")));

  // The interface for scripts. Cameras are {width, height, fx, fy, cx, cy, camera_from_world: 4 x 4}, with OpenCV axes;
  // poses are in world units, the rest in pixels.
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
