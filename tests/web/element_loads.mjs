// Loads scenes in <hyrf-viewer> without a browser: `node element_loads.mjs`. No worker answers, so no scene is shown.
//
// Prints, as JSON,
//     `inline`: the requests of an element at first, and how many were added when the same `src` was set: while it
//         loads, after its load has failed, and after it has failed in the same moment as another `src` was set
//     `shown`: the requests that the same `src` adds while its scene is shown, and while a file of it is missing
//     `property`: the requests of an element whose property `src` was set before the class was defined, and to another
//         address later; its attribute; and the attribute after the property was set to null
//     `message`: whether the error is shown after the failure and after the next attempt has begun
//     `lost`: the message while the graphics context is lost, after a wheel that is left to the page
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
result.lost = message.textContent;

const early = new Viewer(), setSrc = (src) => addedBy(addresses, () => (early.src = src));
Object.defineProperty(early, "src", { value: "early.hyrf", configurable: true, writable: true, enumerable: true });
const earlyRequests = await addedBy(addresses, () => early.connectedCallback());
const laterRequests = await setSrc("later.hyrf");
const attribute = early.getAttribute("src");
await setSrc(null);
result.property = [earlyRequests, laterRequests, attribute, early.src];

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
