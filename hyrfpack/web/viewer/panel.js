// Shows the panel with the scene's name, its cameras and the settings.

import { AS_PHOTOGRAPHED } from "./exposure.js";
import { element } from "./dom.js";

const SMALL_SCREEN_QUERY = "(max-width: 640px), (max-height: 480px)"; // the open panel would cover the scene
const COUNT_TEXTS = { hyrf: (count) => `hybrid field, ${count} Gaussians`, splats: (count) => `${count} splats` };

export class Panel {
  // `actions` has a function for each key that does not move the eye. Buttons call the same functions.
  constructor(player, actions) {
    Object.assign(this, { player, actions });
    for (const button of document.querySelectorAll("[data-key]")) button.onclick = () => this.press(button.dataset.key);
    element("cameras").onchange = ({ target }) => actions.choose(target.selectedIndex);
    element("fullscreen").hidden = !document.fullscreenEnabled;
    if (matchMedia(SMALL_SCREEN_QUERY).matches) this.toggle();
    element("automatic").onchange = ({ target }) => {
      player.automatic = target.checked;
      player.redraw();
    };
    element("resolution").oninput = ({ target }) => {
      element("percent").textContent = `${target.value} %`;
      player.resolution = target.value / 100;
      player.redraw();
    };
    player.addEventListener("frame", ({ detail }) => {
      element("speed").textContent = `${Math.round(1000 / detail)} fps`;
    });
    player.addEventListener("exposure", () => this.showExposure());
    player.addEventListener("camera", ({ detail }) => (element("cameras").selectedIndex = detail));
  }

  // Shows the scene's name and its number of Gaussians.
  setTitle({ kind, count }, title) {
    element("title").textContent = element("title").title = document.title = title;
    element("count").textContent = COUNT_TEXTS[kind](count.toLocaleString("en"));
    element("view").setAttribute("aria-label", `${title}, a 3D scene`);
  }

  // Shows the scene's name, its number of Gaussians and its cameras.
  describe({ kind, count, cameras }, title) {
    this.setTitle({ kind, count }, title);
    const options = cameras.map((_, number) => new Option(`Camera ${number + 1} of ${cameras.length}`));
    element("cameras").replaceChildren(...options);
    for (const name of ["previous", "next", "cameras"]) element(name).disabled = cameras.length < 2;
  }

  // Shows the exposure's button and its state if the scene has an exposure map.
  showExposure() {
    const { hasExposureMap, exposure } = this.player;
    for (const part of document.querySelectorAll("[data-needs-map]")) part.hidden = !hasExposureMap;
    element("exposure").setAttribute("aria-pressed", String(exposure === AS_PHOTOGRAPHED));
  }

  // Performs the action of a key.
  press(key) {
    if (/^[1-9]$/.test(key)) this.actions.choose(Number(key) - 1);
    else this.actions[key]?.();
  }

  toggle() {
    const panel = element("panel");
    panel.hidden = !panel.hidden;
    element("toggle").setAttribute("aria-expanded", String(!panel.hidden));
  }
}
