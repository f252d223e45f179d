// Crops to boxes, by handles over the scene and by numbers.

import { element } from "../dom.js";
import { frameAxes, rotateBack, rotateBy } from "../../hyrf/rotation.js";
import { mul, sub } from "../../hyrf/vectors.js";
import { dropAction, findActive, putAction, roundLength } from "./actions.js";
import { CropBox } from "./crop_box.js";

const OPTION = "crop-box";
const FIRST_SIDE_RATIO = 0.3; // half the sides of a new box, of the cameras' distance from the scene's target

export class CropTool {
  constructor(editor) {
    this.editor = editor;
    this.box = new CropBox(editor.player, () => this.describe(), (value, isFinal) => this.put({ value }, isFinal));
    this.inputs = [...document.querySelectorAll("#edit-box [type=number]")];
    for (const input of this.inputs) {
      input.oninput = () => this.read(false);
      input.onchange = () => this.read(true);
    }
    element("edit-inside").onchange = ({ target }) => this.put({ isInverted: target.checked });
    element("edit-add-box").onclick = () => this.add();
    element("edit-drop-box").onclick = () => editor.set(dropAction(editor.actions, OPTION));
  }

  // The action of the box with handles, or undefined.
  get active() {
    return this.editor.actions[findActive(this.editor.actions, OPTION)];
  }

  get drawn() {
    return { segments: this.box.segments };
  }

  placed(projection) {
    this.box.place(projection);
  }

  leave() {
    element("edit-handles").hidden = true;
  }

  enter() {
    element("edit-handles").hidden = false;
  }

  // Adds a box about the scene's target.
  add() {
    const { editor } = this, { player: { scene, eye }, placement: { factor, rows }, size } = editor;
    const middle = mul(rotateBy(rows, scene.target), factor), half = FIRST_SIDE_RATIO * (eye.size || 1) * size;
    const value = [-half, half].flatMap((side) => middle.map((place) => roundLength(place + side, size)));
    editor.set([...editor.actions, { option: OPTION, value }]);
  }

  // Changes the box with handles.
  put({ value = this.active.value, isInverted = this.active.isInverted }, isFinal = true) {
    const { editor } = this, rounded = value.map((place) => roundLength(place, editor.size));
    const action = { option: OPTION, value: rounded, ...(isInverted ? { isInverted } : {}) };
    editor.set(putAction(editor.actions, action), isFinal);
  }

  // Takes the numbers of the panel if they make a box.
  read(isFinal) {
    const value = this.inputs.map(({ valueAsNumber }) => valueAsNumber);
    if (value.every(Number.isFinite) && [0, 1, 2].every((k) => value[k] <= value[k + 3])) this.put({ value }, isFinal);
    else if (isFinal) this.refresh();
  }

  refresh() {
    const { active } = this;
    element("edit-box").hidden = element("edit-drop-box").hidden = !active;
    element("edit-add-box").textContent = active ? "Another box" : "Add a box";
    if (!active) return;
    this.inputs.forEach((input, k) => {
      if (input !== document.activeElement || input.valueAsNumber !== active.value[k]) input.value = active.value[k];
    });
    element("edit-inside").checked = Boolean(active.isInverted);
  }

  // Describes the box for CropBox.
  describe() {
    const { active, editor } = this;
    if (!active) return null;
    const { player: { scene }, placement: { factor, rows }, size } = editor, { value } = active;
    const turnBack = (vector) => rotateBack(frameAxes(scene), rotateBack(rows, vector));
    const origin = mul(rotateBack(frameAxes(scene), scene.center), 1 / scene.unit);
    const corner = (...ends) =>
      sub(mul(turnBack(ends.map((end, axis) => value[axis + 3 * end])), 1 / (factor * scene.unit)), origin);
    const axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map(turnBack);
    return { value, corner, axes, unit: 1 / (factor * scene.unit), size };
  }
}
