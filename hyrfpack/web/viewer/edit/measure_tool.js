// Measures the distance of two points, and scales the scene by a known one.

import { element } from "../dom.js";
import { add, mul, sub } from "../../hyrf/vectors.js";
import { toast } from "../notifications.js";
import { isStorable } from "./actions.js";
import { PointPicker } from "./point_picker.js";

const DISTANCE_DIGITS = 4;
const FACTOR_DIGITS = 6;

export class MeasureTool {
  constructor(editor) {
    this.editor = editor;
    this.picker = new PointPicker(editor, "measure", (points) => this.take(points));
    element("edit-clear").onclick = () => {
      this.picker.clear();
      editor.refresh();
    };
    element("edit-length").oninput = () => this.refresh();
    element("edit-rescale").onclick = () => {
      const actions = [...editor.actions, { option: "scale", value: this.factor }];
      if (isStorable(actions, editor.player.scene)) editor.set(actions);
      else toast("No scene can have this size; type another length.");
    };
  }

  // The distance in world units after the actions, or null without two points.
  get distance() {
    const { points: [from, to] } = this.picker;
    return to ? this.editor.size * Math.hypot(...sub(to, from)) : null;
  }

  // The factor that gives the two points the length of the user; NaN without points or a length.
  get factor() {
    return Number((element("edit-length").valueAsNumber / (this.distance ?? NaN)).toPrecision(FACTOR_DIGITS));
  }

  get text() {
    return this.distance === null ? "" : `${Number(this.distance.toPrecision(DISTANCE_DIGITS))} units`;
  }

  get drawn() {
    const { points } = this.picker, [from, to] = points;
    if (!to) return { points };
    return { points, segments: [points], labels: [{ at: mul(add(from, to), 0.5), text: this.text }] };
  }

  pick(x, y) {
    this.picker.pick(x, y);
  }

  reset() {
    this.picker.clear();
  }

  // A third point begins another measurement.
  take(points) {
    if (points.length > 2) this.picker.points = points.slice(2);
    this.editor.refresh();
  }

  refresh() {
    element("edit-distance").textContent = this.text;
    element("edit-rescale").disabled = Number.isNaN(this.factor);
  }
}
