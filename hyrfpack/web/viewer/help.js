// Shows help for the input devices in use (mouse, touch, keys), and a hint on the first visit.

import { element } from "./dom.js";

const HINT_SEEN_KEY = "hyrfpack.hinted";
const HINTS = { touch: "One finger turns, two move and zoom", mouse: "Drag to turn, wheel to zoom, ? for help" };

// Returns whether the hint was seen before. Browsers may forbid access to the storage, for example in frames.
const wasHintSeen = () => {
  try {
    return localStorage.getItem(HINT_SEEN_KEY) !== null;
  } catch {
    return false;
  }
};

const markHintSeen = () => {
  try {
    localStorage.setItem(HINT_SEEN_KEY, "1");
  } catch {
    // without storage, the next visit shows the hint again
  }
};

export class Help {
  constructor() {
    const coarse = matchMedia("(pointer: coarse)").matches;
    this.used = new Set(coarse ? ["touch"] : ["mouse", "keys"]);
    const usePointer = ({ pointerType }) => this.used.add(pointerType === "mouse" ? "mouse" : "touch");
    addEventListener("pointerdown", usePointer, true);
    addEventListener("keydown", () => this.used.add("keys"), true);
    this.hint = element("hint");
    this.hint.textContent = HINTS[coarse ? "touch" : "mouse"];
  }

  // Opens the help, with the sections for the input devices that were used.
  show() {
    for (const part of document.querySelectorAll("#help [data-with]")) part.hidden = !this.used.has(part.dataset.with);
    element("help").showModal();
  }

  // Shows the hint on the first visit.
  greet() {
    this.hint.hidden = this.hint.classList.contains("gone") || wasHintSeen();
  }

  // Hides the hint after the first input.
  acted() {
    if (this.hint.hidden || this.hint.classList.contains("gone")) return;
    this.hint.classList.add("gone");
    setTimeout(() => (this.hint.hidden = true), 500);
    markHintSeen();
  }
}
