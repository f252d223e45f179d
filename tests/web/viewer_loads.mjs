// Loads scenes in viewers without a browser: `node viewer_loads.mjs`. No worker answers, so that no scene is ever shown.
//
// Prints, as JSON,
//     `superseded`, `destroyed`: the errors of two loads whose server does not answer, when another scene is loaded and
//         when the viewer is destroyed, and whether their requests were aborted
//     `stalled`: the same for a download that has begun
//     `streams`: the same for the streams of an application, of which nothing was read and of which a part was read
//     `kept`: the lengths of the arrays of an application after its stream was loaded
//     `listeners`: which listeners of an error were called, the errors that the page reports, and that of the load
//     `firstCameras`: the cameras to which a viewer with the option `camera` moves when a scene is opened: that of a load
//         after the first one has failed, and that of the first load
//     `wrong`: the errors of arguments that are not valid
//     `refusal`: the error of a page that requires Trusted Types and does not allow the policy of the viewer
//     `policies`: the policies that two viewers create on a page that allows them, and the addresses of their workers
//     `pixelRatios`: the media queries of a viewer at first and after each of two changes of the pixel ratio, the
//         frames that each change requests, and those that a change requests after the viewer was destroyed
//     `cameras`: how far 1,000 rounds of reading and setting the camera move it (`drift`), and how far a camera that was
//         set is from the one that is read back (`error`)

class FakeElement extends EventTarget {
  nodeType = 1;
  style = {};

  setAttribute() {}

  append() {}

  remove() {}
}
class Observer {
  observe() {}

  disconnect() {}
}
const reported = [], wait = (ms = 20) => new Promise((resolve) => setTimeout(resolve, ms));
globalThis.window = globalThis.self = globalThis;
globalThis.Node = { ELEMENT_NODE: 1 };
globalThis.document = {
  baseURI: "http://host/",
  createElement: () => new FakeElement(),
  querySelector: (selector) => {
    if (!selector) throw new DOMException("it is not a valid selector", "SyntaxError");
    return null;
  },
};
globalThis.location = new URL("http://host/");
globalThis.navigator ??= { hardwareConcurrency: 2 };
globalThis.devicePixelRatio = 1;
globalThis.matchMedia = (query) => Object.assign(new EventTarget(), { query, matches: false });
globalThis.addEventListener = globalThis.removeEventListener = () => {};
globalThis.IntersectionObserver = globalThis.ResizeObserver = Observer;
globalThis.reportError = ({ message }) => reported.push(message);
globalThis.Worker = class {
  postMessage(message, transfer) {
    structuredClone(message, { transfer });
  }

  terminate() {}
};
const { createViewer } = await import("../../hyrfpack/web/viewer/viewer.js");
const { setTextSource } = await import("../../hyrfpack/web/viewer/texts.js");
const { Eye, cameraOf, viewOf } = await import("../../hyrfpack/web/viewer/camera.js");
setTextSource(() => "");

class FakeRenderer {
  gl = { getExtension: () => null };

  async prepare() {}

  dispose() {}
}
const makeViewer = () => createViewer({ container: new FakeElement(), renderer: FakeRenderer });
const errorOf = (promise) => Promise.race([promise.then(() => "none", ({ name }) => name), wait(1000)]);

// Servers that do not answer, or that send only the beginning of a file.
const failWhenAborted = (signal, fail) => signal.addEventListener("abort", () => fail(signal.reason));
const signals = [];
const neverAnswer = (address, { signal }) => new Promise((_, reject) => {
  signals.push(signal);
  failWhenAborted(signal, reject);
});
const stall = async (address, { signal }) => {
  signals.push(signal);
  const start = (controller) => {
    controller.enqueue(new Uint8Array(10));
    failWhenAborted(signal, (reason) => controller.error(reason));
  };
  return new Response(new ReadableStream({ start }), { headers: { "Content-Length": "100" } });
};

// Drops two loads, one by a later load and one by the end of the viewer. Returns their errors, and whether `isEnded()`.
async function dropLoads(makeSource, isEnded) {
  const viewer = makeViewer(), loads = [];
  for (let number = 0; number < 2; number++) {
    loads.push(errorOf(viewer.load(makeSource(number))));
    await wait();
  }
  viewer.destroy();
  const errors = await Promise.all(loads);
  await wait();
  return errors.map((error, number) => [error, isEnded(number)]);
}
const dropRequests = () => dropLoads((number) => `http://host/${number}.hyrf`, (number) => signals[number].aborted);

const result = {};
globalThis.fetch = neverAnswer;
[result.superseded, result.destroyed] = await dropRequests();
signals.length = 0;
globalThis.fetch = stall;
result.stalled = await dropRequests();

const cancelled = [false, false];
const makeStream = (number, chunks) => new ReadableStream({
  start: (controller) => chunks.forEach((chunk) => controller.enqueue(chunk)),
  cancel: () => (cancelled[number] = true),
});
result.streams = await dropLoads(
  (number) => makeStream(number, number ? [new Uint8Array(10)] : []),
  (number) => cancelled[number],
);

