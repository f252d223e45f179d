// What moves the eye from frame to frame, see Player.movers: soft ends of movements, glides, and a slow turn.

import { dot, mul, sub } from "./camera.js";
import { quatOf, rowsOf, slerp } from "./rotation.js";

const DAMPING = 0.07; // s after which e^-1 of a movement is still to come
const REST = 1e-4; // radians and parts of the focal length: no one sees what is left
const GLIDE = 0.8; // s
const TURN = 0.25; // radians a second
const RESUME = 4000; // ms after a person's last act

const lessMotion = matchMedia("(prefers-reduced-motion: reduce)");
export const calm = () => lessMotion.matches;

// What a person asks for is done a little late and ends softly, but in the end exactly, however long the frames take.
export class Damper {
  constructor(player) {
    this.player = player;
    this.stop();
  }

  stop() {
    this.left = { yaw: 0, pitch: 0, x: 0, y: 0, depth: 0 };
    this.place = [0, 0]; // to which it is zoomed
  }

  // All as of Eye; of zooms the factor's logarithm.
  orbit(yaw, pitch) {
    this.more({ yaw, pitch });
  }

  pan(x, y) {
    this.more({ x, y });
  }

  zoom(depth, ...place) {
    this.place = place;
    this.more({ depth });
  }

  more(movement) {
    for (const [name, value] of Object.entries(movement)) this.left[name] += value;
    this.player.changed();
  }

  get active() {
    return Object.values(this.left).some(Boolean);
  }

  advance(seconds) {
    if (!this.active) return false;
    const { left } = this, { eye } = this.player;
    const last = calm() || Object.values(left).every((value) => Math.abs(value) < REST);
    const part = last ? 1 : 1 - Math.exp(-seconds / DAMPING);
    if (left.yaw || left.pitch) eye.orbit(part * left.yaw, part * left.pitch);
    if (left.depth) eye.zoom(Math.exp(part * left.depth), ...this.place);
    if (left.x || left.y) eye.pan(part * left.x, part * left.y);
    for (const name of Object.keys(left)) left[name] *= 1 - part;
    return true;
  }
}

// From where the eye is to where it shall be.
export class Glide {
  constructor(player) {
    this.player = player;
    this.stop();
  }

  get active() {
    return this.way !== null;
  }

  stop() {
    this.way = null;
  }

  // `move` sets the eye elsewhere, to where it then glides.
  to(move) {
    const { eye } = this.player, from = eye.pose;
    move();
    this.stop();
    if (calm()) return;
    const to = eye.pose;
    Object.assign(eye, from);
    this.way = { from: wayPoint(from), to: wayPoint(to), end: to, time: 0 };
    this.player.changed();
  }

  advance(seconds) {
    if (!this.way) return false;
    const { from, to, end } = this.way, { eye } = this.player;
    const time = (this.way.time += seconds) / GLIDE;
    if (time >= 1) {
      Object.assign(eye, end);
      this.stop();
      return true;
    }
    const part = time * time * (3 - 2 * time), mix = (a, b) => a + part * (b - a);
    const blend = (a, b) => a.map((value, k) => mix(value, b[k]));
    const rows = rowsOf(slerp(from.quat, to.quat, part));
    const away = mul(blend(from.away, to.away), Math.exp(mix(Math.log(from.distance), Math.log(to.distance))));
    const target = blend(from.target, to.target);
    const position = [0, 1, 2].reduce((sum, row) => sub(sum, mul(rows[row], away[row])), target);
    Object.assign(eye, { rows, target, position, focal: mix(from.focal, to.focal), pace: mix(from.pace, to.pace) });
    return true;
  }
}

// A pose by what can be blended: its target, how far and (in the eye's axes) in which direction that is.
function wayPoint({ position, rows, focal, pace, target }) {
  const away = sub(target, position), distance = Math.hypot(...away) || 1;
  return { quat: quatOf(rows), target, distance, away: rows.map((row) => dot(row, away) / distance), focal, pace };
}

// A slow turn about the target, while no one acts.
export class Turntable {
  constructor(player) {
    this.player = player;
    this.on = false;
    this.resumes = 0; // when
  }

  get active() {
    return this.on && performance.now() >= this.resumes;
  }

  turn(on) {
    this.on = on;
    this.resumes = 0;
    this.player.changed();
  }

  // A person acts.
  pause() {
    if (!this.on) return;
    this.resumes = performance.now() + RESUME;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.player.changed(), RESUME + 1);
  }

  advance(seconds) {
    if (!this.active) return false;
    this.player.eye.orbit(TURN * seconds, 0);
    return true;
  }
}
