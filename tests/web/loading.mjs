// Loads files without a browser, and drops them: `node loading.mjs`.
//
// Prints, as JSON, `loaderError`: the class of the error of a scene folder's loader that is disposed of before its
// manifest has arrived; `folderName`: the name that another one gives a scene in a folder whose name is no valid
// address; `cancelled`: whether a file that is not read is no longer downloaded, and whether the whole file is not,
// which a server sends in place of the rest of a broken download; `lifted`: what the controls of an embedded scene
// report when a pointer is released that was pressed elsewhere; `changes`: how many changes controls report when a key
// that flies is pressed on their canvas, which lies in a dialog, and in a field of that dialog; `zooms`: the signs of
// zooms by wheels, also by one with Shift, which browsers turn to the side, and by one to the side; `openErrors`: the
// errors of a scene and of another one that replaces it, where both fail, the other one first; `lateScenes`: the scenes
// that are opened, and those whose download is cancelled, if the page's own scene arrives after the user has opened
// another one, which fails, is shown, or is replaced by a third one that fails, too; and `partEvents`: the player's
// events when a part of a scene folder arrives that has the first exposure map of the scene, each with whether the scene
// has a map by then.

globalThis.window = globalThis.self = globalThis.parent = globalThis;
const page = { body: { classList: { remove() {}, toggle() {} } }, getElementById: () => ({}) };
globalThis.document = { baseURI: "http://host/", ...page };
globalThis.location = new URL("http://host/");
globalThis.navigator ??= { hardwareConcurrency: 2 };
globalThis.matchMedia = () => ({ matches: false });
globalThis.addEventListener = globalThis.removeEventListener = () => {};
const posted = [];
globalThis.Worker = class {
  postMessage(message) {
    posted.push(message);
  }

  terminate() {}
};
const { STREAMING } = await import("../../hyrfpack/web/viewer/stream/stream_loader.js");
const { fetchedFile } = await import("../../hyrfpack/web/viewer/source.js");
const { Controls } = await import("../../hyrfpack/web/viewer/controls.js");
const { Opener } = await import("../../hyrfpack/web/viewer/opener.js");
const { hasExposureMap } = await import("../../hyrfpack/web/viewer/exposure.js");

const player = Object.assign(new EventTarget(), { renderer: { largest: [4096, 4096] }, maxGaussians: 1 });
const createLoader = () => new STREAMING.StreamLoader({ player, workerAddress: "http://host/worker.js" });

async function* stall() {
  await new Promise(() => {});
}
const stalled = createLoader(), address = "http://host/50%/scene.json";
const failed = stalled.read({ name: "scene.json", address, views: null, stream: stall() }).catch((error) => error);
stalled.dispose();
const timeout = new Promise((done) => setTimeout(done, 2000, "none")), error = await Promise.race([failed, timeout]);

async function* yieldManifest() {
  yield new TextEncoder().encode("{}");
}
createLoader().read({ name: "scene.json", address, views: null, stream: yieldManifest() });
await new Promise((done) => setTimeout(done, 50));
const folderName = posted.find(({ stream }) => stream)?.stream.name ?? null;

// Returns an answer that records in `cancelled` that its request is aborted.
const cancelled = [false, false];
const answerWith = (pull, number, status, { signal }) => {
  signal.addEventListener("abort", () => (cancelled[number] = true));
  const body = new ReadableStream({ pull }, { highWaterMark: 0 });
  return new Response(body, { status, headers: { "Content-Length": "100" } });
};
globalThis.fetch = async (address, options) => answerWith(() => {}, 0, 200, options);
(await fetchedFile("http://host/a.hyrf")).stream.cancel?.();
let pulls = 0;
const breakOff = (controller) => {
  if (pulls++) controller.error(new Error("broken"));
  else controller.enqueue(new Uint8Array(10));
};
const answers = [[breakOff, 2], [() => {}, 1]];
globalThis.fetch = async (address, options) => answerWith(...answers.shift(), 200, options);
try {
  for await (const bytes of (await fetchedFile("http://host/a.hyrf")).stream) void bytes;
} catch {
  // the download cannot be resumed
}

