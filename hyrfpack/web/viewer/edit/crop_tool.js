// Crops to boxes, by handles over the scene and by numbers.

import { element } from "../dom.js";
import { frameAxes, rotateBack, rotateBy, transpose } from "../../hyrf/rotation.js";
import { add, mul, sub } from "../../hyrf/vectors.js";
import { boxTurn, middleOf, placementAfter, roundLength } from "./actions.js";
import { dropAction, findActive, putAction, statedUp } from "./actions.js";
import { CropBox } from "./crop_box.js";

const CROP_OPTION = "crop-box";
// Half a side of a new box, as a ratio of the cameras' distance from the scene's target.
const NEW_BOX_HALF_SIDE_RATIO = 0.3;

export class CropTool {
  constructor(editor) {
    this.editor = editor;
    this.box = new CropBox(editor.player, () => this.describe(), (change, isFinal) => this.put(change, isFinal));
    const sides = document.querySelectorAll("#edit-box [type=number]:not(#edit-turn)");
    this.inputs = [...sides, element("edit-turn")]; // in the order of the numbers of a box
    for (const input of this.inputs) {
      input.oninput = () => this.read(false);
      input.onchange = () => this.read(true);
    }
    element("edit-inside").onchange = ({ target }) => this.put({ isInverted: target.checked });
    element("edit-add-box").onclick = () => this.add();
    element("edit-drop-box").onclick = () => editor.set(dropAction(editor.actions, CROP_OPTION));
  }

  // The action of the box with handles, or undefined.
  get active() {
    return this.editor.actions[findActive(this.editor.actions, CROP_OPTION)];
  }

  // The actions before that of the box. The box turns about the up direction after these.
  get before() {
    const { actions } = this.editor;
    return actions.slice(0, findActive(actions, CROP_OPTION));
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
    const middle = mul(rotateBy(rows, scene.target), factor), half = NEW_BOX_HALF_SIDE_RATIO * (eye.size || 1) * size;
    const value = [-half, half].flatMap((side) => middle.map((place) => roundLength(place + side, size)));
    editor.set([...editor.actions, { option: CROP_OPTION, value }]);
  }

  // Changes the box with handles, unless it was undone meanwhile. The command states up before a box that is turned
  // about it, so that it does not depend on what the page knows of the file.
  put(change, isFinal = true) {
    const { editor, active, before } = this;
    if (!active) return;
    const { value, isInverted } = { ...active, ...change };
    const rounded = value.slice(0, 6).map((place) => roundLength(place, editor.size));
    const tenths = Math.round(10 * (value[6] ?? 0));
    const degrees = (tenths + 3600 * Math.round(-tenths / 3600)) / 10; // over -180, to 180
    if (degrees) rounded.push(degrees);
    const action = { option: CROP_OPTION, value: rounded, ...(isInverted && { isInverted }) };
    let { actions } = editor;
    if (degrees && !before.some(({ option }) => option === "up")) {
      actions = actions.toSpliced(before.length, 0, statedUp(placementAfter(before, editor.player.scene).up));
    }
    editor.set(putAction(actions, action), isFinal);
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
      const number = active.value[k] ?? 0;
      if (input !== document.activeElement || input.valueAsNumber !== number) input.value = number;
    });
    element("edit-inside").checked = Boolean(active.isInverted);
  }

  // Describes the box for CropBox: {value: its numbers, turn: the rows of its rotation in the world, corner: a function
  // of three numbers 0 or 1, middle, axes: unit vectors along its sides, up, unit: the length of a world unit, size:
  // that of the scene in world units, toWorld: a function of vectors}. Points and vectors are those of the page.
  describe() {
    const { active, editor } = this;
    if (!active) return null;
    const { player: { scene }, size } = editor, { factor, rows, up } = placementAfter(this.before, scene);
    const { value } = active;
    const turn = boxTurn(value, up), center = middleOf(value.slice(0, 3), value.slice(3, 6));
    const frame = frameAxes(scene), turnBack = (vector) => rotateBack(frame, rotateBack(rows, vector));
    const origin = mul(rotateBack(frame, scene.center), 1 / scene.unit);
    const unit = 1 / (factor * scene.unit), toPage = (place) => sub(mul(turnBack(place), unit), origin);
    const corner = (...ends) => {
      const place = ends.map((end, axis) => value[axis + 3 * end]);
      return toPage(add(rotateBy(turn, sub(place, center)), center));
    };
    const axes = transpose(turn).map(turnBack);
    const toWorld = (vector) => mul(rotateBy(rows, rotateBy(frame, vector)), 1 / unit);
    return { value, turn, corner, middle: toPage(center), axes, up: turnBack(up), unit, size, toWorld };
  }
}
