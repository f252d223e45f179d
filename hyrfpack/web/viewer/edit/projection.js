// Projects points and segments to the window, in CSS pixels. Points are in the page's coordinates.

import { add, dot, mul, sub, unit } from "../../hyrf/vectors.js";

const MIN_AXIS_SINE = 0.05; // of the angle between a ray and an axis; at smaller ones a drag would jump

export class Projection {
  // `view` is that of the player's window, `width` that of the canvas in CSS pixels. Nothing nearer than `near` shows.
  constructor(view, width, near) {
    Object.assign(this, { view, ratio: width / view.width, near });
  }

  depthOf(point) {
    return dot(this.view.rows[2], point) + this.view.translation[2];
  }

  // Returns the place of a point, or null if it is behind the near plane.
  place(point) {
    const { rows, translation, fx, fy, cx, cy } = this.view, depth = this.depthOf(point);
    if (depth < this.near) return null;
    const [x, y] = [0, 1].map((r) => (dot(rows[r], point) + translation[r]) / depth);
    return [this.ratio * (fx * x + cx), this.ratio * (fy * y + cy)];
  }

  // Returns the places of the ends of what is visible of a segment, or null.
  segment(from, to) {
    const [a, b] = [this.depthOf(from), this.depthOf(to)];
    if (a < this.near && b < this.near) return null;
    const cut = add(from, mul(sub(to, from), (this.near - a) / (b - a)));
    const near = 1.0001 * this.near; // so that rounding does not put the cut behind the plane
    const clipped = add(cut, mul(sub(to, from), (near - this.near) / (b - a)));
    return [a < this.near ? clipped : from, b < this.near ? clipped : to].map((point) => this.place(point) ?? [0, 0]);
  }

  // Returns the unit direction of the ray through a place.
  ray([x, y]) {
    const { rows, fx, fy, cx, cy } = this.view;
    const [right, down] = [(x / this.ratio - cx) / fx, (y / this.ratio - cy) / fy];
    return unit(add(add(mul(rows[0], right), mul(rows[1], down)), rows[2]));
  }

  // Returns where the ray through a place meets a plane through a point with a normal (a unit vector), or null if it
  // does not meet it in front of the eye, or at a small angle.
  onPlane(point, normal, place) {
    const ray = this.ray(place), cosine = dot(ray, normal);
    const distance = dot(sub(point, this.view.eye), normal) / cosine;
    return Math.abs(cosine) < MIN_AXIS_SINE || !(distance > 0) ? null : add(this.view.eye, mul(ray, distance));
  }

  // Returns how far along an axis (a unit vector) through a point the ray through a place passes nearest to it, or null
  // if the axis points along the ray.
  along(point, axis, place) {
    const ray = this.ray(place), offset = sub(point, this.view.eye), cosine = dot(axis, ray);
    const squaredSine = 1 - cosine * cosine;
    if (squaredSine < MIN_AXIS_SINE ** 2) return null;
    return (cosine * dot(ray, offset) - dot(axis, offset)) / squaredSine;
  }
}
