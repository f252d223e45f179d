// Shows the scene's title, the toolbar, the settings and the strip of cameras.

import { AS_PHOTOGRAPHED } from "./exposure.js";
import { element } from "./dom.js";
import { fail } from "./notifications.js";
import { Strip } from "./strip.js";

const LARGE_WINDOW_QUERY = "(min-width: 900px) and (min-height: 600px)"; // the strip of cameras covers little of it
const IDLE_MS = 4000; // after the last input, the toolbar of a small frame disappears
const COUNT_TEXTS = { hyrf: (count) => `hybrid field, ${count} Gaussians`, splats: (count) => `${count} splats` };

export class Panel {
  // `actions` has a function for each key that does not move the eye. Buttons call the same functions.
  constructor(player, actions) {
    Object.assign(this, { player, actions });
    this.strip = new Strip(player, actions.choose);
    for (const button of document.querySelectorAll("[data-key]")) button.onclick = () => this.press(button.dataset.key);
    element("fullscreen").hidden = !document.fullscreenEnabled;
    element("automatic").onchange = ({ target }) => {
      player.automatic = target.checked;
      player.redraw();
    };
    element("resolution").oninput = ({ target }) => {
      element("percent").textContent = `${target.value} %`;
      player.resolution = target.value / 100;
      player.redraw();
    };
    element("view").addEventListener("pointerdown", () => this.toggleSettings(false));
    for (const name of ["pointermove", "pointerdown", "keydown"]) addEventListener(name, () => this.wake(), true);
    player.addEventListener("frame", ({ detail }) => {
      element("speed").textContent = `${Math.round(1000 / detail)} fps`;
    });
    player.addEventListener("exposure", () => this.showExposure());
    player.addEventListener("streamed", () => this.showLoaded());
    this.wake();
  }

  // Shows the scene's name and its number of Gaussians.
  setTitle({ kind, count }, title) {
    element("title").textContent = element("title").title = document.title = title;
    element("count").textContent = COUNT_TEXTS[kind](count.toLocaleString("en"));
    element("view").setAttribute("aria-label", `${title}, a 3D scene`);
    this.showLoaded();
  }

  // Shows what is loaded of a scene folder.
  showLoaded() {
    const { streaming, loader, scene } = this.player, state = loader?.state;
    element("loaded").hidden = !state;
    if (!state) return;
    [element("count").textContent, element("loaded").textContent] = streaming.describeLoaded(state, scene.count);
  }

  // Shows the scene's name, its number of Gaussians and its cameras.
  describe({ kind, count, cameras }, title) {
    this.setTitle({ kind, count }, title);
    this.strip.describe(cameras.length);
    this.strip.toggle(cameras.length > 1 && matchMedia(LARGE_WINDOW_QUERY).matches);
  }

  // Shows the exposure's button and its state if the scene has an exposure map.
  showExposure() {
    const { hasExposureMap, exposure } = this.player;
    for (const part of document.querySelectorAll("[data-needs-map]")) part.hidden = !hasExposureMap;
    element("exposure").setAttribute("aria-pressed", exposure === AS_PHOTOGRAPHED);
  }

  // Performs the action of a key, and shows its error if it fails.
  press(key) {
    if (/^[1-9]$/.test(key)) this.actions.choose(Number(key) - 1);
    else this.actions[key]?.()?.catch?.(fail);
  }

  // Shows or hides the title, the toolbar and what belongs to it.
  toggle() {
    document.body.classList.toggle("plain");
  }

  toggleSettings(isOpen = element("settings").hidden) {
    element("settings").hidden = !isOpen;
    element("menu").setAttribute("aria-expanded", isOpen);
    this.wake();
  }

  // Shows the toolbar of a small frame until no input has come for IDLE_MS and the settings are closed.
  wake() {
    document.body.classList.remove("idle");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => document.body.classList.toggle("idle", element("settings").hidden), IDLE_MS);
  }
}
