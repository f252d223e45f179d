// The page: puts player, controls, panel and the place where the scene comes from together.

import { compactCamera, parseCamera, readHash, readSearch, webAddress } from "./address.js";
import { Controls } from "./controls.js";
import { AS_PHOTOGRAPHED, CONSISTENT } from "./exposure.js";
import { Help } from "./help.js";
import { Damper, Glide, Turntable, calm } from "./motion.js";
import { announce, dismiss, fail, progress, remark, toast } from "./notes.js";
import { Panel } from "./panel.js";
import { element, textOf } from "./parts.js";
import { payload } from "./payload.js";
import { Player } from "./player.js";
import { savePicture, shareView } from "./share.js";
import { chosenFile, fetchedFile } from "./source.js";
import { followTraining, trainingTitle } from "./training.js";

const FADE = 600; // ms, see style.css
const NOT_BEGUN = "The training has not taken its first step yet.";
const ENDED = "The training does not answer any more; this is its last snapshot.";
const IGNORED = { wheel: "Click the scene, then the wheel zooms.", finger: "Tap the scene, then fingers move it." };

// A page around this one that has put it into a <hyrf-viewer> is told of loads and errors.
const tellFrame = (hyrf, message = "") => window.parent !== window && window.parent.postMessage({ hyrf, message }, "*");

// A picture until there is something to see.
function showPoster(address) {
  if (!address) return;
  const poster = element("poster") ?? Object.assign(document.createElement("img"), { id: "poster", alt: "" });
  poster.src = address;
  document.body.append(poster);
}

// Once there is, it comes up over the picture.
function appear(player) {
  if (player.times.first === null && !player.calm) return requestAnimationFrame(() => appear(player));
  document.body.classList.add("there");
  setTimeout(() => element("poster")?.remove(), FADE);
}

function showRing(x, y) {
  const ring = element("ring");
  Object.assign(ring.style, { left: `${x}px`, top: `${y}px` });
  ring.hidden = true;
  ring.getBoundingClientRect(); // so that its animation begins anew
  ring.hidden = false;
  ring.onanimationend = () => (ring.hidden = true);
}

