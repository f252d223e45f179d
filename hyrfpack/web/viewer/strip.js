// Shows the scene's cameras as a strip of small pictures, which the player draws once it has nothing else to do.

import { element } from "./dom.js";
import { fail } from "./notifications.js";

const WIDTH_PIXELS = 96, HEIGHT_PIXELS = 72; // of a picture

export class Strip {
  // `choose(number)` is called with the index of the camera that the user chose.
  constructor(player, choose) {
    Object.assign(this, { player, choose, strip: element("strip"), drawn: null, drawing: null });
    player.addEventListener("camera", () => this.mark());
  }

  // Shows the cameras of the player's scene, without pictures at first.
  describe(count) {
    this.drawn = null;
    this.strip.replaceChildren(...Array.from({ length: count }, (_, number) => {
      const button = document.createElement("button");
      button.setAttribute("aria-label", `Camera ${number + 1} of ${count}`);
      button.textContent = number + 1;
      button.onclick = () => this.choose(number);
      return button;
    }));
    this.mark();
    element("views").hidden = count < 2;
    if (count < 2) this.toggle(false);
  }

  // Marks the camera to which the eye was moved last.
  mark() {
    [...this.strip.children].forEach((button, number) => {
      const isCurrent = number === this.player.camera;
      button.setAttribute("aria-pressed", isCurrent);
      if (isCurrent) this.strip.scrollLeft = button.offsetLeft - (this.strip.clientWidth - button.offsetWidth) / 2;
    });
  }

  toggle(isOpen = this.strip.hidden) {
    this.strip.hidden = !isOpen;
    element("views").setAttribute("aria-expanded", isOpen);
    this.mark();
    this.drawing ??= this.draw().catch(fail).finally(() => (this.drawing = null));
  }

  // Draws the pictures of the scene's cameras if they are visible and not drawn yet, while the eye stands still.
  async draw() {
    const { player, strip } = this;
    while (!strip.hidden && this.drawn !== player.cameras) {
      const { cameras } = player, isWanted = () => !strip.hidden && player.cameras === cameras;
      if (!(await player.settled.then(() => true, () => false))) return; // the scene cannot be shown
      const pictures = isWanted() && (await player.preview(cameras.map(coveringView)));
      if (!pictures || !isWanted()) continue;
      this.drawn = cameras;
      pictures.forEach((rgb, number) => strip.children[number].replaceChildren(pictureCanvas(rgb)));
    }
  }
}

// Returns the view for a picture of the strip, which shows as much of a camera's picture as covers it.
function coveringView(view) {
  const scale = Math.max(WIDTH_PIXELS / view.width, HEIGHT_PIXELS / view.height);
  return {
    ...view, width: WIDTH_PIXELS, height: HEIGHT_PIXELS, fx: scale * view.fx, fy: scale * view.fy,
    cx: WIDTH_PIXELS / 2 + scale * (view.cx - view.width / 2),
    cy: HEIGHT_PIXELS / 2 + scale * (view.cy - view.height / 2),
  };
}

// Returns a canvas with a picture of RGB bytes.
function pictureCanvas(rgb) {
  const canvas = Object.assign(document.createElement("canvas"), { width: WIDTH_PIXELS, height: HEIGHT_PIXELS });
  const image = new ImageData(WIDTH_PIXELS, HEIGHT_PIXELS);
  for (let k = 0; k < WIDTH_PIXELS * HEIGHT_PIXELS; k++) {
    image.data.set([rgb[3 * k], rgb[3 * k + 1], rgb[3 * k + 2], 255], 4 * k);
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}
