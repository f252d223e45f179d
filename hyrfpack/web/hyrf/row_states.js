// Records the viewpoint from which each row of Gaussians was last coloured.

import { intersectsFrustum } from "./frustum.js";

/** Rows of Gaussians, and for each the viewpoint from which it was last coloured. */
export class RowStates {
  /** @param {Float32Array} balls a ball around each row, from `rowBalls` */
  constructor(balls) {
    this.balls = balls;
    this.count = balls.length / 4;
    this.eyes = new Float64Array(3 * this.count).fill(NaN);
  }

  /**
   * Lists the rows whose colours are out of date.
   * @param {number[]} sides from `frustumPlanes`
   * @param {number[]} eye the present viewpoint, in the units of the balls
   * @param {number} angle in radians
   * @returns {{visible: number, rows: number[]}} `visible` is the number of rows within the planes `sides`. `rows` are
   *   those among them whose viewing direction has turned by more than `angle` since they were coloured, largest turns
   *   first; rows that have no colours yet come first of all.
   */
  stale(sides, eye, angle) {
    const { balls, eyes } = this, angles = new Float64Array(this.count);
    /** @type {number[]} */
    const stale = [];
    let visible = 0;
    for (let row = 0, b = 0, e = 0; row < this.count; row++, b += 4, e += 3) {
      const [x, y, z, radius] = balls.subarray(b, b + 4);
      if (!intersectsFrustum(sides, x, y, z, radius)) continue;
      visible++;
      const moved = Math.hypot(eye[0] - eyes[e], eye[1] - eyes[e + 1], eye[2] - eyes[e + 2]);
      if (moved === 0) continue;
      const distance = Math.max(Math.hypot(eye[0] - x, eye[1] - y, eye[2] - z), radius);
      angles[row] = Number.isNaN(moved) ? Infinity : moved / distance;
      if (angles[row] > angle) stale.push(row);
    }
    stale.sort((a, b) => Number(angles[b] > angles[a]) - Number(angles[b] < angles[a]));
    return { visible, rows: stale };
  }

  /**
   * Replaces the Gaussians of a row. They have no colours yet.
   * @param {number} row
   * @param {Float32Array} ball around them, from `rowBalls`
   */
  replace(row, ball) {
    this.balls.set(ball, 4 * row);
    this.eyes.fill(NaN, 3 * row, 3 * row + 3);
  }

  /** Returns the rows that have no colours yet. */
  fresh() {
    return Array.from({ length: this.count }, (_, row) => row).filter((row) => Number.isNaN(this.eyes[3 * row]));
  }

  /**
   * Records that a row was coloured.
   * @param {number} row
   * @param {number[]} eye the viewpoint of the colours
   */
  colored(row, eye) {
    this.eyes.set(eye, 3 * row);
  }
}

/**
 * Returns a ball around the positions of each row.
 * @param {Float32Array} positions 3 numbers per Gaussian
 * @param {number} width the number of Gaussians of a row; the last row may have fewer
 * @returns {Float32Array} x, y, z, radius of each row, at least one
 */
export function rowBalls(positions, width) {
  const count = positions.length / 3, balls = new Float32Array(4 * Math.max(1, Math.ceil(count / width)));
  for (let row = 0; row * width < count; row++) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    const end = 3 * Math.min(count, (row + 1) * width);
    for (let p = 3 * row * width; p < end; p++) {
      low[p % 3] = Math.min(low[p % 3], positions[p]);
      high[p % 3] = Math.max(high[p % 3], positions[p]);
    }
    const half = [0, 1, 2].map((axis) => high[axis] / 2 - low[axis] / 2);
    balls.set([...half.map((side, axis) => low[axis] + side), Math.hypot(...half)], 4 * row);
  }
  return balls;
}
