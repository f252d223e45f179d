// The crop box: its edges, and handles that pointers, fingers and keys move: one on each face, one that moves the whole
// box, and one that turns it about the up direction.

import { element } from "../dom.js";
import { add, cross, dot, mul, sub } from "../../hyrf/vectors.js";

// An arrow key moves a side by this ratio of the scene's size, or turns the box by this angle; with Shift, ten times.
const KEY_STEP_RATIO = 0.01;
const KEY_STEP_DEGREES = 1;
const SHIFT_FACTOR = 10;
const MIN_HANDLE_MARGIN_PIXELS = 24; // handles that are nearer to the window's edge or the panel are hard to reach
// The handle that turns the box stands outside of an edge, by this ratio of the edge's distance from the box's centre.
const TURN_HANDLE_RATIO = 0.3;
const BOX_FACES = [0, 1, 2].flatMap((axis) => [{ axis, side: 0 }, { axis, side: 1 }]);
const KEY_SIGNS = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 };
// The axis of the picture along which a key moves the box, and its sign.
const KEY_MOVES = {
  ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowDown: [1, 1], ArrowUp: [1, -1], PageUp: [2, 1], PageDown: [2, -1],
};

export class CropBox {
  // `getBox()` returns the box or null, see CropTool.describe. `change` is CropTool.put: `change({ value }, false)` is
  // called with new numbers, and `change({})` when they are final.
  constructor(player, getBox, change) {
    Object.assign(this, { player, getBox, change });
    this.arm = 3; // of those that turnArms returns
    this.handles = BOX_FACES.map(({ axis, side }) => {
      const letter = "xyz"[axis], label = `${side ? "maximum" : "minimum"} ${letter} of the box`;
      const grab = (event) => this.grabFace(event, axis, side), step = (event) => this.stepFace(event, axis, side);
      return this.createHandle(letter, label, grab, step);
    });
    this.mover = this.createHandle("move", "Move the box", this.grabMiddle, this.stepMove, ", Page Up and Page Down");
    this.turner = this.createHandle("turn", "Turn of the box in degrees", this.grabTurn, this.stepTurn);
    // Sliders would need limits.
    for (const handle of [...this.handles, this.turner]) handle.setAttribute("role", "spinbutton");
    element("edit-handles").replaceChildren(...this.handles, this.mover, this.turner);
  }

  // Makes a handle. The method `grab(event)` returns a function of later events that returns the numbers of the box, or
  // null; so does `step(event)` for a key, which it does not know if it returns null. `moreKeys` are for its tooltip.
  createHandle(name, label, grab, step, moreKeys = "") {
    const handle = document.createElement("button");
    handle.className = name;
    handle.setAttribute("aria-label", label);
    handle.title = `${label}: drag it, or use arrow keys${moreKeys}`;
    handle.onpointerdown = (event) => this.press(event, handle, grab);
    handle.onkeydown = (event) => {
      const value = step.call(this, event);
      if (!value) return;
      event.preventDefault();
      event.stopPropagation(); // arrow keys also turn the eye
      this.change({ value }, false);
    };
    handle.onkeyup = () => this.change({});
    return handle;
  }

  // Drags a handle until the pointer is released. Only the first of several fingers drags.
  press(event, handle, grab) {
    if (event.button || !event.isPrimary) return;
    event.preventDefault();
    handle.focus();
    handle.setPointerCapture(event.pointerId);
    const follow = grab.call(this, event);
    handle.onpointermove = (moved) => {
      const value = moved.isPrimary && follow(moved);
      if (value) this.change({ value }, false);
    };
    handle.onlostpointercapture = (lost) => { // after the release, or after the browser has cancelled the touch
      if (!lost.isPrimary) return;
      handle.onpointermove = null;
      this.change({});
    };
  }

  // ---- a face, along its axis

  grabFace(event, axis, side) {
    const box = this.getBox(), middle = faceMiddle(box, axis, side);
    const along = (pointer) => this.projection.along(middle, box.axes[axis], placeOf(pointer));
    const start = along(event);
    return (moved) => {
      const now = along(moved);
      if (start === null || now === null) return null;
      return withSide(box, axis, side, box.value[axis + 3 * side] + (now - start) / box.unit);
    };
  }

  stepFace(event, axis, side) {
    const sign = KEY_SIGNS[event.key], box = this.getBox();
    return sign ? withSide(box, axis, side, box.value[axis + 3 * side] + sign * stepLength(event, box)) : null;
  }

  // ---- the whole box, in the plane of the picture

  grabMiddle(event) {
    const box = this.getBox(), normal = this.projection.view.rows[2];
    const onPlane = (pointer) => this.projection.onPlane(box.middle, normal, placeOf(pointer));
    const start = onPlane(event);
    return (moved) => {
      const now = onPlane(moved);
      return start && now && withMove(box.value, box.toWorld(sub(now, start)));
    };
  }

