// The crop box: its edges, and a handle on each face, which pointers, fingers and arrow keys move.

import { element } from "../dom.js";
import { add, mul, sub } from "../../hyrf/vectors.js";

const STEP_RATIO = 0.01; // of the scene's size, for an arrow key; ten times as much with Shift
const FACES = [0, 1, 2].flatMap((axis) => [{ axis, side: 0 }, { axis, side: 1 }]);
const KEY_SIGNS = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 };

export class CropBox {
  // `getBox()` returns the box, {corner: a function of three numbers 0 or 1, value: its six numbers, axes: unit vectors
  // along its sides, unit: the length of a world unit, size: that of the scene in world units}, or null.
  // `change(value, isFinal)` is called with new numbers.
  constructor(player, getBox, change) {
    Object.assign(this, { player, getBox, change });
    this.handles = FACES.map((face) => this.createHandle(face));
    element("edit-handles").replaceChildren(...this.handles);
  }

  createHandle(face) {
    const handle = document.createElement("button"), letter = "xyz"[face.axis], end = face.side ? "maximum" : "minimum";
    handle.className = letter;
    handle.setAttribute("role", "slider");
    handle.setAttribute("aria-label", `${end} ${letter} of the box`);
    handle.title = `${end} ${letter}: drag it, or use arrow keys`;
    handle.onpointerdown = (event) => this.press(event, handle, face);
    handle.onkeydown = (event) => this.key(event, face);
    handle.onkeyup = () => this.drawn && this.change(this.getBox().value, true);
    return handle;
  }

  // Drags a face along its axis until the pointer is released.
  press(event, handle, { axis, side }) {
    if (event.button) return;
    event.preventDefault();
    handle.focus();
    handle.setPointerCapture(event.pointerId);
    const box = this.getBox(), middle = faceMiddle(box, axis, side);
    const along = ({ clientX, clientY }) => this.projection.along(middle, box.axes[axis], [clientX, clientY]);
    const start = along(event);
    handle.onpointermove = (moved) => {
      const now = along(moved);
      if (start === null || now === null) return;
      this.change(withSide(box.value, axis, side, box.value[axis + 3 * side] + (now - start) / box.unit), false);
    };
    handle.onpointerup = handle.onpointercancel = handle.onlostpointercapture = () => {
      handle.onpointermove = handle.onpointerup = handle.onpointercancel = handle.onlostpointercapture = null;
      this.change(this.getBox().value, true);
    };
  }

  key(event, { axis, side }) {
    const sign = KEY_SIGNS[event.key];
    if (!sign) return;
    event.preventDefault();
    event.stopPropagation(); // arrow keys also turn the eye
    const { value, size } = this.getBox(), step = sign * STEP_RATIO * size * (event.shiftKey ? 10 : 1);
    this.change(withSide(value, axis, side, value[axis + 3 * side] + step), false);
  }

  // Returns the twelve edges.
  get segments() {
    const box = this.getBox();
    if (!box) return [];
    return [0, 1, 2].flatMap((axis) => [[0, 0], [0, 1], [1, 0], [1, 1]].map((others) => {
      const ends = [0, 1].map((end) => others.toSpliced(axis, 0, end));
      return ends.map((end) => box.corner(...end));
    }));
  }

  // Puts the handles on the faces.
  place(projection) {
    const box = this.getBox();
    this.projection = projection;
    this.drawn = box !== null;
    for (const [number, { axis, side }] of FACES.entries()) {
      const handle = this.handles[number], place = box && projection.place(faceMiddle(box, axis, side));
      handle.hidden = !place;
      if (!place) continue;
      Object.assign(handle.style, { left: `${place[0]}px`, top: `${place[1]}px` });
      handle.setAttribute("aria-valuenow", box.value[axis + 3 * side]);
    }
  }
}

const faceMiddle = ({ corner }, axis, side) => {
  const first = corner(...[0, 0, 0].with(axis, side)), last = corner(...[1, 1, 1].with(axis, side));
  return add(first, mul(sub(last, first), 0.5));
};

// Returns the six numbers of a box with one of its sides moved, but not beyond the opposite one.
function withSide(value, axis, side, position) {
  const other = value[axis + 3 * (1 - side)];
  return value.with(axis + 3 * side, side ? Math.max(position, other) : Math.min(position, other));
}
