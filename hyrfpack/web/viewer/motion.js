// Moves the eye over time (see Player.movers): damped movements, glides between cameras, and a slow turn.

import { dot, mul, sub } from "../hyrf/vectors.js";
import { quatOf, rowsOf, slerp } from "../hyrf/rotation.js";

const DAMPING_SECONDS = 0.07; // the remaining movement falls to 1/e in this time
const REST_THRESHOLD = 1e-4; // in radians or focal lengths; smaller movements are invisible
const GLIDE_SECONDS = 0.8;
const TURN_RADIANS_PER_SECOND = 0.25;
const TURN_RESUME_MS = 4000; // after the last input

export const prefersReducedMotion = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

// Spreads movements over time with an exponential decay. Their sum is exact at every frame rate.
export class Damper {
  constructor(player) {
    this.player = player;
    this.stop();
  }

  stop() {
    this.left = { yaw: 0, pitch: 0, x: 0, y: 0, depth: 0 };
    this.place = [0, 0]; // the point of the picture that keeps its place in a zoom
  }

  // Adds movements in the units of Eye; a zoom is the natural logarithm of its factor.
  orbit(yaw, pitch) {
    this.add({ yaw, pitch });
  }

  pan(x, y) {
    this.add({ x, y });
  }

  zoom(depth, ...place) {
    this.place = place;
    this.add({ depth });
  }

  // Adds a movement to the remaining one.
  add(movement) {
    for (const [name, value] of Object.entries(movement)) this.left[name] += value;
    this.player.changed();
  }

  get active() {
    return Object.values(this.left).some(Boolean);
  }

  advance(seconds) {
    if (!this.active) return false;
    const { left } = this, { eye } = this.player;
    const last = prefersReducedMotion() || Object.values(left).every((value) => Math.abs(value) < REST_THRESHOLD);
    const part = last ? 1 : 1 - Math.exp(-seconds / DAMPING_SECONDS);
    if (left.yaw || left.pitch) eye.orbit(part * left.yaw, part * left.pitch);
    if (left.depth) eye.zoom(Math.exp(part * left.depth), ...this.place);
    if (left.x || left.y) eye.pan(part * left.x, part * left.y);
    for (const name of Object.keys(left)) left[name] *= 1 - part;
    return true;
  }
}

// Moves the eye smoothly from one pose to another, or along a path.
export class Glide {
  constructor(player) {
    this.player = player;
    this.path = null;
  }

  get active() {
    return this.path !== null;
  }

  stop() {
    const ended = this.path?.ended;
    this.path = null;
    ended?.();
  }

  // Glides to the pose that `move` sets, in `seconds`.
  to(move, seconds = GLIDE_SECONDS) {
    const { eye } = this.player, from = eye.pose;
    move();
    this.stop();
    if (prefersReducedMotion() || !(seconds > 0)) return;
    const to = eye.pose, ends = [from, to].map(blendablePose);
    Object.assign(eye, from);
    this.follow((part) => (part < 1 ? blendPoses(...ends, part * part * (3 - 2 * part)) : to), seconds);
  }

  // Takes the poses of `poseAt(part)`, for parts from 0 to 1, in `seconds`. `ended()` is called at the end, also if
  // another movement replaces this one.
  follow(poseAt, seconds, ended) {
    this.stop();
    this.path = { poseAt, seconds, ended, time: 0 };
    this.player.changed();
  }

  advance(seconds) {
    const { path } = this;
    if (!path) return false;
    path.time += seconds;
    Object.assign(this.player.eye, path.poseAt(Math.min(1, path.time / path.seconds)));
    if (path.time >= path.seconds) this.stop();
    return true;
  }
}

// Returns the pose at a part of the way between two blendable poses.
function blendPoses(from, to, part) {
  const lerp = (a, b) => a + part * (b - a), lerpVector = (a, b) => a.map((value, k) => lerp(value, b[k]));
  const rows = rowsOf(slerp(from.quat, to.quat, part));
  const away = mul(lerpVector(from.away, to.away), Math.exp(lerp(Math.log(from.distance), Math.log(to.distance))));
  const target = lerpVector(from.target, to.target);
  const position = [0, 1, 2].reduce((sum, row) => sub(sum, mul(rows[row], away[row])), target);
  return { rows, target, position, focal: lerp(from.focal, to.focal), pace: lerp(from.pace, to.pace) };
}

// Returns a pose in terms that can be interpolated, such as its target, and the distance and direction (in the eye's
// axes) to it.
function blendablePose({ position, rows, focal, pace, target }) {
  const away = sub(target, position), distance = Math.hypot(...away) || 1;
  return { quat: quatOf(rows), target, distance, away: rows.map((row) => dot(row, away) / distance), focal, pace };
}

// Turns the eye slowly about its target while the user makes no input.
export class Turntable {
  // `isHeld()` returns whether a key or a pointer is down.
  constructor(player, isHeld) {
    Object.assign(this, { player, isHeld });
    this.on = false;
    this.resumesAt = 0; // the time in ms at which the turn resumes
  }

  get active() {
    return this.on && !this.isHeld() && performance.now() >= this.resumesAt;
  }

  turn(on) {
    this.on = on;
    this.resumesAt = 0;
    this.player.changed();
  }

  // Pauses the turn after an input.
  pause() {
    if (!this.on) return;
    this.resumesAt = performance.now() + TURN_RESUME_MS;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.player.changed(), TURN_RESUME_MS + 1);
  }

  dispose() {
    clearTimeout(this.timer);
  }

  advance(seconds) {
    if (!this.active) return false;
    this.player.eye.orbit(TURN_RADIANS_PER_SECOND * seconds, 0);
    return true;
  }
}
