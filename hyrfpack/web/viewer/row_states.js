// Records the viewpoint from which each row of Gaussians was last coloured.

import { intersectsFrustum } from "./frustum.js";

export class RowStates {
  // `balls` has a ball around each row (see rowBalls in pack.js).
  constructor(balls) {
    this.balls = balls;
    this.count = balls.length / 4;
    this.eyes = new Float64Array(3 * this.count).fill(NaN);
  }

  // Returns {visible, fresh, rows}. `visible` is the number of rows within the planes `sides`. `rows` are those among
  // them whose viewing direction has turned by more than `angle` radians since they were coloured, largest turns first.
  // `fresh` is the number of these that have no colours yet.
  stale(sides, eye, angle) {
    const { balls, eyes } = this, stale = [], angles = new Float64Array(this.count);
    let visible = 0, fresh = 0;
    for (let row = 0, b = 0, e = 0; row < this.count; row++, b += 4, e += 3) {
      const [x, y, z, radius] = balls.subarray(b, b + 4);
      if (!intersectsFrustum(sides, x, y, z, radius)) continue;
      visible++;
      const moved = Math.hypot(eye[0] - eyes[e], eye[1] - eyes[e + 1], eye[2] - eyes[e + 2]);
      if (moved === 0) continue;
      const never = Number.isNaN(moved);
      angles[row] = never ? Infinity : moved / Math.max(Math.hypot(eye[0] - x, eye[1] - y, eye[2] - z), radius);
      if (angles[row] <= angle) continue;
      stale.push(row);
      if (never) fresh++;
    }
    return { visible, fresh, rows: stale.sort((a, b) => (angles[b] > angles[a]) - (angles[b] < angles[a])) };
  }

  // Returns the rows that have no colours yet.
  fresh() {
    return Array.from({ length: this.count }, (_, row) => row).filter((row) => Number.isNaN(this.eyes[3 * row]));
  }

  // Records that a row was coloured.
  colored(row, eye) {
    this.eyes.set(eye, 3 * row);
  }
}
