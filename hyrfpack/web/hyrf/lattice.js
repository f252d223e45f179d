// Decodes points on a lattice in the contracted cube, stored in Morton order (codec 6, docs/reference/format.md 3.3).

import { BitReader } from "./bits.js";
import { assertValid } from "./errors.js";
import { LOW_HALF_BITS, decodeIntegers, decodeWideIntegers } from "./integers.js";

/**
 * The points of a layer: the centres of their cells (3 N), in units of 2^-19 of the cube's edge, and their classes (N).
 * @typedef {{centers: Int32Array, classes: Uint8Array, count: number}} LatticePoints
 */

const MAX_BITS_PER_AXIS = 18;
const MAX_POINT_CLASSES = 16;
const LATTICE_HEADER_BYTES = 10;
const LOW_HALF_MASK = 2 ** LOW_HALF_BITS - 1;
const AXIS_BITS_PER_HALF = LOW_HALF_BITS / 3; // because a Morton code interleaves three axes
const TAIL_BITS_PER_READ = 24; // must be a multiple of 3 and at most MAX_BITS_PER_READ

/** Centres of cells are given in units of 2^-CENTER_BITS_PER_AXIS of the cube's edge. */
export const CENTER_BITS_PER_AXIS = MAX_BITS_PER_AXIS + 1;

const CUBE_CENTER = 2 ** MAX_BITS_PER_AXIS; // in the units of centres
const MAX_CONTRACTED_RADIUS = 2 - 2 ** -20; // farther points would be at infinity; the ball of radius 1 is the frame

/**
 * Extracts every third bit of a Morton code of 27 bits, beginning with the lowest bit.
 * @param {number} code
 * @returns {number} 9 bits
 */
const extractEveryThirdBit = (code) => {
  code &= 0x01249249;
  code = (code | (code >> 2)) & 0x010c30c3;
  code = (code | (code >> 4)) & 0x0100f00f;
  code = (code | (code >> 8)) & 0x010000ff;
  return (code | (code >> 16)) & 0x1ff;
};

/**
 * Decodes the points of a layer.
 * @param {Uint8Array} data the bytes of the section
 * @param {number} count the number of points
 * @returns {LatticePoints}
 * @throws {DamagedData} a length or a number is invalid, or a point lies outside the cube
 */
export const decodeLattice = (data, count) => {
  assertValid(data.length >= LATTICE_HEADER_BYTES, "it ends within its header");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const base = data[0], classCount = data[1], gapsAt = LATTICE_HEADER_BYTES + classCount;
  const classesAt = gapsAt + view.getUint32(2, true), tailsAt = classesAt + view.getUint32(6, true);
  const areClassesValid = classCount >= 1 && classCount <= MAX_POINT_CLASSES;
  assertValid(base >= 1 && base <= MAX_BITS_PER_AXIS && areClassesValid, "its header has invalid values");
  assertValid(tailsAt <= data.length, "it ends too early");
  const bits = data.subarray(LATTICE_HEADER_BYTES, gapsAt);
  assertValid(bits.every((b) => b >= base && b <= MAX_BITS_PER_AXIS), "a class of points has too few or too many bits");

  const gaps = decodeWideIntegers(data.subarray(gapsAt, classesAt), count);
  const repeats = new Uint8Array(count);
  for (let i = 0; i < count; i++) repeats[i] = gaps.low[i] === 0 && gaps.high[i] === 0 ? 1 : 0;
  const chosen = decodeIntegers(data.subarray(classesAt, tailsAt), count, repeats, false);
  const classes = new Uint8Array(count);
  let tailBits = 0;
  for (let i = 0; i < count; i++) {
    assertValid(chosen[i] < classCount, "a point has a class that is not there");
    classes[i] = chosen[i];
    tailBits += 3 * (bits[chosen[i]] - base);
  }
  const tails = new BitReader(data.subarray(tailsAt), tailBits);

  // A code with `base` bits per axis is below 2^(3 base).
  const maxHigh = 2 ** Math.max(3 * base - LOW_HALF_BITS, 0) - 1, maxLow = 2 ** Math.min(3 * base, LOW_HALF_BITS) - 1;
  const centers = new Int32Array(3 * count);
  let high = 0, low = 0;
  for (let i = 0; i < count; i++) {
    low += gaps.low[i];
    high += gaps.high[i] + (low >>> LOW_HALF_BITS);
    low &= LOW_HALF_MASK;
    assertValid(high <= maxHigh && low <= maxLow, "a point lies outside the cube");
    const finer = bits[classes[i]] - base, unit = MAX_BITS_PER_AXIS - base - finer;
    let x = 0, y = 0, z = 0;
    for (let left = 3 * finer, shift = 0; left > 0; left -= TAIL_BITS_PER_READ, shift += TAIL_BITS_PER_READ / 3) {
      const tail = tails.take(Math.min(left, TAIL_BITS_PER_READ));
      x |= extractEveryThirdBit(tail) << shift;
      y |= extractEveryThirdBit(tail >> 1) << shift;
      z |= extractEveryThirdBit(tail >> 2) << shift;
    }
    x |= (extractEveryThirdBit(low) | (extractEveryThirdBit(high) << AXIS_BITS_PER_HALF)) << finer;
    y |= (extractEveryThirdBit(low >> 1) | (extractEveryThirdBit(high >> 1) << AXIS_BITS_PER_HALF)) << finer;
    z |= (extractEveryThirdBit(low >> 2) | (extractEveryThirdBit(high >> 2) << AXIS_BITS_PER_HALF)) << finer;
    centers[3 * i] = (2 * x + 1) << unit;
    centers[3 * i + 1] = (2 * y + 1) << unit;
    centers[3 * i + 2] = (2 * z + 1) << unit;
  }
  return { centers, classes, count };
};

/**
 * Computes the positions of lattice points by the inverse of the contraction, in float64, and rounds them to float32.
 * @param {LatticePoints} points
 * @param {number[]} halfExtent the frame's half extents in local units
 * @returns {Float32Array} (3 N), local units
 */
export const latticePositions = ({ centers, count }, [width, height, depth]) => {
  const positions = new Float32Array(3 * count), unitRadius = CUBE_CENTER / 2;
  for (let i = 0; i < 3 * count; i += 3) {
    const x = (centers[i] - CUBE_CENTER) / unitRadius, y = (centers[i + 1] - CUBE_CENTER) / unitRadius;
    const z = (centers[i + 2] - CUBE_CENTER) / unitRadius;
    const radius = Math.max(Math.sqrt(x * x + y * y + z * z), 1);
    const divisor = radius * (2 - Math.min(radius, MAX_CONTRACTED_RADIUS));
    positions[i] = (x / divisor) * width;
    positions[i + 1] = (y / divisor) * height;
    positions[i + 2] = (z / divisor) * depth;
  }
  return positions;
};
