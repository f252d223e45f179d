// Moves the eye of a player: by mouse, touch and keys, between cameras, and by a slow turn.

import { Controls } from "./controls.js";
import { Damper, Glide, Turntable } from "./motion.js";

const APPROACH_FACTOR = 0.5; // of the distance to a place that was tapped twice

export class Navigation {
  // `keyTarget`, `isEmbedded`, `press` and `ignored` are those of Controls; without `keyTarget` there are no controls.
  // `acted()` is called after any input, and `picked(x, y)` when a place of the canvas, in CSS pixels, becomes the
  // centre of orbits.
  constructor(player, { keyTarget, isEmbedded, press, ignored, acted = () => {}, picked = () => {} }) {
    Object.assign(this, { player, picked });
    this.damper = new Damper(player);
    this.glide = new Glide(player);
    this.turntable = new Turntable(player, () => this.controls?.active);
    player.movers.push(this.damper, this.glide, this.turntable);
    this.controls = null;
    if (!keyTarget) return;
    const approach = (x, y) => this.approach(x, y);
    const stopOthers = () => {
      this.glide.stop();
      this.turntable.pause();
      acted();
      player.schedule();
    };
    const callbacks = { acted: stopOthers, approach, press, ignored };
    this.controls = new Controls(player, this.damper, { keyTarget, isEmbedded, ...callbacks });
    player.movers.unshift(this.controls);
  }

  dispose() {
    this.controls?.dispose();
    this.turntable.dispose();
  }

  // Ends all movements.
  stop() {
    for (const mover of [this.damper, this.glide]) mover.stop();
  }

  // Glides to one of the scene's cameras.
  choose(number) {
    if (this.player.scene && number < this.player.cameras.length) this.glide.to(() => this.player.choose(number));
  }

  // Moves the eye to a camera as parseCamera describes it: {number}, or {view, depth}. Takes the time of a glide if
  // `seconds` is undefined.
  moveTo({ number, view, depth }, seconds) {
    this.stop();
    this.glide.to(() => {
      if (number !== undefined) return this.player.choose(number);
      this.player.eye.setView(view);
      if (depth) this.player.eye.target = this.player.eye.point(0, 0, depth);
      this.player.changed();
    }, seconds);
  }

  // Makes the visible point at a position of the canvas the centre of orbits. Returns whether there is a point.
  pick(x, y) {
    const isHit = this.player.pick(x, y);
    if (isHit) this.picked(x, y);
    return isHit;
  }

  // Moves nearer to the visible point at a position of the canvas.
  approach(x, y) {
    if (!this.pick(x, y)) return;
    this.glide.to(() => {
      this.player.eye.approach(this.player.eye.target, APPROACH_FACTOR);
      this.player.changed();
    });
  }
}
