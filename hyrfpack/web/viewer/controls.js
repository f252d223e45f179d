// Mouse, fingers and keys move the eye.

const TAP = { pixels: 8, apart: 30, ms: 350 }; // a finger's second tap lies near the first, not on it
const ORBIT = 3.6; // radians across a window of the focal length's size
const FLY = { W: [0, 0, 1], S: [0, 0, -1], A: [-1, 0, 0], D: [1, 0, 0], Q: [0, 1, 0], E: [0, -1, 0] };
const LOOK = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }; // yaw, pitch
const SPEED = 0.5, FASTER = 4, LOOK_SPEED = 1.0; // of the way to the scene's middle a second; radians a second

class Controls {
  // `changed` is told of every move, `pick(x, y)` of a double-click, `press(key)` of the keys that do not move.
  constructor(canvas, eye, { changed, pick, press }) {
    Object.assign(this, { canvas, eye, changed, pick, press });
    this.pointers = new Map();
    this.held = new Set();
    this.tapped = null;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.lift(event));
    canvas.addEventListener("lostpointercapture", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("keyup", (event) => this.release(event));
    addEventListener("blur", () => this.held.clear());
  }

  // Whether a key or a finger is down.
  get active() {
    return this.held.size > 0 || this.pointers.size > 0;
  }

  // Fly for so many seconds as the held keys say.
  advance(seconds) {
    const pace = seconds * (this.held.has("Shift") ? FASTER : 1);
    let moved = false;
    for (const key of this.held) {
      if (FLY[key]) this.eye.move(...mul(FLY[key], pace * SPEED * this.eye.pace));
      if (LOOK[key]) this.eye.look(...LOOK[key].map((way) => way * pace * LOOK_SPEED));
      moved ||= Boolean(FLY[key] || LOOK[key]);
    }
    return moved;
  }

  // Pixels of the page to units of the focal length.
  get pixel() {
    const { clientWidth, clientHeight } = this.canvas;
    return 1 / (this.eye.focal * Math.sqrt(clientWidth * clientHeight));
  }

  fromMiddle(x, y) {
    const { clientWidth, clientHeight } = this.canvas;
    return [(x - clientWidth / 2) * this.pixel, (y - clientHeight / 2) * this.pixel];
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const { clientX: x, clientY: y, timeStamp: time } = event;
    this.pointers.set(event.pointerId, { x, y });
    this.start = this.pointers.size === 1 && event.button === 0 ? { x, y, time } : null;
  }

  drag(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    const before = gesture(this.pointers);
    [pointer.x, pointer.y] = [event.clientX, event.clientY];
    const after = gesture(this.pointers);
    const dx = (after.x - before.x) * this.pixel, dy = (after.y - before.y) * this.pixel;
    if (this.pointers.size > 1) {
      if (before.spread > 0 && after.spread > 0) this.eye.zoom(before.spread / after.spread, ...this.fromMiddle(after.x, after.y));
      this.eye.pan(dx, dy);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.eye.pan(dx, dy);
    } else {
      this.eye.orbit((-ORBIT * dx) / 2, (-ORBIT * dy) / 2);
    }
    this.changed();
  }

  lift(event) {
    this.pointers.delete(event.pointerId);
    const { clientX: x, clientY: y, timeStamp: time } = event;
    const near = (to, pixels) => to && Math.hypot(x - to.x, y - to.y) < pixels && time - to.time < TAP.ms;
    if (event.type !== "pointerup" || !near(this.start, TAP.pixels)) {
      this.tapped = null;
    } else if (near(this.tapped, TAP.apart)) {
      this.tapped = null;
      this.pick(x, y);
    } else {
      this.tapped = { x, y, time };
    }
    this.start = null;
    this.changed();
  }

  wheel(event) {
    const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 400 : 1;
    const much = event.ctrlKey ? 0.01 : 0.0012; // a trackpad's pinch comes as Ctrl and a wheel of small steps
    const step = Math.max(-0.5, Math.min(0.5, event.deltaY * lines * much));
    this.eye.zoom(Math.exp(step), ...this.fromMiddle(event.clientX, event.clientY));
    event.preventDefault();
    this.changed();
  }

  release(event) {
    if (event.key === "Meta") this.held.clear(); // macOS tells of no letter that was let go meanwhile
    else this.held.delete(nameOf(event));
  }

  key(event) {
    const key = nameOf(event);
    const theirs = event.target.closest?.(LOOK[key] ? "input, select, dialog" : "select, dialog"); // not ours
    if (event.ctrlKey || event.metaKey || event.altKey || theirs) return;
    if (FLY[key] || LOOK[key] || key === "Shift") {
      this.held.add(key);
      if (LOOK[key]) event.preventDefault();
      this.changed();
    } else if (!event.repeat) {
      this.press(key);
    }
  }
}

// Letters by their place on the keyboard where they fly, or are not Latin, so that other layouts work as well.
function nameOf(event) {
  const place = event.code.startsWith("Key") ? event.code.slice(3) : "";
  return FLY[place] || event.key > "~" ? place : event.key.length === 1 ? event.key.toUpperCase() : event.key;
}

// The middle of all pointers and how far they are from it.
function gesture(pointers) {
  const all = [...pointers.values()];
  const mean = (name) => all.reduce((sum, pointer) => sum + pointer[name], 0) / all.length;
  const x = mean("x"), y = mean("y");
  return { x, y, spread: all.reduce((sum, pointer) => sum + Math.hypot(pointer.x - x, pointer.y - y), 0) / all.length };
}
