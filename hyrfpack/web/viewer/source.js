// Reads a scene's bytes from an address, a file or memory, as {name, stream, address}; the stream is an async iterable
// of Uint8Array, whose `length` is the number of bytes, or 0 if that is unknown. Only fetched files have an address.
// Their streams have a method `cancel`, which ends the download at once, also while it waits for bytes.

const FROM_DISK_TEXT = "a page opened from the disk may not read files; serve both, or use a page of one file";
// A sandbox without allow-same-origin makes every server, even the page's own, another site.
const OPAQUE_FRAME_TEXT = "the sandbox of this page's frame forbids it; add allow-same-origin, or let the file's " +
  "server send Access-Control-Allow-Origin: *";

const UNNAMED_FILE = "the scene";

// Returns a source for `openSource` that can be opened again later, with a copy of bytes, or null for a stream.
export function keepSource(source) {
  if (source instanceof ArrayBuffer) return new Blob([source]);
  if (ArrayBuffer.isView(source)) return new Blob([copyBytes(source)]); // a Blob takes no shared memory
  return source instanceof ReadableStream ? null : source;
}

// Opens an address (string or URL), a Blob or a File, or a ReadableStream of bytes; `keepSource` makes a Blob of bytes.
// `name` replaces the file's. `aborter` ends the load. Throws an Error with a message for the user on failure.
export async function openSource(source, name, aborter) {
  const file = await openUnnamed(source, aborter);
  return { ...file, name: name ?? file.name };
}

// Opens a source under its own name.
async function openUnnamed(source, aborter) {
  if (typeof source === "string" || source instanceof URL) return fetchedFile(absoluteAddress(source), aborter);
  if (source instanceof Blob) return chosenFile(source);
  if (source instanceof ReadableStream) return streamedFile(source, aborter);
  throw new Error("A scene is an address, a Blob, an ArrayBuffer, a Uint8Array or a ReadableStream.");
}

// Returns an address in full. Throws an Error with a message for the user if it is none.
function absoluteAddress(source) {
  try {
    return new URL(source, document.baseURI).href;
  } catch {
    throw new Error(`${source} is no address of a file.`);
  }
}

// Returns the file that a ReadableStream of the caller yields, who may use the same arrays elsewhere.
function streamedFile(source, aborter) {
  if (source.locked) throw new Error("The stream is locked, because something else reads it.");
  const reader = source.getReader(), cancel = () => aborter.abort();
  aborter.signal.onabort = () => reader.cancel().catch(() => {});
  return { name: UNNAMED_FILE, stream: Object.assign(copyPieces(reader), { length: 0, cancel }) };
}

// Yields copies, because the bytes are transferred to the worker.
async function* copyPieces(reader) {
  for await (const value of pieces(reader)) {
    if (!ArrayBuffer.isView(value)) throw new Error("the stream must yield Uint8Arrays.");
    yield copyBytes(value);
  }
}

// Returns a copy of the bytes of any typed array.
const copyBytes = ({ buffer, byteOffset, byteLength }) => new Uint8Array(buffer, byteOffset, byteLength).slice();

// Fetches a file. Throws an Error with a message for the user on failure.
export async function fetchedFile(address, aborter = new AbortController()) {
  const name = nameOfAddress(address), answer = await request(address, name, aborter);
  if (!answer.ok) {
    const status = [answer.status, answer.statusText].filter(Boolean).join(" ");
    aborter.abort();
    throw new Error(`${name} could not be fetched (${status}); check the address ${address}`);
  }
  // For a compressed transfer, Content-Length is not the length of the file.
  const length = answer.headers.get("Content-Encoding") ? 0 : Number(answer.headers.get("Content-Length")) || 0;
  const cancel = () => aborter.abort();
  const stream = Object.assign(downloaded(address, name, answer, length, aborter), { length, cancel });
  return { name, stream, address: answer.url || address };
}

// Returns a file that the user chose.
export function chosenFile(file) {
  const stream = Object.assign(pieces(file.stream().getReader()), { length: file.size });
  return { name: file.name ?? UNNAMED_FILE, stream };
}

// Decodes a name in an address. One whose percent signs are invalid stays as it is.
export const decodeName = (name) => {
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
};

// Returns the file name in an address.
const nameOfAddress = (address) => decodeName(new URL(address).pathname.split("/").pop()) || "the file";

// Returns why a request got no answer.
function noAnswerReason({ origin, host }) {
  if (location.protocol === "file:") return FROM_DISK_TEXT;
  if (window.origin === "null") return OPAQUE_FRAME_TEXT;
  if (origin === location.origin) return "its server does not answer, or a Content-Security-Policy forbids the request";
  return `${host} does not answer, or does not let pages of other sites read it`;
}

// Sends a request. Throws an Error with a message for the user if the server does not answer.
async function request(address, name, { signal }, headers = {}) {
  try {
    return await fetch(address, { headers, credentials: "same-origin", signal });
  } catch {
    throw new Error(`${name} could not be fetched: ${noAnswerReason(new URL(address))}.`);
  }
}

// Yields the bytes of an answer. After a broken connection, the rest is requested once, by a range request.
async function* downloaded(address, name, answer, length, aborter) {
  const isSameOrigin = new URL(address).origin === location.origin, tag = answer.headers.get("ETag");
  let received = 0;
  for (let isResumed = false; ; isResumed = true) {
    try {
      for await (const bytes of pieces(answer.body.getReader())) {
        received += bytes.length;
        yield bytes;
      }
      // Other servers do not reveal that a transfer is compressed, so its length may not be that of the file.
      if (received >= length || !isSameOrigin) return;
      throw new Error(); // as for a connection that the browser calls broken
    } catch {
      const size = received.toLocaleString("en");
      const brokenError = new Error(`the connection broke after ${size} bytes; reload the page to try again`);
      if (isResumed || !received || aborter.signal.aborted) throw brokenError;
      // If-Range is sent only to the page's own server, because other servers would have to allow it.
      const condition = isSameOrigin && tag && !tag.startsWith("W/") ? { "If-Range": tag } : {};
      const headers = { Range: `bytes=${received}-`, ...condition };
      answer = await request(address, name, aborter, headers);
      const first = answer.headers.get("Content-Range");
      if (answer.status !== 206 || (first && !first.startsWith(`bytes ${received}-`))) {
        aborter.abort();
        throw brokenError;
      }
    }
  }
}

// Iterates over a ReadableStream by its reader, because not every browser supports `for await` with streams.
async function* pieces(reader) {
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      yield value;
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}
