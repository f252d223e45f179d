// Moves the eye by mouse, touch and keys.

import { mul } from "../hyrf/vectors.js";

const MAX_TAP_MOVE_PIXELS = 8;
const MAX_DOUBLE_TAP_DISTANCE_PIXELS = 30; // larger, because two taps of a finger are rarely at the same place
const MAX_TAP_MS = 350;
const ORBIT_RADIANS = 3.6; // the rotation for a drag of two focal lengths
const FLY_AXES = { W: [0, 0, 1], S: [0, 0, -1], A: [-1, 0, 0], D: [1, 0, 0], Q: [0, 1, 0], E: [0, -1, 0] };
const LOOK_SIGNS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }; // yaw, pitch
const ZOOM_SIGNS = { "+": -1, "-": 1 }; // zooming in lowers the depth
const WHEEL_UNITS_PIXELS = [1, 33, 400]; // browsers measure the wheel in pixels, lines or pages
const FLY_SPEED = 0.5; // `pace` of the eye per second
const SHIFT_FACTOR = 4;
const LOOK_RADIANS_PER_SECOND = 1.0;
const ZOOM_EFOLDS_PER_SECOND = 1.2;
const KEY_PRESS_SECONDS = 1 / 60; // a short press moves the eye this long, even if no frame falls into it
const KEY_ALIASES = { "=": "+", _: "-", Add: "+", Subtract: "-" }; // keys with the same function

