// The worker that unpacks and sorts, seen from the page.

const READ_EVERY = 20; // ms, while the page itself is still coming in

class Splats {
  constructor(scene) {
    if (!window.DecompressionStream) throw new Error("This browser is too old to unpack the scene; take a newer one.");
    this.scene = scene;
    this.ticket = 0;
    this.waiting = new Map(); // ticket -> what to do with the order
    this.spare = null; // an order's array to be used again
    const code = new Blob([textOf("worker.js")], { type: "text/javascript" });
    this.worker = new Worker(URL.createObjectURL(code));
  }

  // What is in the page, unpacked. `progress` is told the part done, 0 to 1.
  async unpack(progress) {
    const { count, degree } = this.scene;
    const unpacked = new Promise((resolve, reject) => {
      this.worker.onerror = ({ message }) => reject(damaged(message));
      this.worker.onmessage = ({ data }) => {
        if (data.done) progress(data.done);
        if (data.error) reject(damaged(data.error));
        if (data.splats) resolve(data.splats);
        if (data.order) this.sorted(data.order);
      };
    });
    this.worker.postMessage({ start: { count, degree, width: TEXTURE_WIDTH } });
    try {
      for await (const bytes of payload()) this.worker.postMessage({ bytes }, [bytes.buffer]);
    } catch ({ message }) {
      throw damaged(message);
    }
    this.worker.postMessage({ end: true });
    return unpacked;
  }

  get busy() {
    return this.waiting.size > 0;
  }

  // {order, drawn} for a view; give the order back with `reuse` when it has been copied.
  sort(view) {
    const { rows, translation, fx, fy, cx, cy, width, height } = view;
    // Generous, so that nothing is missing at the edges until the next order comes.
    const wide = 1 + this.scene.tolerance;
    const side = (axis, sign, focal, reach) => [
      ...add(mul(rows[axis], sign * focal), mul(rows[2], reach)), sign * focal * translation[axis] + reach * translation[2],
    ];
    const sides = [
      side(0, 1, fx, cx + (wide * width) / 2), side(0, -1, fx, width - cx + (wide * width) / 2),
      side(1, 1, fy, cy + (wide * height) / 2), side(1, -1, fy, height - cy + (wide * height) / 2),
    ].flat();
    const ticket = ++this.ticket, order = this.spare;
    this.spare = null;
    const row = [...rows[2], translation[2]];
    this.worker.postMessage({ sort: { ticket, row, sides, near: this.scene.near, order } }, order ? [order.buffer] : []);
    return new Promise((resolve) => this.waiting.set(ticket, resolve));
  }

  sorted(answer) {
    this.waiting.get(answer.ticket)(answer);
    this.waiting.delete(answer.ticket);
  }

  reuse(order) {
    this.spare = order;
  }
}

const damaged = (why) => new Error(`The scene cannot be unpacked; if this page is not whole, fetch it again (${why}).`);

// The bytes in the page's blocks of base64, as they come in. Each block is dropped once it is read.
async function* payload() {
  for (;;) {
    const [block, next] = document.querySelectorAll("script.splats");
    const whole = document.readyState !== "loading";
    if (block && (next || whole)) {
      yield bytesOf(block.textContent);
      block.remove();
    } else if (whole) {
      return;
    }
    await new Promise((resolve) => setTimeout(resolve, next || whole ? 0 : READ_EVERY));
  }
}

function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes;
}
