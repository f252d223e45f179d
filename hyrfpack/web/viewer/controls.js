// Mouse, fingers and keys move the eye.

import { mul } from "./camera.js";

const TAP = { pixels: 8, apart: 30, ms: 350 }; // a finger's second tap lies near the first, not on it
const ORBIT = 3.6; // radians across a window of the focal length's size
const FLY = { W: [0, 0, 1], S: [0, 0, -1], A: [-1, 0, 0], D: [1, 0, 0], Q: [0, 1, 0], E: [0, -1, 0] };
const LOOK = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }; // yaw, pitch
const NEARER = { "+": -1, "-": 1 }; // sign of the change of depth
const SPEED = 0.5, FASTER = 4, LOOK_SPEED = 1.0; // of the way to the scene's middle a second; radians a second
const ZOOM_SPEED = 1.2; // e-folds a second
const TOUCH = 1 / 60; // s that a key moves at once, however short it is pressed and however slow frames are
const TYPED = { "=": "+", _: "-", Add: "+", Subtract: "-" }; // the same keys

export class Controls {
  // `acted` is told of everything that a person does, `pick(x, y)` of a double-click, `press(key)` of the keys that do
  // not move, `ignored(kind)` of a wheel or a finger that is left to the page around.
  constructor(player, damper, { acted, pick, press, ignored }) {
    const { canvas } = player;
    Object.assign(this, { player, canvas, damper, acted, pick, press, ignored });
    this.pointers = new Map();
    this.held = new Map(); // place on the keyboard -> name
    this.tapped = null;
    this.framed = window.parent !== window;
    this.engage(!this.framed); // until then a page around keeps its wheel, and a finger scrolls it
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.lift(event));
    canvas.addEventListener("lostpointercapture", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("keyup", (event) => this.release(event));
    addEventListener("blur", () => {
      this.held.clear();
      this.engage(!this.framed);
    });
  }

  get eye() {
    return this.player.eye; // null while there is no scene
  }

  engage(engaged) {
    this.engaged = engaged;
    this.canvas.classList.toggle("engaged", engaged);
  }

  // Whether a key that moves or a finger is down.
  get active() {
    return this.pointers.size > 0 || [...this.held.values()].some((key) => key !== "Shift");
  }

  // Move for so many seconds as the held keys say.
  advance(seconds) {
    const keys = [...this.held.values()];
    return keys.map((key) => this.step(key, seconds, keys.includes("Shift"))).some(Boolean);
  }

  step(key, seconds, shift) {
    if (FLY[key]) {
      this.eye.move(...mul(FLY[key], seconds * (shift ? FASTER : 1) * SPEED * this.eye.pace));
    } else if (LOOK[key]) {
      const [yaw, pitch] = LOOK[key].map((way) => way * seconds * LOOK_SPEED);
      if (shift) this.eye.orbit(-yaw, -pitch);
      else this.eye.look(yaw, pitch);
    } else if (NEARER[key]) {
      this.eye.zoom(Math.exp(NEARER[key] * seconds * ZOOM_SPEED), 0, 0);
    } else {
      return false;
    }
    return true;
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
    if (event.pointerType === "mouse") this.engage(true);
    if (this.engaged) this.canvas.setPointerCapture(event.pointerId);
    const { clientX: x, clientY: y, timeStamp: time } = event;
    this.pointers.set(event.pointerId, { x, y });
    this.start = this.pointers.size === 1 && event.button === 0 ? { x, y, time } : null;
    this.acted();
  }

  drag(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer || !this.engaged || !this.eye) return;
    const before = gesture(this.pointers);
    [pointer.x, pointer.y] = [event.clientX, event.clientY];
    const after = gesture(this.pointers);
    const dx = (after.x - before.x) * this.pixel, dy = (after.y - before.y) * this.pixel;
    this.acted();
    if (this.pointers.size > 1) {
      const place = this.fromMiddle(after.x, after.y);
      if (before.spread > 0 && after.spread > 0) this.damper.zoom(Math.log(before.spread / after.spread), ...place);
      this.damper.pan(dx, dy);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.damper.pan(dx, dy);
    } else {
      this.damper.orbit((-ORBIT * dx) / 2, (-ORBIT * dy) / 2);
    }
  }

  lift(event) {
    this.pointers.delete(event.pointerId);
    const { clientX: x, clientY: y, timeStamp: time } = event;
    const near = (to, pixels) => to && Math.hypot(x - to.x, y - to.y) < pixels && time - to.time < TAP.ms;
    const tap = event.type === "pointerup" && near(this.start, TAP.pixels);
    if (!tap) {
      this.tapped = null;
      if (!this.engaged) this.ignored("finger");
    } else if (near(this.tapped, TAP.apart)) {
      this.tapped = null;
      this.pick(x, y);
    } else {
      this.engage(true);
      this.tapped = { x, y, time };
    }
    this.start = null;
    this.acted();
  }

  wheel(event) {
    if (!this.engaged) return this.ignored("wheel");
    const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 400 : 1;
    const much = event.ctrlKey ? 0.01 : 0.0012; // a trackpad's pinch comes as Ctrl and a wheel of small steps
    const step = Math.max(-0.5, Math.min(0.5, event.deltaY * lines * much));
    event.preventDefault();
    this.acted();
    if (this.eye) this.damper.zoom(step, ...this.fromMiddle(event.clientX, event.clientY));
  }

  release(event) {
    if (event.key === "Meta") this.held.clear(); // macOS tells of no letter that was let go meanwhile
    else if (this.held.delete(event.code)) this.acted();
  }

  key(event) {
    const key = keyName(event), moves = FLY[key] || LOOK[key] || NEARER[key];
    const typing = "select, dialog, input:not([type='range'], [type='checkbox'])";
    const theirs = event.target.closest?.(LOOK[key] ? "input, select, dialog" : typing); // not ours
    if (event.ctrlKey || event.metaKey || event.altKey || (theirs && key !== "Escape")) return;
    if (moves || key === "Shift") {
      this.held.set(event.code, key);
      if (LOOK[key]) event.preventDefault();
      if (moves) this.acted();
      if (moves && this.eye && !event.repeat) this.step(key, TOUCH, event.shiftKey);
    } else if (!event.repeat) {
      this.press(key);
    }
  }
}

// Letters by their place on the keyboard where they fly, or are not Latin, so that other layouts work as well.
function keyName(event) {
  const place = event.code.startsWith("Key") ? event.code.slice(3) : "";
  const name = FLY[place] || event.key > "~" ? place : event.key.length === 1 ? event.key.toUpperCase() : event.key;
  return TYPED[name] ?? name;
}

// The middle of all pointers and how far they are from it.
function gesture(pointers) {
  const all = [...pointers.values()];
  const mean = (name) => all.reduce((sum, pointer) => sum + pointer[name], 0) / all.length;
  const x = mean("x"), y = mean("y");
  return { x, y, spread: all.reduce((sum, pointer) => sum + Math.hypot(pointer.x - x, pointer.y - y), 0) / all.length };
}
