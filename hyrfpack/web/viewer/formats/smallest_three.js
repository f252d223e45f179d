// Decodes unit quaternions that are stored as their three smallest components.

/**
 * Restores the component of largest magnitude of a quaternion, which is positive, and writes all four.
 * @param {number} largest the index of that component, 0 to 3
 * @param {number} a the first of the other components, in the order of the file
 * @param {number} b
 * @param {number} c
 * @param {Float32Array} quats
 * @param {number} at the index in `quats` of its w
 * @param {number[]} [order] for each component of the file, its index in w, x, y, z
 */
export function writeQuat(largest, a, b, c, quats, at, order = [0, 1, 2, 3]) {
  quats[at + order[largest]] = Math.sqrt(Math.max(0, 1 - a * a - b * b - c * c));
  quats[at + order[largest === 0 ? 1 : 0]] = a;
  quats[at + order[largest <= 1 ? 2 : 1]] = b;
  quats[at + order[largest <= 2 ? 3 : 2]] = c;
}
