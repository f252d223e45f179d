// Shows a picture of the scene until the scene is drawn. The picture lies where the first frame shows the same things,
// and a blurred copy of it fills the rest of the window.

// Keeps an <img> in the place where `frame`, the element that the scene is drawn in, shows the view of `camera` (in
// world units, see camera.js), as `Eye.view` scales it. Without a camera, the picture's middle is the principal point.
// Returns the observer of the frame's size.
export function keepPlaced(image, frame, camera = null) {
  const place = () => {
    const { naturalWidth, naturalHeight } = image, { clientWidth, clientHeight } = frame;
    if (!naturalWidth) return; // it is not loaded yet
    const { width, height, fx, fy, cx, cy } = camera ?? {
      width: naturalWidth, height: naturalHeight, fx: 1, fy: 1, cx: naturalWidth / 2, cy: naturalHeight / 2,
    };
    const down = Math.sqrt((clientWidth * clientHeight) / (width * height)), across = (down * fy) / fx;
    const box = {
      left: clientWidth / 2 - across * cx, top: clientHeight / 2 - down * cy,
      width: across * width, height: down * height,
    };
    for (const [name, value] of Object.entries(box)) image.style[name] = `${value}px`;
    image.classList.add("placed");
  };
  const observer = new ResizeObserver(place);
  observer.observe(frame);
  image.addEventListener("load", place);
  return observer;
}

export class Poster {
  // `image` is an <img> of the page. `frame` and `camera` are those of `keepPlaced`.
  constructor(image, frame, camera) {
    this.image = image;
    this.backdrop = Object.assign(new Image(), { id: "backdrop", alt: "", src: image.src });
    image.before(this.backdrop);
    this.observer = keepPlaced(image, frame, camera);
  }

  remove() {
    this.observer.disconnect();
    this.image.remove();
    this.backdrop.remove();
  }
}