function start() {
  const asked = readSearch(location.search);
  document.body.classList.toggle("bare", asked.noui);
  showPoster(asked.poster);
  const inside = element("scene") ? JSON.parse(textOf("scene")) : null;
  const beside = element("content") ? JSON.parse(textOf("content")) : null;

  const player = new Player(element("view"), inside);
  const damper = new Damper(player), glide = new Glide(player), turntable = new Turntable(player), help = new Help();
  let own = true, nextOwn = true; // what is shown, what is opened is the page's or the address's, not a person's
  let title = inside ? (asked.title ?? inside.title) : document.title, next = title; // that of what is shown, is opened
  let number = 0; // of what was opened
  let picture = null;

  // ---- moving

  const choose = (camera) => {
    if (player.scene && camera < player.cameras.length) glide.to(() => player.choose(camera));
  };

  const pick = (x, y) => {
    if (player.pick(x, y)) showRing(x, y);
  };

  // Stand where a text from the address says.
  const stand = (text, glides) => {
    const { number: camera, view, depth } = parseCamera(text, player.scene);
    const move = () => {
      if (camera !== undefined) return player.choose(camera);
      player.eye.stand(view);
      if (depth) player.eye.target = player.eye.point(0, 0, depth);
      player.changed();
    };
    if (glides) glide.to(move);
    else move();
  };

  const follow = (text, glides) => {
    if (text === null || !player.scene) return;
    try {
      stand(text, glides);
      if (glides) dismiss();
    } catch (error) {
      fail(error);
    }
  };

  const turn = (on) => {
    turntable.turn(on);
    element("turn").setAttribute("aria-pressed", String(on));
  };

  const switchExposure = () => {
    if (!player.hasExposureMap) return;
    player.exposure = player.exposure === CONSISTENT ? AS_PHOTOGRAPHED : CONSISTENT;
    announce(`Exposure: ${player.exposure.replace("-", " ")}`);
  };

  const share = () => {
    const exposure = player.hasExposureMap && player.exposure === CONSISTENT ? CONSISTENT : null;
    return shareView(compactCamera(player.eye, player.scene), exposure, own);
  };

  const whenThere = (action) => () => player.loaded && action();
  const panel = new Panel(player, {
    choose,
    N: () => choose((player.camera + 1) % player.cameras.length),
    P: () => choose((player.camera + player.cameras.length - 1) % player.cameras.length),
    R: () => choose(player.camera),
    O: () => pick(player.canvas.clientWidth / 2, player.canvas.clientHeight / 2),
    T: () => turn(!turntable.on),
    F: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen?.())?.catch(() => {}),
    X: whenThere(switchExposure),
    L: whenThere(share),
    C: whenThere(async () => savePicture(await player.capture(), title)),
    H: () => panel.toggle(),
    "?": () => help.show(),
    Escape: dismiss,
  });
  const acted = () => {
    glide.stop();
    turntable.pause();
    help.acted();
    player.wake();
  };
  const controls = new Controls(player, damper, {
    acted, pick, press: (key) => panel.press(key), ignored: (kind) => toast(IGNORED[kind]),
  });
  player.movers.push(controls, damper, glide, turntable);
  if (asked.exposure) player.exposure = asked.exposure;

  // ---- what the player tells

  player.addEventListener("progress", ({ detail }) => progress(detail));
  player.addEventListener("said", ({ detail }) => remark(detail));
  player.addEventListener("failed", ({ detail }) => fail(detail));
  player.addEventListener("stood", ({ detail }) => player.loaded && announce(`Camera ${detail + 1} of ${player.cameras.length}`));
  player.addEventListener("opened", ({ detail }) => {
    for (const mover of [damper, glide]) mover.stop();
    [title, own] = [next, nextOwn];
    panel.describe(detail, title);
    if (own) follow(readHash(location.hash) ?? asked.camera, false);
  });
  player.addEventListener("counted", ({ detail }) => panel.describe(detail, title)); // all layers of a file are here
  player.addEventListener("loaded", () => {
    document.body.classList.remove("empty"); // the page's own scene may come after a file that failed
    appear(player);
    help.greet();
    if (!player.whole) return;
    element("loading").hidden = true;
    announce(`${title} is shown.`);
  });

  // ---- where the scene comes from

  // `bring`: a promise of {name, stream}. `called`: what the scene is called, if not as the file.
  // `given`: by the page or its address.
  const open = async (bring, called = null, given = true) => {
    const mine = ++number;
    dismiss();
    document.body.classList.remove("empty");
    try {
      progress({ what: "loading", part: 0 });
      const file = await bring();
      if (mine !== number) return;
      [next, nextOwn] = [called ?? file.name.replace(/\.\w+$/, ""), given];
      await player.open(file);
      tellFrame("load");
    } catch (error) {
      if (mine !== number) return; // another file was chosen meanwhile
      document.body.classList.toggle("empty", !player.loaded);
      throw error;
    }
  };

  const openFile = (file) => {
    if (!file) return;
    open(async () => chosenFile(file), null, false).catch(fail);
  };

  // From where to look at a file beside the page, {cameras, up, target}, where the page says so.
  const stageOf = (address) => {
    const stages = Object.entries(beside?.stages ?? {});
    return stages.find(([name]) => new URL(encodeURI(name), document.baseURI).href === address)?.[1] ?? null;
  };

  // Show a model that is being trained, and each newer snapshot of it from where one stands.
  const watchTraining = (address, updates) => new Promise((shown, failed) => {
    let mine = number, begun = false; // what is opened by a person meanwhile has another number
    const wanted = () => mine === number;
    const show = async (progress) => {
      const called = trainingTitle(beside.title, progress);
      if (!begun) {
        remark("");
        const opening = open(() => fetchedFile(address), called);
        mine = number;
        await opening;
        begun = true;
        return shown();
      }
      const file = await fetchedFile(address);
      if (!wanted()) return;
      await player.open({ ...file, update: true });
      if (!wanted()) return;
      title = next = called;
      panel.entitle(player.scene, title);
    };
    followTraining(updates, { show, waiting: () => remark(NOT_BEGUN), wanted }).then(() => wanted() && remark(ENDED), failed);
  });

  const first = async () => {
    if (inside) {
      panel.describe(inside, title);
      follow(readHash(location.hash) ?? asked.camera, false);
      await player.load(payload(), element("background"));
      tellFrame("load");
      return;
    }
    const address = asked.content ?? (beside?.content ? webAddress(beside.content, "content") : null);
    const updates = asked.content || !beside?.updates ? null : webAddress(beside.updates, "content");
    if (updates) return watchTraining(address, updates);
    if (address) return open(async () => ({ ...(await fetchedFile(address)), stage: stageOf(address) }), asked.title ?? (asked.content ? null : beside.title));
    element("loading").hidden = true;
    document.body.classList.add("empty");
  };

  element("file").onchange = ({ target }) => {
    openFile(target.files[0]);
    target.value = ""; // the same file may be chosen again
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
  addEventListener("hashchange", () => follow(readHash(location.hash), true));
  element("dismiss").onclick = element("enough").onclick = dismiss;
  if (asked.autorotate && !calm()) turn(true);

  const ready = first();
  ready.catch((error) => {
    fail(error);
    tellFrame("error", error.message);
  });
  if (asked.wrong.length) fail(new Error(asked.wrong.join(" ")));

  // For scripts. Cameras are {width, height, fx, fy, cx, cy, camera_from_world: 4 x 4}, OpenCV axes, the world's units.
  window.hyrfpack = {
    ready, // a promise of the scene
    show: async (camera) => { // stands there and draws; a promise
      await ready;
      picture = await player.show(camera);
    },
    pixels: () => picture, // RGB bytes of what `show` drew last, top row first
    camera: () => player.viewed, // of the window
    frames: () => player.frames, // how many the window has been given
    player,
  };
}

try {
  start();
} catch (error) {
  document.body.classList.add("bare"); // nothing can be moved
  fail(error);
  tellFrame("error", error.message);
}
