// Unit quaternions as their three smallest components: what formats that pack rotations into few bits store.

/**
 * Put back the component of largest magnitude, which is positive.
 * @param {number} largest its number, 0 to 3
 * @param {number} a the others in their order
 * @param {number} b
 * @param {number} c
 * @param {Float32Array} quats
 * @param {number} at where the four of them go
 * @param {number[]} [order] where among w, x, y, z each component of the file goes
 */
export function writeQuat(largest, a, b, c, quats, at, order = [0, 1, 2, 3]) {
  quats[at + order[largest]] = Math.sqrt(Math.max(0, 1 - a * a - b * b - c * c));
  quats[at + order[largest === 0 ? 1 : 0]] = a;
  quats[at + order[largest <= 1 ? 2 : 1]] = b;
  quats[at + order[largest <= 2 ? 3 : 2]] = c;
}
