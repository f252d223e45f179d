// Rotations as unit quaternions (w, x, y, z): of frames, for interpolation and for short addresses.

import { dot } from "./vectors.js";

export const IDENTITY_QUAT = [1, 0, 0, 0];

/**
 * Returns the rows of the rotation from a frame's local axes to the axes of the world.
 * @param {{rotation?: number[]}} frame a frame, or anything else with its rotation; absent, the axes are the same
 */
export const frameAxes = ({ rotation = IDENTITY_QUAT }) => rowsOf(normalizedQuat(rotation));

/**
 * Rotates a vector by a matrix, given by its rows.
 * @param {number[][]} rows
 * @param {number[]} vector
 */
export const rotateBy = (rows, vector) => rows.map((row) => dot(row, vector));

/**
 * Rotates a vector by the inverse of a rotation matrix, given by its rows.
 * @param {number[][]} rows
 * @param {number[]} vector
 */
export const rotateBack = ([a, b, c], vector) =>
  [0, 1, 2].map((k) => a[k] * vector[0] + b[k] * vector[1] + c[k] * vector[2]);

/**
 * Returns the columns of a matrix, given by its rows.
 * @param {number[][]} rows
 */
export const transpose = (rows) => [0, 1, 2].map((k) => rows.map((row) => row[k]));

/**
 * Returns the quaternion of a rotation matrix, given by its rows.
 * @param {number[][]} rows
 */
export function quatOf([[a, b, c], [d, e, f], [g, h, i]]) {
  // The formula of the largest component avoids divisions by small numbers.
  const squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i];
  const largest = squares.indexOf(Math.max(...squares));
  const quat = [
    [squares[0], h - f, c - g, d - b],
    [h - f, squares[1], b + d, c + g],
    [c - g, b + d, squares[2], f + h],
    [d - b, c + g, f + h, squares[3]],
  ][largest];
  return normalizedQuat(quat[0] < 0 ? quat.map((value) => -value) : quat);
}

/**
 * Returns the rows of a quaternion's rotation matrix.
 * @param {ArrayLike<number>} quat of unit length
 */
export function rowsOf({ 0: w, 1: x, 2: y, 3: z }) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/** @param {number[]} quat */
export function normalizedQuat(quat) {
  const length = Math.hypot(...quat);
  return quat.map((value) => value / length);
}

/**
 * Interpolates between two rotations along the shorter arc.
 * @param {number[]} from
 * @param {number[]} to
 * @param {number} part in [0, 1]
 */
export function slerp(from, to, part) {
  const cosine = from.reduce((sum, value, k) => sum + value * to[k], 0), sign = cosine < 0 ? -1 : 1;
  const angle = Math.acos(Math.min(1, Math.abs(cosine)));
  if (angle < 1e-6) return to;
  const [a, b] = [Math.sin((1 - part) * angle), sign * Math.sin(part * angle)];
  return normalizedQuat(from.map((value, k) => a * value + b * to[k]));
}
