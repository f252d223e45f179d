// States which direction is up, by three points of the ground, and turns the scene upright.

import { frameAxes, rotateBy } from "../../hyrf/rotation.js";
import { cross, dot, sub, unit } from "../../hyrf/vectors.js";
import { toPage } from "../camera.js";
import { toast } from "../notifications.js";
import { findActive, putAction, statedUp } from "./actions.js";
import { PointPicker } from "./point_picker.js";

const GROUND_POINT_COUNT = 3;
const MIN_ANGLE_SINE = 0.05; // at a smaller angle at the first point, the three points are in a row

export class UpTool {
  constructor(editor) {
    this.editor = editor;
    this.picker = new PointPicker(editor, "up", (points) => this.take(points));
    for (const button of document.querySelectorAll("[data-upright]")) {
      button.onclick = () => this.turn(button.dataset.upright);
    }
  }

  get drawn() {
    const { points } = this.picker;
    return { points, labels: points.map((at, k) => ({ at, text: k + 1 })) };
  }

  pick(x, y) {
    this.picker.pick(x, y);
  }

  leave() {
    this.picker.clear();
  }

  reset() {
    this.picker.clear();
  }

  take(points) {
    if (points.length === GROUND_POINT_COUNT) {
      const { editor } = this, { scene } = editor.player, cameras = scene.cameras.map(positionOf);
      const up = normalTowards(points, cameras.map((position) => toPage(position, scene)));
      this.picker.clear();
      if (!up) toast("The three points lie in a row; pick others.");
      else this.state(rotateBy(editor.placement.rows, rotateBy(frameAxes(scene), up)));
    }
    this.editor.refresh();
  }

  // Adds the action that states a direction.
  state(direction) {
    const { editor } = this;
    editor.set(putAction(editor.actions, statedUp(direction)));
    toast("Up is perpendicular to the ground; orbits turn about it.");
  }

  // Turns the scene; the command states up before, so that it does not depend on what the page knows of the file.
  turn(axis) {
    const { editor } = this;
    if (findActive(editor.actions, "up") < 0) editor.actions = [...editor.actions, statedUp(editor.placement.up)];
    editor.set([...editor.actions, { option: "upright", value: axis }]);
    toast(`The saved scene will have +${axis} up. New boxes lie along its axes.`);
  }
}

// Returns the unit normal of three points on the side of most cameras, or null if the points are in a row.
export function normalTowards([a, b, c], cameras) {
  const normal = cross(unit(sub(b, a)), unit(sub(c, a)));
  if (Math.hypot(...normal) < MIN_ANGLE_SINE) return null;
  const above = cameras.filter((position) => dot(sub(position, a), normal) > 0).length;
  return unit(2 * above >= cameras.length ? normal : normal.map((part) => -part));
}

// Returns the position of a camera in world units.
const positionOf = ({ camera_from_world: pose }) =>
  [0, 1, 2].map((k) => -pose.slice(0, 3).reduce((sum, row) => sum + row[k] * row[3], 0));
