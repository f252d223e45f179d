// Shows the player's page for a <hyrf-viewer frame> in an iframe. `player` is the address of that page, by default
// index.html in the folder of the script hyrf-viewer.js. `src`, `poster` and `player` are relative to the page of
// the element.

import { addressBesideScript } from "./script_address.js";

export const FRAME_ATTRIBUTES = ["src", "camera", "poster", "title", "exposure", "autorotate", "noui", "player"];
const ANSWER_MS = 3000; // a player answers long before its page has loaded
const FIX_TEXT = 'set its attribute player to the address of the player, such as player="player/index.html".';

export class FrameView {
  constructor(element) {
    this.element = element;
    this.frame = document.createElement("iframe");
    this.frame.allow = "fullscreen; clipboard-write; web-share";
    this.frame.onload = () => {
      if (!this.isAnswered) this.timer = setTimeout(() => this.fail(this.noPlayerText()), ANSWER_MS);
    };
    this.receiveMessage = this.receiveMessage.bind(this);
    addEventListener("message", this.receiveMessage);
  }

  dispose() {
    removeEventListener("message", this.receiveMessage);
    clearTimeout(this.timer);
    this.frame.remove();
  }

  // Follows the element's attributes. A new camera changes only what follows "#", so that the frame is not reloaded.
  update() {
    const { element } = this, player = element.getAttribute("player") || addressBesideScript("index.html");
    let address;
    try {
      address = new URL(player ?? "", player ? document.baseURI : undefined);
    } catch {
      return this.fail(`hyrf-viewer does not know where its player is; ${FIX_TEXT}`);
    }
    for (const [name, parameter] of [["src", "content"], ["poster", "poster"]]) {
      const value = element.getAttribute(name);
      if (!value) continue;
      try {
        address.searchParams.set(parameter, new URL(value, document.baseURI));
      } catch {
        this.fail(`${name} is no address of a file: ${value}`);
      }
    }
    if (element.title) address.searchParams.set("title", element.title);
    if (element.hasAttribute("exposure")) address.searchParams.set("exposure", element.getAttribute("exposure"));
    for (const name of ["autorotate", "noui"]) {
      if (element.hasAttribute(name)) address.searchParams.set(name, "");
    }
    if (element.hasAttribute("camera")) address.hash = `camera=${element.getAttribute("camera")}`;
    this.frame.title = element.title || "3D scene";
    if (this.frame.src === address.href) return;
    if (this.frame.src.split("#")[0] !== address.href.split("#")[0]) {
      this.isAnswered = false;
      clearTimeout(this.timer);
    }
    this.frame.src = address;
    // Added only now, so that no empty page loads before, and only once, because moving a frame reloads it.
    if (!this.frame.isConnected) element.shadowRoot.append(this.frame);
  }

  noPlayerText() {
    const address = this.frame.src.split(/[?#]/)[0];
    return `${address} is no player, or is not allowed to run here; ${FIX_TEXT}`;
  }

  // Passes on the events of the player in the frame.
  receiveMessage({ source, data }) {
    if (source !== this.frame.contentWindow || !data?.hyrf) return;
    this.isAnswered = true;
    clearTimeout(this.timer);
    if (["load", "error"].includes(data.hyrf)) this.element.fireEvent(data.hyrf, String(data.message ?? ""));
  }

  fail(message) {
    this.element.fireEvent("error", message);
  }
}