  stepMove(event) {
    const [axis, sign] = KEY_MOVES[event.key] ?? [], box = this.getBox();
    if (!sign) return null;
    const along = mul(this.projection.view.rows[axis], sign * box.unit * stepLength(event, box));
    return withMove(box.value, box.toWorld(along));
  }

  // ---- its turn about the up direction

  grabTurn(event) {
    const box = this.getBox(), { middle, up } = box;
    const arm = (pointer) => {
      const point = this.projection.onPlane(middle, up, placeOf(pointer));
      return point && sub(point, middle);
    };
    const start = arm(event);
    return (moved) => {
      const now = arm(moved);
      if (!start || !now) return null;
      return withTurn(box.value, (180 / Math.PI) * Math.atan2(dot(up, cross(start, now)), dot(start, now)));
    };
  }

  stepTurn(event) {
    const sign = KEY_SIGNS[event.key];
    return sign ? withTurn(this.getBox().value, sign * KEY_STEP_DEGREES * (event.shiftKey ? SHIFT_FACTOR : 1)) : null;
  }

  // Returns the twelve edges, and the arm of the handle that turns the box.
  get segments() {
    const box = this.getBox();
    if (!box) return [];
    const edges = [0, 1, 2].flatMap((axis) => [[0, 0], [0, 1], [1, 0], [1, 1]].map((others) => {
      const ends = [0, 1].map((end) => others.toSpliced(axis, 0, end));
      return ends.map((end) => box.corner(...end));
    }));
    return [...edges, turnArms(box)[this.arm]];
  }

  // Puts the handles where they belong. The one that turns the box stays at its arm while it can be reached there.
  place(projection) {
    const box = this.getBox();
    this.projection = projection;
    const isReachable = ([, end]) => isFree(projection.place(end)), arms = box && turnArms(box);
    if (box && !isReachable(arms[this.arm])) this.arm = Math.max(0, arms.findIndex(isReachable));
    const show = (handle, point) => {
      const place = point && projection.place(point);
      handle.hidden = !place;
      if (place) Object.assign(handle.style, { left: `${place[0]}px`, top: `${place[1]}px` });
    };
    for (const [number, { axis, side }] of BOX_FACES.entries()) {
      show(this.handles[number], box && faceMiddle(box, axis, side));
      if (box) this.handles[number].setAttribute("aria-valuenow", box.value[axis + 3 * side]);
    }
    show(this.mover, box && box.middle);
    show(this.turner, box && arms[this.arm][1]);
    if (box) this.turner.setAttribute("aria-valuenow", box.value[6] ?? 0);
  }
}

const placeOf = ({ clientX, clientY }) => [clientX, clientY];

const stepLength = ({ shiftKey }, { size }) => KEY_STEP_RATIO * size * (shiftKey ? SHIFT_FACTOR : 1);

const faceMiddle = ({ corner }, axis, side) => {
  const first = corner(...[0, 0, 0].with(axis, side)), last = corner(...[1, 1, 1].with(axis, side));
  return add(first, mul(sub(last, first), 0.5));
};

// Returns the four places of the arm of the handle that turns a box, each by its two ends: the middle of an edge that
// stands upright, far from the handles of the faces, and a point outside of it.
function turnArms(box) {
  const slopes = box.axes.map((axis) => Math.abs(dot(axis, box.up))), upright = slopes.indexOf(Math.max(...slopes));
  return [[0, 0], [0, 1], [1, 0], [1, 1]].map((others) => {
    const edge = mul(add(...[0, 1].map((end) => box.corner(...others.toSpliced(upright, 0, end)))), 0.5);
    return [edge, add(edge, mul(sub(edge, box.middle), TURN_HANDLE_RATIO))];
  });
}

// Returns whether a handle at a place can be reached: in the window, and not under the panel.
function isFree(place) {
  if (!place) return false;
  const [x, y] = place, { left, right, top, bottom } = element("edit").getBoundingClientRect();
  const margin = MIN_HANDLE_MARGIN_PIXELS;
  const isUnderPanel = x > left - margin && x < right + margin && y > top - margin && y < bottom + margin;
  return x > margin && y > margin && x < innerWidth - margin && y < innerHeight - margin && !isUnderPanel;
}

// Returns the numbers of a box with one of its sides moved, but not beyond the opposite one, which stays where it is.
function withSide({ value, turn }, axis, side, position) {
  const other = value[axis + 3 * (1 - side)], place = side ? Math.max(position, other) : Math.min(position, other);
  // The box turns about its centre, which moves by half of the way: along the turned axis, and not along that of the
  // numbers.
  const half = (place - value[axis + 3 * side]) / 2;
  const shift = turn.map((row, k) => half * (row[axis] - (k === axis ? 1 : 0)));
  return withMove(value.with(axis + 3 * side, place), shift);
}

const withMove = (value, shift) => value.map((place, k) => (k < 6 ? place + shift[k % 3] : place));

// Returns the numbers of a box that is turned further.
const withTurn = (value, degrees) => [...value.slice(0, 6), (value[6] ?? 0) + degrees];
