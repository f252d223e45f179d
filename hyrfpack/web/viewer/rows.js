// From where each row of a texture of Gaussians was last coloured.

import { touches } from "./frustum.js";

export class Rows {
  // `balls`: around each row, see pack.js.
  constructor(balls) {
    this.balls = balls;
    this.count = balls.length / 4;
    this.eyes = new Float64Array(3 * this.count).fill(NaN);
  }

  // How many rows lie within the sides of a view; those among them that are seen from another side than when they were
  // coloured, by more than so many radians, those first that are turned most; how many of these never were coloured.
  stale(sides, eye, angle) {
    const { balls, eyes } = this, found = [], turns = new Float64Array(this.count);
    let visible = 0, fresh = 0;
    for (let row = 0, b = 0, e = 0; row < this.count; row++, b += 4, e += 3) {
      const [x, y, z, radius] = balls.subarray(b, b + 4);
      if (!touches(sides, x, y, z, radius)) continue;
      visible++;
      const moved = Math.hypot(eye[0] - eyes[e], eye[1] - eyes[e + 1], eye[2] - eyes[e + 2]);
      if (moved === 0) continue;
      const never = Number.isNaN(moved);
      turns[row] = never ? Infinity : moved / Math.max(Math.hypot(eye[0] - x, eye[1] - y, eye[2] - z), radius);
      if (turns[row] <= angle) continue;
      found.push(row);
      if (never) fresh++;
    }
    return { visible, fresh, rows: found.sort((a, b) => (turns[b] > turns[a]) - (turns[b] < turns[a])) };
  }

  // Those that never were coloured.
  fresh() {
    return Array.from({ length: this.count }, (_, row) => row).filter((row) => Number.isNaN(this.eyes[3 * row]));
  }

  colored(row, eye) {
    this.eyes.set(eye, 3 * row);
  }
}