const lifted = [], canvas = Object.assign(new EventTarget(), { style: {} });
canvas.getBoundingClientRect = () => ({ left: 0, top: 0 });
const ignored = (kind) => lifted.push(kind);
new Controls({ canvas }, null, { keyTarget: new EventTarget(), isEmbedded: true, acted: () => {}, ignored });
canvas.dispatchEvent(Object.assign(new Event("pointerup"), { pointerId: 1, clientX: 5, clientY: 5 }));

let changes = 0;
const move = () => {}, inDialog = () => ({}), flown = { canvas, eye: { pace: 1, move }, changed: () => changes++ };
const press = (target) => {
  target.closest = inDialog;
  new Controls(flown, null, { keyTarget: target, isEmbedded: false, acted: () => {} });
  target.dispatchEvent(Object.assign(new Event("keydown"), { key: "w", code: "KeyW" }));
  return changes;
};
const changesOf = [press(canvas), press(new EventTarget())];

const zooms = [], turned = Object.assign(new EventTarget(), { style: {}, clientWidth: 100, clientHeight: 100 });
turned.getBoundingClientRect = () => ({ left: 0, top: 0 });
const zoomer = { zoom: (step) => zooms.push(Math.sign(step)) };
new Controls({ canvas: turned, eye: { focal: 1 } }, zoomer, { keyTarget: turned, isEmbedded: false, acted: () => {} });
for (const [deltaX, deltaY, shiftKey] of [[0, 9, false], [0, -9, true], [9, 0, true], [9, 0, false]]) {
  const wheel = { deltaX, deltaY, shiftKey, deltaMode: 0, clientX: 50, clientY: 50 };
  turned.dispatchEvent(Object.assign(new Event("wheel", { cancelable: true }), wheel));
}

const openErrors = [], rejections = [];
const failing = { open: () => new Promise((_, reject) => rejections.push(reject)) };
const opener = new Opener(failing, null, { title: "a scene" });
const openFailing = (name) => opener.open(async () => ({ name })).catch(({ message }) => openErrors.push(message));
const names = ["first", "second"], opened = [];
for (const name of names) {
  opened.push(openFailing(name));
  await new Promise((done) => setTimeout(done));
}
for (const number of [1, 0]) {
  rejections[number](new Error(names[number]));
  await opened[number];
}

// Opens scenes, each of which is still loading when the next one is opened. The first one arrives last of all. `ends` says
// of the others, by their names, whether they fail. Returns the names of scenes that are shown, and those cancelled.
async function openLate(ends) {
  const shown = [], cancelled = [], scenes = new Map(), wait = () => new Promise((done) => setTimeout(done));
  const openScene = ({ name }) => new Promise((done, failed) => {
    scenes.set(name, () => (ends[name] ? failed(new Error(name)) : done(shown.push(name))));
    if (name === "own") scenes.get(name)();
  });
  const late = new Opener({ open: openScene }, null, { title: "a scene" });
  let arrive = null;
  const own = late.open(() => new Promise((done) => (arrive = done)));
  for (const name of Object.keys(ends)) {
    late.open(async () => ({ name, stream: {} }), null, false).catch(() => {});
    await wait();
  }
  arrive({ name: "own", stream: { cancel: () => cancelled.push("own") } });
  for (const name of Object.keys(ends).reverse()) {
    await wait();
    scenes.get(name)();
  }
  await own;
  return { shown, cancelled };
}
const lateScenes = [await openLate({ a: true }), await openLate({ a: false }), await openLate({ a: true, b: true })];

const partEvents = [], place = { scale: 1 }, parts = [{ exposure: null, place }, { exposure: null, place }];
player.scene = { near: 1, sortNear: 1, exposure: null, parts };
player.emit = (name) => partEvents.push([name, hasExposureMap(player.scene)]);
const streamed = Object.assign(createLoader(), { current: 1, fields: { addPart: () => {} } });
streamed.addPart({ number: 1, part: 1, exposure: {}, place });

const loaderError = error.constructor.name;
const result = { loaderError, folderName, cancelled: cancelled.slice(0, 2), lifted, changes: changesOf, partEvents };
console.log(JSON.stringify({ ...result, zooms, openErrors, lateScenes }));
process.exit();
