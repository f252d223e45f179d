// Shows progress, errors and confirmations at the lower edge of the page.

import { element } from "./dom.js";

const TOAST_MS = 4000;
let toastTimer = 0;

// Shows the sentence of an error until it is dismissed. One without a sentence, such as a question to a loader whose
// scene was replaced meanwhile, is not for the user.
export function fail({ message }) {
  if (!message) return;
  element("loading").hidden = true;
  element("sentence").textContent = message;
  element("message").hidden = false;
}

// Hides the error and the confirmation.
export function dismiss() {
  element("message").hidden = true;
  element("toast").hidden = true;
}

// Shows a confirmation, which screen readers read, for TOAST_MS. With an address to copy, it stays until dismissed.
export function toast(sentence, address = "") {
  const link = element("link");
  element("toast").hidden = false; // before the text changes, so that screen readers notice the change
  element("done").textContent = sentence;
  link.hidden = !address;
  link.value = address;
  clearTimeout(toastTimer);
  if (address) link.select();
  else toastTimer = setTimeout(() => (element("toast").hidden = true), TOAST_MS);
}

// Announces a sentence to screen readers.
export function announce(sentence) {
  element("status").textContent = sentence;
}

// Shows a permanent remark about the scene; "" hides it.
export function remark(sentence) {
  element("remark").hidden = !sentence;
  element("remark").textContent = sentence;
}

// Shows the fraction `part` of the loading.
export function progress(part) {
  element("loading").hidden = false;
  element("bar").value = part;
  element("step").textContent = `Loading ${Math.floor(100 * part)} %`;
  const quarter = `Loading, ${25 * Math.floor(4 * part)} percent`;
  if (element("status").textContent !== quarter) announce(quarter);
}
