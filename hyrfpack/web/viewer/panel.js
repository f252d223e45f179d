// The panel: what a person chooses and is told of the scene.

import { AS_PHOTOGRAPHED } from "./exposure.js";
import { element } from "./parts.js";

const SMALL = "(max-width: 640px), (max-height: 480px)"; // it would cover the scene
const KINDS = { hyrf: (count) => `hybrid field, ${count} Gaussians`, splats: (count) => `${count} splats` };

export class Panel {
  // `actions`: what the keys that do not move do; buttons do the same.
  constructor(player, actions) {
    Object.assign(this, { player, actions });
    for (const button of document.querySelectorAll("[data-key]")) button.onclick = () => this.press(button.dataset.key);
    element("cameras").onchange = ({ target }) => actions.choose(target.selectedIndex);
    element("fullscreen").hidden = !document.fullscreenEnabled;
    if (matchMedia(SMALL).matches) this.toggle();
    element("automatic").onchange = ({ target }) => {
      player.automatic = target.checked;
      player.redraw();
    };
    element("resolution").oninput = ({ target }) => {
      element("percent").textContent = `${target.value} %`;
      player.resolution = target.value / 100;
      player.redraw();
    };
    player.addEventListener("drawn", ({ detail }) => (element("speed").textContent = `${Math.round(1000 / detail)} fps`));
    player.addEventListener("exposed", () => this.showExposure());
    player.addEventListener("stood", ({ detail }) => (element("cameras").selectedIndex = detail));
  }

  // The scene's name and how much there is of it.
  entitle({ kind, count }, title) {
    element("title").textContent = element("title").title = document.title = title;
    element("count").textContent = KINDS[kind](count.toLocaleString("en"));
    element("view").setAttribute("aria-label", `${title}, a 3D scene`);
  }

  // These, and its cameras.
  describe({ kind, count, cameras }, title) {
    this.entitle({ kind, count }, title);
    const options = cameras.map((_, number) => new Option(`Camera ${number + 1} of ${cameras.length}`));
    element("cameras").replaceChildren(...options);
    for (const name of ["previous", "next", "cameras"]) element(name).disabled = cameras.length < 2;
  }

  // Offer the exposure where the scene has a map of it, and tell which one is chosen.
  showExposure() {
    const { hasExposureMap, exposure } = this.player;
    for (const part of document.querySelectorAll("[data-needs-map]")) part.hidden = !hasExposureMap;
    element("exposure").setAttribute("aria-pressed", String(exposure === AS_PHOTOGRAPHED));
  }

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
