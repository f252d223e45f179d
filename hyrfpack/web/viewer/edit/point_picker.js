// Picks points of the scene, by clicks and taps, or in the picture's centre.

import { toast } from "../notifications.js";

export class PointPicker {
  // `pane` is the name of the pane whose button picks the centre. `picked(points)` is called with all points so far.
  constructor(editor, pane, picked) {
    Object.assign(this, { editor, picked, points: [] });
    const { canvas } = editor.player;
    document.querySelector(`[data-pane="${pane}"] .edit-pick`).onclick = () =>
      this.pick(canvas.clientWidth / 2, canvas.clientHeight / 2);
  }

  pick(x, y) {
    const point = this.editor.player.findPoint(x, y);
    if (!point) return toast("There is nothing to pick here.");
    this.points = [...this.points, point];
    this.picked(this.points);
  }

  clear() {
    this.points = [];
  }
}