export class Controls {
  // `keyTarget` is the object whose keys are used: the window, or the canvas while it has the focus. If `isEmbedded`,
  // wheel and fingers scroll the surrounding page until the canvas is clicked. Callbacks: `acted()` after any input;
  // `approach(x, y)` after a double-click, in CSS pixels; `press(key)` for keys that do not move the eye;
  // `ignored(kind)` when a "wheel" or a "finger" is left to the surrounding page.
  constructor(player, damper, { keyTarget, isEmbedded, acted, approach, press, ignored }) {
    const { canvas } = player;
    Object.assign(this, { player, canvas, damper, acted, approach, press, ignored });
    this.pointers = new Map();
    this.held = new Map(); // code of each pressed key -> its name
    this.tapped = null;
    this.pick = null; // if set, it is called with the place of each tap, and a double tap does not approach
    this.engage(!isEmbedded);
    this.aborter = new AbortController();
    const { signal } = this.aborter;
    canvas.addEventListener("pointerdown", (event) => this.down(event), { signal });
    canvas.addEventListener("pointermove", (event) => this.drag(event), { signal });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.lift(event), { signal });
    }
    canvas.addEventListener("lostpointercapture", (event) => this.pointers.delete(event.pointerId), { signal });
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false, signal });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    keyTarget.addEventListener("keydown", (event) => this.key(event), { signal });
    keyTarget.addEventListener("keyup", (event) => this.release(event), { signal });
    const leave = () => {
      this.held.clear();
      this.engage(!isEmbedded);
    };
    for (const target of new Set([window, keyTarget])) target.addEventListener("blur", leave, { signal });
  }

  // Stops to listen to input.
  dispose() {
    this.aborter.abort();
  }

  get eye() {
    return this.player.eye; // null until a scene is loaded
  }

  // Sets whether the canvas uses wheel and fingers, or leaves them to the surrounding page, to
  // scroll and to zoom it.
  engage(engaged) {
    this.engaged = engaged;
    this.canvas.style.touchAction = engaged ? "none" : "manipulation";
  }

  // Returns whether a key that moves the eye, a mouse button or a finger is down.
  get active() {
    return this.pointers.size > 0 || [...this.held.values()].some((key) => key !== "Shift");
  }

  // Moves the eye by all pressed keys, for a time in seconds. Returns whether it moved.
  advance(seconds) {
    const keys = [...this.held.values()];
    return keys.map((key) => this.step(key, seconds, keys.includes("Shift"))).some(Boolean);
  }

  // Moves the eye by one key, for a time in seconds. Returns whether the key moves the eye.
  step(key, seconds, shift) {
    if (FLY_AXES[key]) {
      this.eye.move(...mul(FLY_AXES[key], seconds * (shift ? SHIFT_FACTOR : 1) * FLY_SPEED * this.eye.pace));
    } else if (LOOK_SIGNS[key]) {
      const [yaw, pitch] = LOOK_SIGNS[key].map((direction) => direction * seconds * LOOK_RADIANS_PER_SECOND);
      if (shift) this.eye.orbit(-yaw, -pitch);
      else this.eye.look(yaw, pitch);
    } else if (ZOOM_SIGNS[key]) {
      this.eye.zoom(Math.exp(ZOOM_SIGNS[key] * seconds * ZOOM_EFOLDS_PER_SECOND), 0, 0);
    } else {
      return false;
    }
    return true;
  }

  // Returns the size of a CSS pixel in units of the focal length.
  get pixel() {
    const { clientWidth, clientHeight } = this.canvas;
    return 1 / (this.eye.focal * Math.sqrt(clientWidth * clientHeight));
  }

  // Returns the position of an event on the canvas, in CSS pixels.
  placeOf({ clientX, clientY }) {
    const { left, top } = this.canvas.getBoundingClientRect();
    return [clientX - left, clientY - top];
  }

  // Converts a position in CSS pixels to units of the focal length, measured from the canvas' centre.
  fromMiddle(x, y) {
    const { clientWidth, clientHeight } = this.canvas;
    return [(x - clientWidth / 2) * this.pixel, (y - clientHeight / 2) * this.pixel];
  }

  down(event) {
    if (event.pointerType === "mouse") this.engage(true);
    if (this.engaged) this.canvas.setPointerCapture(event.pointerId);
    const [x, y] = this.placeOf(event), { timeStamp: time } = event;
    this.pointers.set(event.pointerId, { x, y });
    this.start = this.pointers.size === 1 && event.button === 0 ? { x, y, time } : null;
    this.acted();
  }

  drag(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer || !this.engaged || !this.eye) return;
    const before = measureGesture(this.pointers);
    [pointer.x, pointer.y] = this.placeOf(event);
    const after = measureGesture(this.pointers);
    const dx = (after.x - before.x) * this.pixel, dy = (after.y - before.y) * this.pixel;
    this.acted();
    if (this.pointers.size > 1) {
      const place = this.fromMiddle(after.x, after.y);
      if (before.spread > 0 && after.spread > 0) this.damper.zoom(Math.log(before.spread / after.spread), ...place);
      this.damper.pan(dx, dy);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.damper.pan(dx, dy);
    } else {
      this.damper.orbit((-ORBIT_RADIANS * dx) / 2, (-ORBIT_RADIANS * dy) / 2);
    }
  }

  lift(event) {
    if (!this.pointers.delete(event.pointerId)) return; // it was pressed elsewhere
    const [x, y] = this.placeOf(event), { timeStamp: time } = event;
    const near = (to, pixels, ms) => to && Math.hypot(x - to.x, y - to.y) < pixels && time - to.time < ms;
    const maxTapMs = this.pick ? Infinity : MAX_TAP_MS; // a pick may take time to aim
    const tap = event.type === "pointerup" && near(this.start, MAX_TAP_MOVE_PIXELS, maxTapMs);
    this.start = null;
    this.acted();
    const { tapped } = this;
    this.tapped = null;
    if (!tap) {
      if (!this.engaged && event.pointerType !== "mouse") this.ignored("finger");
      return;
    }
    this.engage(true);
    if (this.pick) this.pick(x, y);
    else if (near(tapped, MAX_DOUBLE_TAP_DISTANCE_PIXELS, MAX_TAP_MS)) this.approach(x, y);
    else this.tapped = { x, y, time };
  }

  wheel(event) {
    if (!this.engaged) return this.ignored("wheel");
    const speed = event.ctrlKey ? 0.01 : 0.0012; // browsers report a pinch on a trackpad as Ctrl and small wheel steps
    const delta = event.deltaY || (event.shiftKey ? event.deltaX : 0); // with Shift, browsers scroll to the side
    const step = Math.max(-0.5, Math.min(0.5, delta * WHEEL_UNITS_PIXELS[event.deltaMode] * speed));
    event.preventDefault();
    this.acted();
    if (this.eye) this.damper.zoom(step, ...this.fromMiddle(...this.placeOf(event)));
  }

  release(event) {
    if (event.key === "Meta") this.held.clear(); // macOS sends no keyup events for keys released while Meta is down
    else if (this.held.delete(event.code)) this.acted();
  }

  key(event) {
    const key = keyName(event), moves = FLY_AXES[key] || LOOK_SIGNS[key] || ZOOM_SIGNS[key];
    const inputs = LOOK_SIGNS[key] ? "input" : "input:not([type='range'], [type='checkbox'])";
    // The elements that use the key. A dialog that was closed keeps the focus until the browser draws the next frame.
    const users = "dialog[open]" + (key === "Escape" ? "" : `, select, textarea, ${inputs}`);
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target !== this.canvas && event.target.closest?.(users)) return; // the canvas may lie in a dialog
    if (moves || key === "Shift") {
      this.held.set(event.code, key);
      if (LOOK_SIGNS[key]) event.preventDefault();
      if (!moves) return;
      this.acted();
      if (!this.eye || event.repeat) return;
      this.step(key, KEY_PRESS_SECONDS, event.shiftKey);
      this.player.changed();
    } else if (!event.repeat) {
      this.press(key);
    }
  }
}

// Returns the name of a key. Keys that fly, and letters that are not Latin, are named by their position on a US
// keyboard, so that other layouts work.
function keyName(event) {
  const place = event.code.startsWith("Key") ? event.code.slice(3) : "";
  const typed = event.key.length === 1 ? event.key.toUpperCase() : event.key;
  const name = FLY_AXES[place] || event.key > "~" ? place : typed;
  return KEY_ALIASES[name] ?? name;
}

// Returns the mean position of all pointers and their mean distance from it.
function measureGesture(pointers) {
  const all = [...pointers.values()];
  const mean = (name) => all.reduce((sum, pointer) => sum + pointer[name], 0) / all.length;
  const x = mean("x"), y = mean("y");
  return { x, y, spread: all.reduce((sum, pointer) => sum + Math.hypot(pointer.x - x, pointer.y - y), 0) / all.length };
}
