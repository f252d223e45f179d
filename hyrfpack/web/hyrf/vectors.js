// Calculates with vectors of three numbers.

/**
 * @param {number[]} a
 * @param {number[]} b
 */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];

/**
 * @param {number[]} a
 * @param {number[]} b
 */
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

/**
 * @param {number[]} a
 * @param {number} s
 */
export const mul = (a, s) => [a[0] * s, a[1] * s, a[2] * s];

/**
 * @param {number[]} a
 * @param {number[]} b
 */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/**
 * @param {number[]} a
 * @param {number[]} b
 */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/**
 * Returns the vector of unit length with the direction of `a`. Zero stays zero.
 * @param {number[]} a
 */
export const unit = (a) => {
  const length = Math.hypot(...a) || 1;
  return a.map((value) => value / length);
};

/**
 * Rotates a vector about a unit axis by an angle in radians (Rodrigues' formula).
 * @param {number[]} vector
 * @param {number[]} axis
 * @param {number} angle
 */
export function rotate(vector, axis, angle) {
  const cosine = Math.cos(angle), along = mul(axis, dot(axis, vector) * (1 - cosine));
  return add(add(mul(vector, cosine), mul(cross(axis, vector), Math.sin(angle))), along);
}
