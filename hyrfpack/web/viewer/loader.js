// Connects the page with the worker that reads files and sorts splats.

import { frustumPlanes } from "../hyrf/frustum.js";
import { Connection } from "./worker_pool.js";

// The file is no longer needed, because another one was opened.
export class SupersededError extends Error {}

// The browser cannot read any file. The message is for the user.
export class StartError extends Error {}

const FORBIDDEN_TEXT = "A Content-Security-Policy forbids the player's worker; it must allow ";

export class Loader {
  // `content(message)` is called with each content that was read (see worker_tasks.js), one after the other. Its
  // promise resolves to true if the content is shown. `progress({what, part})` is called with the fraction `part` of
  // the step `what`.
  // `failed(error, isReported)` is called when the worker has failed; `isReported` if a promise is rejected as well.
  // `workerAddress` is that of the worker's script, or null for the embedded one.
  constructor({ content, progress, failed, workerAddress = null }) {
    if (!window.DecompressionStream) {
      throw new StartError("This browser is too old to unpack the scene; use a newer one.");
    }
    Object.assign(this, { content, progress, failed });
    this.failure = null; // the error of the worker
    this.ticket = 0;
    this.waiting = new Map(); // ticket -> the function that resolves the promise of its order
    this.asked = new Map(); // ticket -> {resolve, reject} of the promise of its answer
    this.spare = null; // the array of an old order, for reuse
    const refusal = workerAddress
      ? `The player's worker ${workerAddress} cannot be started; it must be a script on the page's site.`
      : `${FORBIDDEN_TEXT}worker-src blob:.`;
    const receive = (message) => this.receive(message);
    // An error without a message means that the worker's script was not allowed to run.
    const fail = (message) => this.breakDown(message ? failureOf(message) : new StartError(refusal));
    try {
      this.connection = new Connection(workerAddress, receive, fail);
    } catch (error) {
      throw new StartError(error instanceof TypeError ? `${FORBIDDEN_TEXT}trusted-types hyrf-viewer.` : refusal);
    }
    this.delivered = Promise.resolve();
    this.broken = false; // true if no more of the file will arrive; the part that was shown can be decoded again
    this.pending = []; // {resolve, reject} of the promises of `expect`
    this.repeats = 0; // of `again`
  }

  // Handles a message of the worker.
  receive(message) {
    if (message.progress) this.progress(message.progress);
    if (message.content) this.deliver(message.content);
    if (message.order) this.sorted(message.order);
    if (message.answer) this.answered(message.answer);
    if (message.error) this.fail(new Error(message.error));
    if (message.failure) this.breakDown(failureOf(message.failure));
  }

  // Returns an object that evaluates and draws the models of a content, or null for the player's own.
  makeContent() {
    return null;
  }

  // Calls `content` after the call for the previous content has ended.
  deliver(content) {
    this.delivered = this.delivered.then(() => this.content(content)).then(
      (shown) => {
        if (shown && (content.whole || this.broken)) this.pending.splice(0).forEach(({ resolve }) => resolve());
      },
      (error) => this.fail(error),
    );
  }

  // Returns a promise that resolves when all available content is shown.
  expect() {
    if (this.failure) return Promise.reject(this.failure);
    return new Promise((resolve, reject) => this.pending.push({ resolve, reject }));
  }

  // Rejects the promises of `expect`.
  fail(error) {
    this.broken = true;
    this.pending.splice(0).forEach(({ reject }) => reject(error));
  }

  // Handles a failure of the worker: it sorts nothing and answers nothing any more.
  breakDown(error) {
    const isReported = this.pending.length + this.asked.size > 0;
    this.failure = error;
    this.connection.close(); // nothing waits for what the worker still sends
    this.end(error);
    this.failed(error, isReported);
  }

  // Ends what waits for the worker. Rejects the promises of `ask` by `askError`.
  end(error, askError = error) {
    this.fail(error);
    for (const answer of this.waiting.values()) answer(null);
    this.waiting.clear();
    for (const { reject } of this.asked.values()) reject(askError);
    this.asked.clear();
  }

  // Reads a file from an async iterable of its bytes, which are transferred to the worker. `length` is in bytes, and 0
  // if it is unknown.
  async read({ name, scene, views, plain = false, stream, length = stream.length }) {
    const shown = this.expect(), source = stream[Symbol.asyncIterator]();
    this.connection.post({ start: { name, scene, views, plain } });
    try {
      for (let part = 0;;) {
        const { done, value: bytes } = await Promise.race([source.next(), shown]); // `shown` may fail before the end
        if (done) break;
        part += bytes.length;
        if (length) this.progress({ what: "loading", part: Math.min(1, part / length) });
        const own = bytes.byteLength === bytes.buffer.byteLength ? bytes : bytes.slice();
        this.connection.post({ bytes: own }, [own.buffer]);
      }
    } catch (error) {
      source.return?.().catch(() => {}); // not awaited, because its next bytes may never come
      this.connection.post({ broken: true });
      this.fail(error);
      throw error;
    }
    this.progress({ what: "loading", part: 1 });
    this.connection.post({ end: true });
    return shown;
  }

  // Decodes the same bytes again, as splats if `plain`.
  again(plain) {
    this.repeats++;
    this.connection.post({ again: { plain } });
  }

  // Returns whether no other content will replace this one because of `again`.
  isLatest({ repeats = 0 }) {
    return repeats === this.repeats;
  }

  // Selects the content that later calls of `sort` sort.
  use(number) {
    this.current = number;
    this.connection.post({ use: number });
  }

  // Returns whether an order is being made.
  get busy() {
    return this.waiting.size > 0;
  }

  // Sorts the splats for a view of a scene. Returns a promise of {order, drawn}, or of null if another content has been
  // selected meanwhile or the worker has failed. The caller passes the order to `reuse` after copying it.
  sort(view, { near, sortNear = near, tolerance }) {
    // The frustum is enlarged, so that no splats are missing at the edges until the next order arrives.
    const sides = frustumPlanes(view, 1 + tolerance), row = [...view.rows[2], view.translation[2]];
    const ticket = ++this.ticket, order = this.spare;
    this.spare = null;
    this.connection.post({ sort: { ticket, row, sides, near: sortNear, order } }, order ? [order.buffer] : []);
    return this.failure ? null : new Promise((resolve) => this.waiting.set(ticket, resolve));
  }

  // Passes an order to the `sort` that asked for it.
  sorted(answer) {
    this.waiting.get(answer.ticket)(answer.number === this.current ? answer : null);
    this.waiting.delete(answer.ticket);
  }

  // Asks the worker a question (see worker_tasks.js). Returns a promise of the answer.
  ask(question) {
    if (this.failure) return Promise.reject(this.failure);
    const ticket = ++this.ticket;
    this.connection.post({ ask: { ticket, ...question } });
    return new Promise((resolve, reject) => this.asked.set(ticket, { resolve, reject }));
  }

  // Settles the promise of the `ask` to which the worker has answered.
  answered({ ticket, value, error }) {
    const { resolve, reject } = this.asked.get(ticket);
    this.asked.delete(ticket);
    if (error) reject(new Error(error));
    else resolve(value);
  }

  // Keeps the array of an order for the next call of `sort`.
  reuse(order) {
    this.spare = order;
  }

  // Ends the work on the file.
  dispose() {
    this.connection.close();
    this.end(new SupersededError("another file was opened instead"), new SupersededError());
  }
}

// Returns the error for a worker that has failed.
const failureOf = (reason) => new Error(`The player's worker has failed (${reason}); load the page again.`);
