// Shows the player's page for a <hyrf-viewer frame> in an iframe. `player` is the address of that page, by default
// index.html in the folder of the script hyrf-viewer.js. `src`, `poster` and `player` are relative to the page of
// the element.

import { addressBesideScript } from "./script_address.js";

export const FRAME_ATTRIBUTES = [
  "src", "camera", "poster", "title", "exposure", "autorotate", "noui", "player", "loading",
];
const ANSWER_MS = 3000; // a player answers long before its page has loaded
const FIX_TEXT = 'set its attribute player to the address of the player, such as player="player/index.html".';

const withoutHash = (address) => address.split("#")[0];

export class FrameView {
  constructor(element) {
    this.element = element;
    this.frame = null;
    this.address = "";
    this.isMoved = false;
    this.isLoadFailed = false; // whether the player's last message was an error, or there was none
    this.attributeErrors = new Set(); // the messages about attributes at the last update
    this.receiveMessage = this.receiveMessage.bind(this);
    addEventListener("message", this.receiveMessage);
  }

  dispose() {
    removeEventListener("message", this.receiveMessage);
    this.removeFrame();
  }

  // Follows the element's attributes.
  update() {
    const { element } = this, player = element.getAttribute("player") || addressBesideScript("index.html");
    const reported = this.attributeErrors;
    this.attributeErrors = new Set();
    const report = (message) => {
      this.attributeErrors.add(message);
      if (!reported.has(message)) this.fail(message); // changes of other attributes do not repeat it
    };
    let address;
    try {
      address = new URL(player ?? "", player ? document.baseURI : undefined);
    } catch {
      return report(`hyrf-viewer does not know where its player is; ${FIX_TEXT}`);
    }
    for (const [name, parameter] of [["src", "content"], ["poster", "poster"]]) {
      const value = element.getAttribute(name);
      if (!value) continue;
      try {
        address.searchParams.set(parameter, new URL(value, document.baseURI));
      } catch {
        report(`${name} is no address of a file: ${value}`);
        if (name === "src") return this.removeFrame(); // without its parameter, the player would show its own scene
      }
    }
    if (element.title) address.searchParams.set("title", element.title);
    if (element.hasAttribute("exposure")) address.searchParams.set("exposure", element.getAttribute("exposure"));
    for (const name of ["autorotate", "noui"]) {
      if (element.hasAttribute(name)) address.searchParams.set(name, "");
    }
    if (element.hasAttribute("camera")) address.hash = `camera=${element.getAttribute("camera")}`;
    this.show(address);
    this.frame.loading = this.loading;
    this.frame.title = element.title || "3D scene";
  }

  get loading() {
    return this.element.getAttribute("loading") ?? "eager";
  }

  // Shows an address. A new camera changes only what follows "#", so the frame is not reloaded. It replaces the last
  // one, and another scene is shown in a new frame, because a new `src` would add an entry to the browser's history.
  // Before the frame is loaded, a new `src` adds none, and a lazy frame goes on waiting.
  show({ href, hash }) {
    const before = this.address;
    if (href === before) return;
    if (hash && withoutHash(href) === withoutHash(before)) {
      this.address = href;
      if (this.isLoaded) this.replaceAddress();
      else this.frame.src = href;
      return;
    }
    this.removeFrame();
    this.address = href;
    this.isAnswered = this.isLoaded = this.isLoadFailed = false;
    this.frame = document.createElement("iframe");
    this.frame.allow = "fullscreen; clipboard-write; web-share";
    this.frame.loading = this.loading; // before it has an address
    this.frame.src = href;
    this.frame.onload = () => {
      this.isLoaded = true;
      if (this.isMoved && this.frame.src !== this.address) this.replaceAddress(); // with that of the newest camera
      this.isMoved = false;
      if (!this.isAnswered) this.timer = setTimeout(() => this.refuse(), ANSWER_MS);
    };
    this.element.shadowRoot.append(this.frame);
  }

  // An element that is moved in its page keeps its view, but its frame loads again.
  reconnect() {
    this.isMoved = true;
  }

  replaceAddress() {
    this.frame.contentWindow.location.replace(this.address);
  }

  removeFrame() {
    clearTimeout(this.timer);
    this.frame?.remove();
    this.frame = null;
    this.address = "";
  }

  // Reports that the frame has no player.
  refuse() {
    this.isLoadFailed = true;
    const address = this.address.split(/[?#]/)[0];
    this.fail(`${address} is no player, or is not allowed to run here; ${FIX_TEXT}`);
  }

  // Makes the next update load the scene again if its load has failed, and report again what is wrong with attributes
  // if there is no scene to load.
  forgetFailedLoad() {
    if (!this.frame) this.attributeErrors.clear();
    if (this.isLoadFailed) this.removeFrame();
  }

  // Passes on the events of the player in the frame.
  receiveMessage({ source, data }) {
    if (source !== this.frame?.contentWindow || !data?.hyrf) return;
    this.isAnswered = true;
    clearTimeout(this.timer);
    if (!["load", "error"].includes(data.hyrf)) return;
    this.isLoadFailed = data.hyrf === "error";
    this.element.fireEvent(data.hyrf, String(data.message ?? ""));
  }

  fail(message) {
    this.element.fireEvent("error", message);
  }
}
