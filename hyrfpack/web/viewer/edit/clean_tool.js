// Removes faint and large Gaussians, by two sliders.

import { element } from "../dom.js";
import { dropAction, findActive, putAction } from "./actions.js";

const MAX_REMOVED_OPACITY = 0.5; // the opacity grows with the square of the slider's position
const LENGTH_SLIDER_DECADES = 2.5; // the slider goes from the scene's size down to 10^-2.5 of it

// Slider positions are 0 to 1. Values are numbers of the command, with few digits.
const SLIDERS = {
  faint: {
    option: "min-opacity",
    valueOf: (position) => Number((MAX_REMOVED_OPACITY * position ** 2).toPrecision(2)),
    positionOf: (value) => Math.sqrt(value / MAX_REMOVED_OPACITY),
    textOf: (value) => `opacity < ${value}`,
  },
  large: {
    option: "max-scale",
    valueOf: (position, size) => Number((size * 10 ** (-LENGTH_SLIDER_DECADES * position)).toPrecision(2)),
    positionOf: (value, size) => -Math.log10(value / size) / LENGTH_SLIDER_DECADES,
    textOf: (value) => `longer than ${value}`,
  },
};

export class CleanTool {
  constructor(editor) {
    this.editor = editor;
    for (const name of Object.keys(SLIDERS)) {
      const slider = element(`edit-${name}`);
      slider.oninput = () => this.slide(name, slider.value / 100, false);
      slider.onchange = () => this.slide(name, slider.value / 100, true);
    }
  }

  slide(name, position, isFinal) {
    const { editor } = this, { option, valueOf } = SLIDERS[name];
    const action = { option, value: valueOf(position, editor.size) };
    editor.set(position ? putAction(editor.actions, action) : dropAction(editor.actions, option), isFinal);
  }

  refresh() {
    const { actions, size } = this.editor;
    for (const [name, { option, valueOf, positionOf, textOf }] of Object.entries(SLIDERS)) {
      const slider = element(`edit-${name}`), active = actions[findActive(actions, option)];
      if (!active) slider.value = 0;
      else if (valueOf(slider.value / 100, size) !== active.value) { // else its position may be finer than the value
        slider.value = Math.max(1, Math.round(100 * positionOf(active.value, size)));
      }
      const text = active ? textOf(active.value) : "none";
      slider.nextElementSibling.textContent = text;
      slider.setAttribute("aria-valuetext", text);
    }
  }
}
