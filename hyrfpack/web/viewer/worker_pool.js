// Shares workers (see worker_tasks.js) between all players of a page.

import { readText } from "./texts.js";

const MAX_WORKERS = 4; // each takes a thread and some memory; players share them beyond that

const pool = []; // {worker, address, connections: Map of number -> Connection}
let lastNumber = 0;
let policy = null;

// Exchanges messages with one reader of a worker.
export class Connection {
  // Starts a worker, or shares one. `address` is that of the worker's script, or null for the embedded script.
  // `receive(message)` is called with each message of the reader. `fail(message)` is called when the worker has failed,
  // with "" if its script was not allowed to run; the connection is closed then. Throws an Error if the browser refuses
  // to start a worker.
  constructor(address, receive, fail) {
    Object.assign(this, { receive, fail });
    this.number = ++lastNumber;
    this.shared = chooseWorker(address);
    this.shared.connections.set(this.number, this);
  }

  // Sends a message to the reader, with buffers that are transferred.
  post(message, transfers = []) {
    this.shared?.worker.postMessage({ reader: this.number, ...message }, transfers);
  }

  // Frees what the worker keeps for the reader. A worker without readers is ended, with all its work.
  close() {
    if (!this.shared) return;
    const { worker, connections } = this.shared;
    connections.delete(this.number);
    if (connections.size) {
      this.post({ close: true });
    } else {
      worker.terminate();
      pool.splice(pool.indexOf(this.shared), 1);
    }
    this.shared = null;
  }
}

// Returns a new worker while there are fewer than MAX_WORKERS, and then the one with the fewest readers.
function chooseWorker(address) {
  const same = pool.filter((shared) => shared.address === address);
  if (same.length < Math.min(MAX_WORKERS, navigator.hardwareConcurrency || MAX_WORKERS)) return startWorker(address);
  return same.reduce((best, shared) => (shared.connections.size < best.connections.size ? shared : best));
}

// Starts a worker, and adds it to the pool.
function startWorker(address) {
  const shared = { worker: createWorker(address), address, connections: new Map() };
  shared.worker.onmessage = ({ data: { reader, ...message } }) => shared.connections.get(reader)?.receive(message);
  shared.worker.onerror = ({ message }) => {
    for (const connection of [...shared.connections.values()]) {
      connection.close();
      connection.fail(message ?? "");
    }
  };
  pool.push(shared);
  return shared;
}

// Lets a script start where a Content-Security-Policy requires Trusted Types and allows the policy "hyrf-viewer".
function trust(address) {
  try {
    policy ??= trustedTypes.createPolicy("hyrf-viewer", { createScriptURL: (script) => script });
    return policy.createScriptURL(address);
  } catch {
    return address; // this browser has no Trusted Types, or the policy is not allowed
  }
}

// Creates a worker from the script at an address, or from the embedded one if it is null.
function createWorker(address) {
  if (address) return new Worker(trust(address));
  const embedded = URL.createObjectURL(new Blob([readText("worker.js")], { type: "text/javascript" }));
  try {
    return createWorker(embedded);
  } finally {
    URL.revokeObjectURL(embedded);
  }
}
