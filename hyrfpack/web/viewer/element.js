// Defines <hyrf-viewer src="scene.hyrf" camera="2" poster="scene.jpg" exposure="consistent" autorotate noui>, which
// shows in a frame the player from the folder of this script. `src` and `poster` are relative to the page of the
// element. It fires the events "load" and "error" (detail: a sentence for the user).

const PLAYER_URL = new URL("index.html", document.currentScript?.src ?? findScriptAddress());
const ELEMENT_CSS = ":host { display: block; aspect-ratio: 4 / 3; } :host([hidden]) { display: none; } " +
  "iframe { display: block; width: 100%; height: 100%; border: 0; }";

// Finds this script's address among the page's scripts, because modules have no document.currentScript.
function findScriptAddress() {
  const scripts = [...document.querySelectorAll("script[src]")].map(({ src }) => src);
  return scripts.find((address) => new URL(address).pathname.endsWith("/hyrf-viewer.js")) ?? document.baseURI;
}

class HyrfViewer extends HTMLElement {
  static observedAttributes = ["src", "camera", "poster", "title", "exposure", "autorotate", "noui"];

  constructor() {
    super();
    const style = new CSSStyleSheet(); // unlike style elements, no page's security policy forbids it
    style.replaceSync(ELEMENT_CSS);
    this.frame = document.createElement("iframe");
    this.frame.allow = "fullscreen; clipboard-write";
    this.frame.sandbox = "allow-scripts allow-same-origin allow-downloads";
    const root = this.attachShadow({ mode: "open" });
    root.adoptedStyleSheets = [style];
    root.append(this.frame);
    this.hear = this.hear.bind(this);
  }

  connectedCallback() {
    addEventListener("message", this.hear);
    this.follow();
  }

  disconnectedCallback() {
    removeEventListener("message", this.hear);
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
    const address = new URL(PLAYER_URL);
    for (const [name, parameter] of [["src", "content"], ["poster", "poster"]]) {
      const value = this.getAttribute(name);
      if (!value) continue;
      try {
        address.searchParams.set(parameter, new URL(value, document.baseURI));
      } catch {
        this.tell("error", `${name} is no address of a file: ${value}`);
      }
    }
    if (this.title) address.searchParams.set("title", this.title);
    if (this.hasAttribute("exposure")) address.searchParams.set("exposure", this.getAttribute("exposure"));
    for (const name of ["autorotate", "noui"]) {
      if (this.hasAttribute(name)) address.searchParams.set(name, "");
    }
    if (this.hasAttribute("camera")) address.hash = `camera=${this.getAttribute("camera")}`;
    this.frame.title = this.title || "3D scene";
    if (this.frame.src !== address.href) this.frame.src = address;
  }

  // Passes on the events of the player in the frame.
  hear({ source, data }) {
    if (source !== this.frame.contentWindow || !["load", "error"].includes(data?.hyrf)) return;
    this.tell(data.hyrf, String(data.message ?? ""));
  }

  tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}

if (!customElements.get("hyrf-viewer")) customElements.define("hyrf-viewer", HyrfViewer);
