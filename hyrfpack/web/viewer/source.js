// Where a scene's bytes come from: an address, or a file of the person's own. Each is {name, stream}: the stream is an
// async iterable of Uint8Array, which knows its `length` where that is known.

// Throws an Error with a sentence where it cannot be had.
export async function fetchedFile(address) {
  const name = nameOfAddress(address), answer = await ask(address, name);
  if (!answer.ok) {
    const status = [answer.status, answer.statusText].filter(Boolean).join(" ");
    await answer.body?.cancel();
    throw new Error(`${name} could not be fetched (${status}); check the address ${address}`);
  }
  // What is sent packed has another length than what is read.
  const length = answer.headers.get("Content-Encoding") ? 0 : Number(answer.headers.get("Content-Length")) || 0;
  return { name, stream: Object.assign(downloaded(address, name, answer, length), { length }) };
}

export function chosenFile(file) {
  return { name: file.name, stream: Object.assign(pieces(file.stream()), { length: file.size }) };
}

const nameOfAddress = (address) => {
  const last = new URL(address).pathname.split("/").pop();
  try {
    return decodeURIComponent(last) || "the file";
  } catch {
    return last;
  }
};

async function ask(address, name, headers = {}) {
  try {
    return await fetch(address, { headers, credentials: "same-origin" });
  } catch {
    const why = location.protocol === "file:"
      ? "a page opened from the disk may not read files; drop the file on the page, or serve both"
      : new URL(address).origin === location.origin
        ? "its server does not answer"
        : `${new URL(address).host} does not answer, or does not let pages of other sites read it`;
    throw new Error(`${name} could not be fetched: ${why}.`);
  }
}

// A connection that breaks is taken up again once, where it broke.
async function* downloaded(address, name, answer, length) {
  const own = new URL(address).origin === location.origin, tag = answer.headers.get("ETag");
  let done = 0;
  for (let again = false; ; again = true) {
    try {
      for await (const bytes of pieces(answer.body)) {
        done += bytes.length;
        yield bytes;
      }
      if (done >= length) return;
      throw new Error("it ends early");
    } catch (error) {
      const broke = new Error(`the connection broke after ${done.toLocaleString("en")} bytes; reload the page to try again`);
      if (again || !done) throw broke;
      // Other sites' servers would have to allow If-Range.
      const headers = { Range: `bytes=${done}-`, ...(own && tag && !tag.startsWith("W/") ? { "If-Range": tag } : {}) };
      answer = await ask(address, name, headers);
      const first = answer.headers.get("Content-Range");
      if (answer.status !== 206 || (first && !first.startsWith(`bytes ${done}-`))) throw broke;
    }
  }
}

// Not every browser can iterate over a ReadableStream itself.
async function* pieces(stream) {
  const reader = stream.getReader();
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
