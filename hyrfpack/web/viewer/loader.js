// The worker that reads files and sorts, seen from the page.

import { sidesOf } from "./frustum.js";
import { textOf } from "./parts.js";

// Another file took this one's place.
export class Superseded extends Error {}

export class Loader {
  // `content(message)` takes each content that was read (see worker.js), one after the other, and is a promise whether
  // it is shown now; `progress({what, part})`.
  constructor({ content, progress }) {
    if (!window.DecompressionStream) throw new Error("This browser is too old to unpack the scene; take a newer one.");
    Object.assign(this, { content, progress });
    this.ticket = 0;
    this.waiting = new Map(); // ticket -> what to do with the order
    this.spare = null; // an order's array to be used again
    const address = URL.createObjectURL(new Blob([textOf("worker.js")], { type: "text/javascript" }));
    this.worker = new Worker(address);
    URL.revokeObjectURL(address);
    this.worker.onmessage = ({ data }) => {
      if (data.progress) this.progress(data.progress);
      if (data.content) this.hand(data.content);
      if (data.order) this.sorted(data.order);
      if (data.error) this.fail(new Error(data.error));
    };
    this.worker.onerror = ({ message }) => this.fail(new Error(message));
    this.handed = Promise.resolve();
    this.broken = false; // not all of the file can be had; what of it was shown can be had again
    this.expecting = []; // {resolve, reject} of promises that all that can be had is shown
  }

  hand(content) {
    this.handed = this.handed.then(() => this.content(content)).then(
      (shown) => {
        if (shown && (content.whole || this.broken)) this.expecting.splice(0).forEach(({ resolve }) => resolve());
      },
      (error) => this.fail(error),
    );
  }

  // A promise that all that can be had is shown.
  expect() {
    return new Promise((resolve, reject) => this.expecting.push({ resolve, reject }));
  }

  fail(error) {
    this.broken = true;
    this.expecting.splice(0).forEach(({ reject }) => reject(error));
  }

  // Read a file: an async iterable of its bytes, which are taken away, and which may know their `length`.
  async read({ name, scene, stage, plain = false, stream, length = stream.length }) {
    const shown = this.expect(), source = stream[Symbol.asyncIterator]();
    this.worker.postMessage({ start: { name, scene, stage, plain } });
    try {
      for (let part = 0;;) {
        const { done, value: bytes } = await Promise.race([source.next(), shown]); // that may fail before the end
        if (done) break;
        part += bytes.length;
        if (length) this.progress({ what: "loading", part: Math.min(1, part / length) });
        const own = bytes.byteLength === bytes.buffer.byteLength ? bytes : bytes.slice();
        this.worker.postMessage({ bytes: own }, [own.buffer]);
      }
    } catch (error) {
      source.return?.().catch(() => {}); // nobody waits for it: it may be in the middle of something
      this.worker.postMessage({ broken: true });
      this.fail(error);
      throw error;
    }
    this.progress({ what: "loading", part: 1 });
    this.worker.postMessage({ end: true });
    return shown;
  }

  // Read the same bytes once more; `plain`: as splats.
  again(plain) {
    this.worker.postMessage({ again: { plain } });
  }

  // Orders are wanted of this content from now on.
  use(number) {
    this.used = number;
    this.worker.postMessage({ use: number });
  }

  get busy() {
    return this.waiting.size > 0;
  }

  // {order, drawn} for a view of a scene, or null if that is of a content no longer used; give the order back with
  // `reuse` when it has been copied.
  sort(view, { near, tolerance }) {
    // Generous, so that nothing is missing at the edges until the next order comes.
    const sides = sidesOf(view, 1 + tolerance), row = [...view.rows[2], view.translation[2]];
    const ticket = ++this.ticket, order = this.spare;
    this.spare = null;
    this.worker.postMessage({ sort: { ticket, row, sides, near, order } }, order ? [order.buffer] : []);
    return new Promise((resolve) => this.waiting.set(ticket, resolve));
  }

  sorted(answer) {
    this.waiting.get(answer.ticket)(answer.number === this.used ? answer : null);
    this.waiting.delete(answer.ticket);
  }

  reuse(order) {
    this.spare = order;
  }

  dispose() {
    this.worker.terminate();
    this.fail(new Superseded("another file was opened instead"));
    for (const answer of this.waiting.values()) answer(null);
    this.waiting.clear();
  }
}
