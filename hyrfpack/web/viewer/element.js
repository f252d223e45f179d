// Defines <hyrf-viewer src="scene.hyrf" camera="2" poster="scene.jpg" exposure="consistent" autorotate noui
// player="player/index.html">, which shows the player in a frame. `player` is by default index.html in the folder of
// this script, which is unknown where the script is part of a bundle. `src`, `poster` and `player` are relative to the
// page of the element. It fires the events "load" and "error" (detail: a sentence for the user).

const SCRIPT_URL = document.currentScript?.src || findScriptAddress();
const ANSWER_MS = 3000; // a player answers long before its page has loaded
const FIX_TEXT = 'set its attribute player to the address of the player, such as player="player/index.html".';
const ELEMENT_CSS = ":host { display: block; aspect-ratio: 4 / 3; } :host([hidden]) { display: none; } " +
  "iframe { display: block; width: 100%; height: 100%; border: 0; }";

// Finds this script's address among the page's scripts, because modules have no document.currentScript. Returns
// undefined if it is not there.
function findScriptAddress() {
  const scripts = [...document.querySelectorAll("script[src]")].map(({ src }) => src);
  return scripts.find((address) => new URL(address).pathname.endsWith("/hyrf-viewer.js"));
}

class HyrfViewer extends HTMLElement {
  static observedAttributes = ["src", "camera", "poster", "title", "exposure", "autorotate", "noui", "player"];

  constructor() {
    super();
    const style = new CSSStyleSheet(); // unlike style elements, no page's security policy forbids it
    style.replaceSync(ELEMENT_CSS);
    this.frame = document.createElement("iframe");
    this.frame.allow = "fullscreen; clipboard-write; web-share";
    this.frame.onload = () => {
      if (!this.isAnswered) this.timer = setTimeout(() => this.fireEvent("error", this.noPlayerText()), ANSWER_MS);
    };
    const root = this.attachShadow({ mode: "open" });
    root.adoptedStyleSheets = [style];
    this.receiveMessage = this.receiveMessage.bind(this);
  }

  connectedCallback() {
    addEventListener("message", this.receiveMessage);
    this.follow();
  }

  disconnectedCallback() {
    removeEventListener("message", this.receiveMessage);
    clearTimeout(this.timer);
  }

  attributeChangedCallback() {
    if (this.isConnected) this.follow();
  }

  // Updates the frame's address, once for all attributes that change together. A new camera changes only what follows
  // "#", so that the frame is not reloaded.
  async follow() {
    if (this.following) return;
    this.following = true;
    await null;
    this.following = false;
    const player = this.getAttribute("player");
    let address;
    try {
      address = player ? new URL(player, document.baseURI) : new URL("index.html", SCRIPT_URL);
    } catch {
      return this.fireEvent("error", `hyrf-viewer does not know where its player is; ${FIX_TEXT}`);
    }
    for (const [name, parameter] of [["src", "content"], ["poster", "poster"]]) {
      const value = this.getAttribute(name);
      if (!value) continue;
      try {
        address.searchParams.set(parameter, new URL(value, document.baseURI));
      } catch {
        this.fireEvent("error", `${name} is no address of a file: ${value}`);
      }
    }
    if (this.title) address.searchParams.set("title", this.title);
    if (this.hasAttribute("exposure")) address.searchParams.set("exposure", this.getAttribute("exposure"));
    for (const name of ["autorotate", "noui"]) {
      if (this.hasAttribute(name)) address.searchParams.set(name, "");
    }
    if (this.hasAttribute("camera")) address.hash = `camera=${this.getAttribute("camera")}`;
    this.frame.title = this.title || "3D scene";
    if (this.frame.src === address.href) return;
    if (this.frame.src.split("#")[0] !== address.href.split("#")[0]) {
      this.isAnswered = false;
      clearTimeout(this.timer);
    }
    this.frame.src = address;
    // Added only now, so that no empty page loads before, and only once, because moving a frame reloads it.
    if (!this.frame.isConnected) this.shadowRoot.append(this.frame);
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
    if (["load", "error"].includes(data.hyrf)) this.fireEvent(data.hyrf, String(data.message ?? ""));
  }

  fireEvent(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}

if (!customElements.get("hyrf-viewer")) customElements.define("hyrf-viewer", HyrfViewer);
