// A smooth path of the eye through poses: it starts and ends at rest, and does not stop at those between.

import { normalizedQuat, quatOf, rowsOf } from "../../hyrf/rotation.js";

// Returns the pose at a part, from 0 to 1, of the path through poses (see Eye). Each step between two takes as long.
// Every number is a cubic Hermite spline (Catmull and Rom's tangents; zero at both ends).
export function poseOnPath(poses, part) {
  const keys = poses.map(numbersOf), steps = keys.length - 1;
  keys.forEach((key, k) => k && alignQuat(key, keys[k - 1]));
  const step = Math.min(steps - 1, Math.floor(part * steps)), t = part * steps - step;
  const slopeAt = (k, i) => (k === 0 || k === steps ? 0 : (keys[k + 1][i] - keys[k - 1][i]) / 2);
  const numbers = keys[step].map((from, i) => {
    const to = keys[step + 1][i], before = slopeAt(step, i), after = slopeAt(step + 1, i);
    const square = t * t, cube = square * t;
    return from + (to - from) * (3 * square - 2 * cube) + before * (cube - 2 * square + t) + after * (cube - square);
  });
  return poseOf(numbers);
}

// Lengths of a pose are blended by their logarithms.
const numbersOf = ({ position, rows, focal, pace, target }) =>
  [...quatOf(rows), ...position, ...target, Math.log(focal), Math.log(pace)];

const poseOf = (numbers) => ({
  rows: rowsOf(normalizedQuat(numbers.slice(0, 4))), position: numbers.slice(4, 7), target: numbers.slice(7, 10),
  focal: Math.exp(numbers[10]), pace: Math.exp(numbers[11]),
});

// Gives a quaternion the sign that is nearer to another one; both signs are the same rotation.
function alignQuat(key, before) {
  const cosine = [0, 1, 2, 3].reduce((sum, i) => sum + key[i] * before[i], 0);
  for (let i = 0; i < 4 && cosine < 0; i++) key[i] = -key[i];
}
