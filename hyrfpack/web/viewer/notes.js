// What a person is told: progress, what goes wrong, what was done. All of it stands at the lower edge, one above the
// other.

import { element } from "./parts.js";

const SHORT = 4000; // ms that a note of what was done stays
const WORDS = { loading: "Loading", unpacking: "Unpacking", preparing: "Preparing" };
let ends = 0;

// A sentence about what went wrong; it stays until it is dismissed.
export function fail({ message }) {
  element("loading").hidden = true;
  element("sentence").textContent = message;
  element("message").hidden = false;
}

export function dismiss() {
  element("message").hidden = true;
  element("toast").hidden = true;
}

// What was done, for a while; also to those who hear the page. With an address to be copied it stays.
export function toast(sentence, address = "") {
  const link = element("link");
  element("toast").hidden = false; // first, so that it is heard
  element("done").textContent = sentence;
  link.hidden = !address;
  link.value = address;
  clearTimeout(ends);
  if (address) link.select();
  else ends = setTimeout(() => (element("toast").hidden = true), SHORT);
}

// Only to those who hear the page.
export function announce(sentence) {
  element("status").textContent = sentence;
}

// Something lasting about the scene, "" for nothing.
export function remark(sentence) {
  element("remark").hidden = !sentence;
  element("remark").textContent = sentence;
}

export function progress({ what, part }) {
  element("loading").hidden = false;
  element("bar").value = part;
  element("step").textContent = `${WORDS[what]} ${Math.floor(100 * part)} %`;
  const quarter = `${WORDS[what]}, ${25 * Math.floor(4 * part)} percent`;
  if (element("status").textContent !== quarter) announce(quarter);
}
