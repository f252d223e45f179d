// What a view sees, roughly.

import { add, mul } from "./camera.js";

// The four sides of a view's picture and a band around it, `margin` as a fraction of half its size: planes through the
// eye, 4 numbers each, unit normals inwards.
export function sidesOf({ rows, translation, fx, fy, cx, cy, width, height }, margin) {
  const side = (axis, sign, focal, reach) => {
    const length = Math.hypot(focal, reach);
    const [across, ahead] = [(sign * focal) / length, reach / length];
    return [...add(mul(rows[axis], across), mul(rows[2], ahead)), across * translation[axis] + ahead * translation[2]];
  };
  const [wide, high] = [(margin * width) / 2, (margin * height) / 2];
  return [
    side(0, 1, fx, cx + wide), side(0, -1, fx, width - cx + wide),
    side(1, 1, fy, cy + high), side(1, -1, fy, height - cy + high),
  ].flat();
}

// Whether a ball is not wholly outside of one of the sides.
export function touches(sides, x, y, z, radius) {
  for (let s = 0; s < 16; s += 4) {
    if (!(sides[s] * x + sides[s + 1] * y + sides[s + 2] * z + sides[s + 3] > -radius)) return false;
  }
  return true;
}
