// Fetches the files of a folder, those that are needed most first, several at a time. Requests for files that are no
// longer needed are cancelled. After a lost connection, files are requested again until it is back.

import { crc32 } from "../../hyrf/crc.js";
import { groupedDigits } from "../../hyrf/errors.js";

const MAX_REQUESTS = 6; // browsers send no more to a server at the same time by HTTP/1.1
const FIRST_RETRY_MS = 500, MAX_RETRY_MS = 8000;
const STALL_MS = 15000; // a request that brings nothing for this time counts as lost
const MAX_FILE_ATTEMPTS = 4; // if it is refused for now, ends early or comes damaged
const MAX_FILE_BREAKS = 20; // after so many broken connections a file counts as unusable
const MAX_KEPT_PARTIALS = 32; // beginnings of files that are not needed now, but may be needed again
const TEMPORARY_STATUSES = [408, 425, 429, 500, 502, 503, 504];

// A file cannot be used. The message says why, as the end of a sentence.
class UnusableFileError extends Error {}

// A file was not received, and may be if it is requested again.
class RetryError extends Error {}

export class FileQueue {
  // `folder` is the address of the folder. `received(file, bytes)` is called with each file {file, bytes, crc32} whose
  // size and checksum are right, `failed(file, reason)` with each that cannot be used, and `changed()` when the
  // connection is lost or found again. `send` is `fetch`.
  constructor(folder, { received, failed, changed, send = (...request) => fetch(...request) }) {
    Object.assign(this, { folder, received, failed, changed, send });
    this.wanted = []; // files that were not received yet, those needed most first
    this.requests = new Map(); // name of a file -> the AbortController of its request
    this.partials = new Map(); // name -> what was received of a file: {parts, length, attempts, breaks}
    this.unusable = new Set(); // names
    this.lengths = new Map(); // name -> the number of bytes that were received, also of files that were dropped since
    this.losses = 0; // requests in a row without an answer
    this.retry = null; // the timer of the next requests
  }

  // The number of bytes that were received, of each file once.
  get bytes() {
    return [...this.lengths.values()].reduce((sum, length) => sum + length, 0);
  }

  // Whether the server did not answer the last request.
  get isLost() {
    return this.losses > 0;
  }

  // Replaces the list of the files that are fetched, those needed most first.
  want(files) {
    this.wanted = files.filter(({ file }) => !this.unusable.has(file));
    const names = new Set(this.wanted.map(({ file }) => file));
    for (const [name, aborter] of this.requests) {
      if (names.has(name)) continue;
      this.requests.delete(name);
      aborter.abort();
    }
    const oldPartials = [...this.partials.keys()].filter((name) => !names.has(name)); // the oldest ones first
    for (const name of oldPartials.slice(0, -MAX_KEPT_PARTIALS)) this.partials.delete(name);
    this.start();
  }

  // Sends requests. While the connection is lost, one at a time is enough to find it again.
  start() {
    for (const file of this.wanted) {
      if (this.retry !== null || this.requests.size >= (this.isLost ? 1 : MAX_REQUESTS)) return;
      if (!this.requests.has(file.file)) this.request(file);
    }
  }

  // Sends the waiting requests at once, such as when the browser is online again.
  resume() {
    clearTimeout(this.retry);
    this.retry = null;
    this.start();
  }

  // Requests a file.
  async request(file) {
    const { file: name } = file, aborter = new AbortController();
    this.requests.set(name, aborter);
    let bytes = null, failure = null;
    try {
      bytes = await this.download(file, aborter);
    } catch (error) {
      failure = error;
    }
    if (this.requests.get(name) !== aborter) return; // it was cancelled
    this.requests.delete(name);
    if (failure && !(failure instanceof UnusableFileError)) {
      this.pause(failure instanceof RetryError);
      return;
    }
    this.wanted = this.wanted.filter((other) => other.file !== name);
    this.partials.delete(name);
    if (failure) {
      this.unusable.add(name);
      this.failed(file, failure.message);
    } else {
      this.received(file, bytes);
    }
    this.start();
  }

  // Waits before the next requests, longer after each loss of the connection.
  pause(isAnswered) {
    if (!isAnswered) {
      this.losses++;
      this.changed();
    }
    this.retry ??= setTimeout(() => this.resume(), Math.min(MAX_RETRY_MS, FIRST_RETRY_MS * 2 ** this.losses));
  }