const own = [new Uint8Array(10), new Uint8Array(20).subarray(5)];
makeViewer().load(makeStream(0, own)).catch(() => {});
await wait();
result.kept = own.map(({ length }) => length);

const viewer = makeViewer(), called = [];
viewer.on("error", () => {
  called.push("first");
  throw new Error("an error of the page");
});
viewer.on("error", () => called.push("second"));
const loadError = await viewer.load(42).catch(({ message }) => message);
result.listeners = { called: [...called], reported: [...reported], loadError };

// Opens a file in a viewer whose player shows it at once. Returns the cameras to which the viewer moves.
async function openAt(viewer) {
  const moves = [], { player } = viewer;
  viewer.moveTo = (camera) => moves.push(camera);
  player.open = async ({ origin }) => {
    player.loader = { origin };
    player.emit("opened");
  };
  await viewer.load(new Blob(["scene"]));
  return moves;
}
const openWith = (options) => createViewer({ container: new FakeElement(), renderer: FakeRenderer, ...options });
globalThis.fetch = async () => new Response("", { status: 404 });
const failed = openWith({ src: "http://host/gone.hyrf", camera: 5 });
await wait();
result.firstCameras = [await openAt(failed), await openAt(openWith({ camera: 5 }))];

const texts = new ReadableStream({ start: (controller) => controller.enqueue("text") });
const locked = new ReadableStream();
locked.getReader();
const calls = {
  "no options": () => createViewer(),
  "an empty selector": () => createViewer({ container: "" }),
  "no listener": () => viewer.on("ready", null),
  "no load options": () => viewer.load(42, null),
  "a stream of texts": () => viewer.load(texts),
  "a locked stream": () => viewer.load(locked),
  "a destroyed viewer": () => {
    viewer.destroy();
    viewer.moveTo(0);
  },
};
result.wrong = {};
for (const [what, call] of Object.entries(calls)) {
  result.wrong[what] = await (async () => call())().then(() => "", ({ message }) => message);
}

globalThis.Worker = class {
  constructor() {
    throw new TypeError("This document requires 'TrustedScriptURL' assignment.");
  }
};
result.refusal = await makeViewer().load(new Blob([])).catch(({ message }) => message);
const policies = [], workers = [];
globalThis.trustedTypes = {
  createPolicy: (name, { createScriptURL }) => {
    policies.push(name);
    return { createScriptURL: (address) => ({ trusted: createScriptURL(address) }) };
  },
};
globalThis.Worker = class {
  constructor({ trusted }) {
    workers.push(trusted.split(":")[0]);
  }

  postMessage() {}

  terminate() {}
};
for (const workerUrl of [null, "worker.js"]) openWith({ workerUrl }).load(new Blob(["scene"])).catch(() => {});
await wait();
result.policies = [policies, workers];

const queries = [], matchBefore = globalThis.matchMedia;
let frames = 0;
globalThis.requestAnimationFrame = () => frames++;
globalThis.matchMedia = (query) => {
  queries.push(matchBefore(query));
  return queries.at(-1);
};
const scaled = makeViewer();
scaled.player.loaded = true;
const changeRatio = (ratio) => {
  const before = frames;
  globalThis.devicePixelRatio = ratio;
  for (const query of [...queries]) query.dispatchEvent(new Event("change"));
  scaled.player.scheduled = false;
  return frames - before;
};
const requested = [changeRatio(2), changeRatio(1.5)];
scaled.destroy();
scaled.player.loaded = true;
result.pixelRatios = { queries: queries.map(({ query }) => query), requested, afterEnd: changeRatio(1) };

// The rows of this pose are rounded to 3 digits.
const scene = { center: [1000, -50, 20], unit: 4, up: [0, -1, 0], target: [1000, -50, 20] };
const pose = [[0.866, 0, 0.5, -875.3], [0, 1, 0, 50.4], [-0.5, 0, 0.866, 487.68], [0, 0, 0, 1]];
const size = { width: 120, height: 90, fx: 110, fy: 110, cx: 60, cy: 45 };
const eye = new Eye(scene, [viewOf({ ...size, camera_from_world: pose }, scene)]);
const readCamera = () => cameraOf(eye.view(120, 90), scene);
eye.setView(viewOf({ ...size, camera_from_world: pose }, scene));
const before = readCamera().camera_from_world;
for (let round = 0; round < 1000; round++) eye.setView(viewOf(readCamera(), scene));
const after = readCamera().camera_from_world;
const distances = (one, other) => one.flatMap((row, r) => row.map((value, c) => Math.abs(value - other[r][c])));
result.cameras = { drift: Math.max(...distances(before, after)), error: Math.max(...distances(pose, before)) };

console.log(JSON.stringify(result));
process.exit();
