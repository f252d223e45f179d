// Codec 6 (docs/format.md 3.3): points on a lattice of the contracted cube, in Morton order.

import { BitReader } from "./bits.js";
import { needSound } from "./errors.js";
import { HALF_BITS, decodeIntegers, decodeWideIntegers } from "./integers.js";

/**
 * Points of a layer: centres of their cells in units of 2^-19 of the cube (3 N), and classes (N).
 * @typedef {{centers: Int32Array, classes: Uint8Array, count: number}} LatticePoints
 */

const FINEST_BITS = 18;
const MOST_POINT_CLASSES = 16;
const LATTICE_HEADER = 10;
const HALF_MASK = 2 ** HALF_BITS - 1;
const AXIS_BITS = HALF_BITS / 3; // of each axis in half a Morton code
const TAIL_BITS = 24; // of a tail read at once, 8 of each axis

/** Units of a cell's centre in the cube, as a power of two. */
export const CENTER_BITS = FINEST_BITS + 1;

/** Every third bit of a Morton code, from the lowest on, of 27 bits.
 * @param {number} code */
const everyThird = (code) => {
  code &= 0x01249249;
  code = (code | (code >> 2)) & 0x010c30c3;
  code = (code | (code >> 4)) & 0x0100f00f;
  code = (code | (code >> 8)) & 0x010000ff;
  return (code | (code >> 16)) & 0x1ff;
};

/**
 * @param {Uint8Array} data
 * @param {number} count
 * @returns {LatticePoints}
 * @throws {DamagedData}
 */
export const decodeLattice = (data, count) => {
  needSound(data.length >= LATTICE_HEADER, "it ends within its header");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const base = data[0], kinds = data[1], gapsAt = LATTICE_HEADER + kinds;
  const classesAt = gapsAt + view.getUint32(2, true), tailsAt = classesAt + view.getUint32(6, true);
  needSound(base >= 1 && base <= FINEST_BITS && kinds >= 1 && kinds <= MOST_POINT_CLASSES, "its header cannot be");
  needSound(tailsAt <= data.length, "it ends too early");
  const bits = data.subarray(LATTICE_HEADER, gapsAt);
  needSound(bits.every((b) => b >= base && b <= FINEST_BITS), "a class of points has too few or too many bits");

  const gaps = decodeWideIntegers(data.subarray(gapsAt, classesAt), count);
  const repeats = new Uint8Array(count);
  for (let i = 0; i < count; i++) repeats[i] = gaps.low[i] === 0 && gaps.high[i] === 0 ? 1 : 0;
  const chosen = decodeIntegers(data.subarray(classesAt, tailsAt), count, repeats, false);
  const classes = new Uint8Array(count);
  let tailBits = 0;
  for (let i = 0; i < count; i++) {
    needSound(chosen[i] < kinds, "a point has a class that is not there");
    classes[i] = chosen[i];
    tailBits += 3 * (bits[chosen[i]] - base);
  }
  const tails = new BitReader(data.subarray(tailsAt), tailBits);

  // Codes are below 2^(3 base).
  const mostHigh = 2 ** Math.max(3 * base - HALF_BITS, 0) - 1, mostLow = 2 ** Math.min(3 * base, HALF_BITS) - 1;
  const centers = new Int32Array(3 * count);
  let high = 0, low = 0;
  for (let i = 0; i < count; i++) {
    low += gaps.low[i];
    high += gaps.high[i] + (low >>> HALF_BITS);
    low &= HALF_MASK;
    needSound(high <= mostHigh && low <= mostLow, "a point lies outside the cube");
    const finer = bits[classes[i]] - base, unit = FINEST_BITS - base - finer;
    let x = 0, y = 0, z = 0;
    for (let left = 3 * finer, shift = 0; left > 0; left -= TAIL_BITS, shift += TAIL_BITS / 3) {
      const tail = tails.take(Math.min(left, TAIL_BITS));
      x |= everyThird(tail) << shift;
      y |= everyThird(tail >> 1) << shift;
      z |= everyThird(tail >> 2) << shift;
    }
    x |= (everyThird(low) | (everyThird(high) << AXIS_BITS)) << finer;
    y |= (everyThird(low >> 1) | (everyThird(high >> 1) << AXIS_BITS)) << finer;
    z |= (everyThird(low >> 2) | (everyThird(high >> 2) << AXIS_BITS)) << finer;
    centers[3 * i] = (2 * x + 1) << unit;
    centers[3 * i + 1] = (2 * y + 1) << unit;
    centers[3 * i + 2] = (2 * z + 1) << unit;
  }
  return { centers, classes, count };
};

/**
 * Local positions of lattice points: the inverse of the contraction, in float64 and then rounded.
 * @param {LatticePoints} points
 * @param {number[]} halfExtent
 * @returns {Float32Array} (3 N)
 */
export const latticePositions = ({ centers, count }, [width, height, depth]) => {
  const positions = new Float32Array(3 * count), outermost = 2 - 2 ** -20;
  for (let i = 0; i < 3 * count; i += 3) {
    const x = (centers[i] - 262144) / 131072, y = (centers[i + 1] - 262144) / 131072;
    const z = (centers[i + 2] - 262144) / 131072;
    const radius = Math.max(Math.sqrt(x * x + y * y + z * z), 1);
    const divisor = radius * (2 - Math.min(radius, outermost));
    positions[i] = (x / divisor) * width;
    positions[i + 1] = (y / divisor) * height;
    positions[i + 2] = (z / divisor) * depth;
  }
  return positions;
};