  // Returns the bytes of a file. What an earlier request has received is continued by a range request; a server without
  // ranges sends the whole file again.
  async download({ file: name, bytes: size, crc32: checksum }, aborter) {
    const partial = this.partials.get(name) ?? { parts: [], length: 0, attempts: 0, breaks: 0 };
    this.partials.set(name, partial);
    let stallTimer = null;
    const expectMore = () => {
      clearTimeout(stallTimer);
      stallTimer = setTimeout(() => aborter.abort(), STALL_MS);
    };
    expectMore();
    try {
      const answer = await this.send(new URL(name, this.folder).href, {
        signal: aborter.signal, credentials: "same-origin", cache: partial.attempts ? "reload" : "default",
        headers: partial.length ? { Range: `bytes=${partial.length}-` } : {},
      });
      this.answered();
      checkAnswer(answer, partial);
      await readAll(answer.body, (bytes) => {
        expectMore();
        partial.parts.push(bytes);
        partial.length += bytes.length;
        this.lengths.set(name, Math.max(partial.length, this.lengths.get(name) ?? 0));
        if (partial.length > size) refuse(`it is longer than the ${groupedDigits(size)} bytes that the manifest says`);
      });
    } catch (error) {
      aborter.abort(); // the rest of an answer that is refused
      if (partial.isEncoded) forget(partial); // a range would be one of the compressed bytes
      const isCancelled = this.requests.get(name) !== aborter;
      const isBroken = !(isCancelled || error instanceof UnusableFileError || error instanceof RetryError);
      if (isBroken && partial.length && ++partial.breaks > MAX_FILE_BREAKS) {
        refuse("its connection breaks again and again");
      }
      throw error;
    } finally {
      clearTimeout(stallTimer);
    }
    if (partial.length < size) {
      const [there, listed] = [partial.length, size].map(groupedDigits);
      refuseAfterAttempts(partial, `it has ${there} bytes, and the manifest says ${listed}`);
    }
    const data = joinParts(partial);
    if (crc32(data).toString(16).padStart(8, "0") === checksum) return data;
    forget(partial);
    return refuseAfterAttempts(partial, "its bytes are not those that the manifest lists");
  }

  // Records that the server has answered.
  answered() {
    if (!this.isLost) return;
    this.losses = 0;
    this.changed();
  }

  // Cancels all requests.
  close() {
    this.want([]);
    clearTimeout(this.retry);
  }
}

// Throws the error for a file that cannot be used.
const refuse = (reason) => {
  throw new UnusableFileError(reason);
};

// Throws an error for a file that could not be used, the last time for good.
const refuseAfterAttempts = (partial, reason) => {
  if (++partial.attempts >= MAX_FILE_ATTEMPTS) refuse(reason);
  throw new RetryError(reason);
};

// Drops what was received of a file.
const forget = (partial) => Object.assign(partial, { parts: [], length: 0 });

// Throws an error unless an answer has the bytes after those of `partial`, or all bytes. With all bytes, those of
// `partial` are dropped.
function checkAnswer(answer, partial) {
  const range = answer.headers.get("Content-Range"), isRest = answer.status === 206;
  partial.isEncoded = Boolean(answer.headers.get("Content-Encoding"));
  if (TEMPORARY_STATUSES.includes(answer.status)) refuseAfterAttempts(partial, `its server answers ${answer.status}`);
  const isOtherRange = isRest && range && !range.startsWith(`bytes ${partial.length}-`);
  if (answer.status === 416 || isOtherRange) {
    forget(partial);
    refuseAfterAttempts(partial, "its server sends other bytes than those that were asked for");
  }
  if (!answer.ok) refuse([404, 410].includes(answer.status) ? "it is missing" : `its server answers ${answer.status}`);
  if (!isRest) forget(partial);
}

// Calls `receive` with each piece of a stream.
async function readAll(stream, receive) {
  const reader = stream.getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    receive(value);
  }
}

// Returns what was received of a file as one array.
function joinParts({ parts, length }) {
  const data = new Uint8Array(length);
  let at = 0;
  for (const part of parts) {
    data.set(part, at);
    at += part.length;
  }
  return data;
}
