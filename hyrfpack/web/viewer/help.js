// Help for what a person has at hand: mouse, fingers or keys; and a first hint.

import { element } from "./parts.js";

const SEEN = "hyrfpack.hinted";
const HINTS = { touch: "One finger turns, two move and zoom", mouse: "Drag to turn, wheel to zoom, ? for help" };

// Storage may be forbidden, as in frames.
const remembered = () => {
  try {
    return localStorage.getItem(SEEN) !== null;
  } catch {
    return false;
  }
};

const remember = () => {
  try {
    localStorage.setItem(SEEN, "1");
  } catch {
    // then it is shown again
  }
};

export class Help {
  constructor() {
    const coarse = matchMedia("(pointer: coarse)").matches;
    this.used = new Set(coarse ? ["touch"] : ["mouse", "keys"]);
    addEventListener("pointerdown", ({ pointerType }) => this.used.add(pointerType === "mouse" ? "mouse" : "touch"), true);
    addEventListener("keydown", () => this.used.add("keys"), true);
    this.hint = element("hint");
    this.hint.textContent = HINTS[coarse ? "touch" : "mouse"];
  }

  show() {
    for (const part of document.querySelectorAll("#help [data-with]")) part.hidden = !this.used.has(part.dataset.with);
    element("help").showModal();
  }

  // To whom has not been here.
  greet() {
    this.hint.hidden = this.hint.classList.contains("gone") || remembered();
  }

  // The person has found out.
  acted() {
    if (this.hint.hidden || this.hint.classList.contains("gone")) return;
    this.hint.classList.add("gone");
    setTimeout(() => (this.hint.hidden = true), 500);
    remember();
  }
}
