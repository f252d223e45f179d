// Loads scenes in <hyrf-viewer> without a browser: `node element_loads.mjs`. No worker answers, so no scene is shown.
//
// Prints, as JSON,
//     `inline`: the requests of an element at first, and how many were added when the same `src` was set: while it
//         loads, after its load has failed, and after it has failed in the same moment as another `src` was set
//     `shown`: the requests that the same `src` adds while its scene is shown, and while a file of it is missing
//     `property`: the requests of an element whose property `src` was set before the class was defined, and to another
//         address later; its attribute; and the attribute after the property was set to null
//     `message`: whether the error is shown after the failure and after the next attempt has begun
//     `lost`: the message while the graphics context is lost, after a wheel that is left to the page, and whether it is
//         shown after progress of the load
//     `overlapping`: whether the error of a load is shown at first, after progress of the scene that is shown and after
//         progress of a later load, and whether an error of the attribute `exposure` is shown after progress of the
//         load during which it was set
//     `suspended`: what an element opens when it resumes, {addresses: requests, camera, size: of a Blob, name}, by what
//         its viewer has shown before: the scene of `src`, that of another address, one of bytes, and one of a stream;
//         and, after another address, for an element whose `camera` or `src` was changed meanwhile
//     `failing`: the camera with which an element resumes its own scene after another could not be loaded; and the
//         addresses that it opens when it resumes a scene of a script, which is missing, and when it resumes again
//     `corrected`: the address that an element opens after a wrong attribute was corrected, with a scene of a script
//     `frame`: how many frames were made at first, and by the same `src` after an error and after a load

const addresses = [], frames = [], listeners = [];
const wait = () => new Promise((resolve) => setTimeout(resolve, 20));

class FakeElement extends EventTarget {
  nodeType = 1;
  style = {};
  classList = { add() {}, remove() {} };
  attributes = new Map();
  isConnected = true;

  getContext() {
    return new Proxy({}, { get: () => () => null });
  }

  attachShadow() {
    this.shadowRoot = new FakeElement();
    return this.shadowRoot;
  }

  getAttribute(name) {
    return this.attributes.get(name) ?? null;
  }

  hasAttribute(name) {
    return this.attributes.has(name);
  }

  setAttribute(name, value) {
    const before = this.getAttribute(name);
    this.attributes.set(name, value);
    this.attributeChangedCallback?.(name, before, value);
  }

  removeAttribute(name) {
    const before = this.getAttribute(name);
    if (this.attributes.delete(name)) this.attributeChangedCallback?.(name, before, null);
  }

  append() {}

  remove() {}
}
class Observer {
  observe() {}

  unobserve() {}

  disconnect() {}
}
let Viewer = null; // the class of the element
globalThis.window = globalThis.self = globalThis;
globalThis.Node = { ELEMENT_NODE: 1 };
globalThis.HTMLElement = FakeElement;
globalThis.CSSStyleSheet = class {
  replaceSync() {}
};
globalThis.customElements = { get: () => null, define: (name, definition) => (Viewer = definition) };
globalThis.document = {
  baseURI: "http://host/",
  createElement: (name) => {
    const made = new FakeElement();
    if (name === "iframe") frames.push(Object.assign(made, { contentWindow: made }));
    return made;
  },
};
globalThis.location = new URL("http://host/");
globalThis.navigator ??= { hardwareConcurrency: 2 };
globalThis.devicePixelRatio = 1;
globalThis.matchMedia = () => Object.assign(new EventTarget(), { matches: false });
globalThis.addEventListener = (name, listener) => name === "message" && listeners.push(listener);
globalThis.removeEventListener = () => {};
globalThis.IntersectionObserver = globalThis.ResizeObserver = Observer;
globalThis.Worker = class {
  postMessage() {}

  terminate() {}
};
const { defineElement } = await import("../../hyrfpack/web/viewer/element.js");
const { setTextSource } = await import("../../hyrfpack/web/viewer/texts.js");
setTextSource(() => "");
defineElement("http://host/worker.js");

let answer = null; // answers a request
globalThis.fetch = (address) => {
  addresses.push(address.split("/").pop());
  return new Promise((resolve) => (answer = () => resolve(new Response("", { status: 404 }))));
};

async function connect(attributes) {
  const element = new Viewer();
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.connectedCallback();
  await wait();
  return element;
}
async function addedBy(counted, change) {
  const before = counted.length;
  await change();
  await wait();
  return counted.slice(before);
}

const result = {}, element = await connect({ src: "a.hyrf" }), first = [...addresses];
const setAgain = () => element.setAttribute("src", "a.hyrf");
const whileLoading = await addedBy(addresses, setAgain);
answer();
await wait();
const { message } = element.view, messages = [!message.hidden];
const afterFailure = await addedBy(addresses, setAgain);
messages.push(!message.hidden);
answer();
await wait();
const atOnce = await addedBy(addresses, () => {
  element.setAttribute("src", "b.hyrf");
  setAgain();
});
result.inline = [first, whileLoading, afterFailure, atOnce];
result.message = messages;

