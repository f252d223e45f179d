// Draws lines, points and labels over the scene: light ones on dark outlines, which show on any picture.

import { element } from "../dom.js";
import { Projection } from "./projection.js";

const SVG_NAMESPACE = "http://www.w3.org/2000/svg";

const create = (name, attributes, text = "") => {
  const shape = document.createElementNS(SVG_NAMESPACE, name);
  for (const [key, value] of Object.entries(attributes)) shape.setAttribute(key, value);
  shape.textContent = text;
  return shape;
};

export class Overlay {
  // `list()` returns what is drawn: {segments: [[from, to]], points, labels: [{at, text}]} in the page's coordinates.
  // `placed(projection)` is called with each view before it is drawn.
  constructor(player, list, placed) {
    Object.assign(this, { player, list, placed });
    this.svg = element("edit-overlay");
    player.addEventListener("moved", () => this.draw());
  }

  get projection() {
    const { player } = this;
    return new Projection(player.view(), player.canvas.clientWidth, player.scene.near);
  }

  draw() {
    if (!this.player.loaded) return;
    const { projection } = this;
    this.placed(projection);
    const { segments = [], points = [], labels = [] } = this.list();
    const lines = segments.map(([from, to]) => projection.segment(from, to)).filter(Boolean);
    const d = lines.map(([from, to]) => `M${from.map(Math.round)}L${to.map(Math.round)}`).join("");
    const shapes = d ? [create("path", { d, class: "outline" }), create("path", { d })] : [];
    for (const at of points) {
      const place = projection.place(at);
      if (place) shapes.push(create("circle", { cx: place[0], cy: place[1], r: 6 }));
    }
    for (const { at, text } of labels) {
      const place = projection.place(at);
      if (place) shapes.push(create("text", { x: place[0] + 12, y: place[1] - 10 }, text));
    }
    this.svg.replaceChildren(...shapes);
  }
}
