// Loads scenes in viewers without a browser: `node viewer_loads.mjs`. No worker answers, so that no scene is ever shown.
//
// Prints, as JSON,
//     `superseded`, `destroyed`: the errors of two loads whose server does not answer, when another scene is loaded and
//         when the viewer is destroyed, and whether their requests were aborted
//     `stalled`: the same for a download that has begun
//     `streams`: the same for the streams of an application, of which nothing was read and of which a part was read
//     `kept`: the lengths of the arrays of an application after its stream was loaded
//     `wrong`: the errors of arguments that are not valid

globalThis.Element = class extends EventTarget {
  style = {};

  setAttribute() {}

  append() {}

  remove() {}
};
class Observer {
  observe() {}

  disconnect() {}
}
const wait = (ms = 20) => new Promise((resolve) => setTimeout(resolve, ms));
globalThis.window = globalThis.self = globalThis;
globalThis.document = {
  baseURI: "http://host/",
  createElement: () => new Element(),
};
globalThis.location = new URL("http://host/");
globalThis.navigator ??= { hardwareConcurrency: 2 };
globalThis.matchMedia = () => ({ matches: false });
globalThis.addEventListener = globalThis.removeEventListener = () => {};
globalThis.IntersectionObserver = globalThis.ResizeObserver = Observer;
globalThis.Worker = class {
  postMessage(message, transfer) {
    structuredClone(message, { transfer });
  }

  terminate() {}
};
const { createViewer } = await import("../../hyrfpack/web/viewer/viewer.js");
const { setTextSource } = await import("../../hyrfpack/web/viewer/texts.js");
setTextSource(() => "");

class FakeRenderer {
  gl = { getExtension: () => null };

  async prepare() {}

  dispose() {}
}
const makeViewer = () => createViewer({ container: new Element(), renderer: FakeRenderer });
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

const texts = new ReadableStream({ start: (controller) => controller.enqueue("text") });
const locked = new ReadableStream();
locked.getReader();
const calls = {
  "a stream of texts": () => makeViewer().load(texts),
  "a locked stream": () => makeViewer().load(locked),
};
result.wrong = {};
for (const [what, call] of Object.entries(calls)) {
  result.wrong[what] = await (async () => call())().then(() => "", ({ message }) => message);
}

console.log(JSON.stringify(result));
process.exit();