const { viewer } = element;
viewer.player.loader = { origin: viewer.currentLoad };
viewer.emit("progress", { progress: 1 });
viewer.emit("ready", {});
const afterSuccess = await addedBy(addresses, setAgain);
viewer.emit("error", { error: new Error("a file is missing"), option: "src" });
result.shown = [afterSuccess, await addedBy(addresses, setAgain)];

Object.assign(element.view, { isNear: true, isFailed: false });
viewer.canvas.dispatchEvent(new Event("webglcontextlost"));
viewer.emit("ignored", { kind: "wheel" });
viewer.player.emit("progress", { part: 0.5 });
result.lost = [message.textContent, !message.hidden];

const early = new Viewer(), setSrc = (src) => addedBy(addresses, () => (early.src = src));
Object.defineProperty(early, "src", { value: "early.hyrf", configurable: true, writable: true, enumerable: true });
const earlyRequests = await addedBy(addresses, () => early.connectedCallback());
const laterRequests = await setSrc("later.hyrf");
const attribute = early.getAttribute("src");
await setSrc(null);
result.property = [earlyRequests, laterRequests, attribute, early.src];

const overlapped = await connect({ src: "first.hyrf" }), isShown = () => !overlapped.view.message.hidden;
const { viewer: busy } = overlapped, makeProgress = () => busy.player.emit("progress", { part: 0.5 });
const showLast = (viewer) => (viewer.player.loader = { origin: viewer.currentLoad, dispose() {} });
showLast(busy);
busy.load("missing.hyrf").catch(() => {});
await wait();
answer();
await wait();
result.overlapping = [isShown()];
makeProgress();
result.overlapping.push(isShown());
busy.load("later.hyrf").catch(() => {});
makeProgress();
result.overlapping.push(isShown());
overlapped.setAttribute("exposure", "none");
await wait();
makeProgress();
result.overlapping.push(isShown());

// Shows a source in an element, suspends it, makes changes and resumes it. Returns what it opens.
async function resumeAfter(source, change = () => {}) {
  const element = await connect({ src: "own.hyrf", camera: "2" }), { view, viewer } = element;
  if (source) viewer.load(source, { name: "a name" }).catch(() => {});
  showLast(viewer);
  Object.defineProperty(viewer, "cameraText", { value: "its camera" });
  const requests = await addedBy(addresses, async () => {
    view.suspend();
    change(element);
    await wait();
    view.open();
  });
  const { currentLoad: { firstCamera, source: opened, name = null } } = view.viewer;
  return { addresses: requests, camera: firstCamera, size: opened?.size ?? null, name };
}
result.suspended = {
  own: await resumeAfter(null),
  other: await resumeAfter("other.hyrf"),
  bytes: await resumeAfter(new DataView(new ArrayBuffer(10), 3)),
  stream: await resumeAfter(new ReadableStream()),
  camera: await resumeAfter("other.hyrf", (element) => element.setAttribute("camera", "3")),
  src: await resumeAfter("other.hyrf", (element) => element.setAttribute("src", "new.hyrf")),
};


// The same for an element with a scene of its own, of which a script has loaded another that is missing.
const failing = await connect({ src: "own.hyrf" }), { view } = failing;
showLast(failing.viewer);
Object.defineProperty(failing.viewer, "cameraText", { value: "its camera" });
failing.viewer.load("missing.hyrf").catch(() => {});
await wait();
answer();
await wait();
view.suspend();
view.open();
const resumed = [failing.viewer.currentLoad.firstCamera];
failing.viewer.load("other.hyrf").catch(() => {});
showLast(failing.viewer);
for (const isMissing of [true, false]) {
  view.suspend();
  view.open();
  resumed.push(addresses.at(-1));
  await wait();
  if (isMissing) answer();
  await wait();
}
result.failing = resumed;

const corrected = await connect({ src: "own.hyrf" });
corrected.viewer.load("other.hyrf").catch(() => {});
showLast(corrected.viewer);
for (const interaction of ["allways", "always"]) {
  corrected.setAttribute("interaction", interaction);
  await wait();
  corrected.view.open();
}
result.corrected = addresses.at(-1);

const framed = await connect({ src: "a.hyrf", player: "index.html", frame: "" });
const send = (hyrf) => listeners.at(-1)({ source: frames.at(-1), data: { hyrf, message: "" } });
const setFramedAgain = () => framed.setAttribute("src", "a.hyrf");
result.frame = [frames.length];
send("error");
result.frame.push((await addedBy(frames, setFramedAgain)).length);
send("load");
result.frame.push((await addedBy(frames, setFramedAgain)).length);

console.log(JSON.stringify(result));
process.exit();
