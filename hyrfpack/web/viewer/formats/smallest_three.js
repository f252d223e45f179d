// Decodes unit quaternions that are stored as their three smallest components.

/**
 * Writes a quaternion, and restores its component of largest magnitude, which is positive.
 * @param {number} largest the index of that component, 0 to 3
 * @param {number} a the other components in their order
 * @param {number} b
 * @param {number} c
 * @param {Float32Array} quats
 * @param {number} at the index in `quats` of the first component
 * @param {number[]} [order] the index among w, x, y, z of each component of the file
 */
export function writeQuat(largest, a, b, c, quats, at, order = [0, 1, 2, 3]) {
  quats[at + order[largest]] = Math.sqrt(Math.max(0, 1 - a * a - b * b - c * c));
  quats[at + order[largest === 0 ? 1 : 0]] = a;
  quats[at + order[largest <= 1 ? 2 : 1]] = b;
  quats[at + order[largest <= 2 ? 3 : 2]] = c;
}
