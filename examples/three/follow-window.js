// Keeps a picture as large as the window.

/**
 * Calls a function at once, and whenever the window gets another size or another pixel ratio. On another screen, the
 * ratio may change while the size in CSS pixels stays the same.
 * @param {() => void} fit
 */
export function followWindow(fit) {
  const followRatio = () => {
    fit();
    matchMedia(`(resolution: ${devicePixelRatio}dppx)`).addEventListener("change", followRatio, { once: true });
  };
  addEventListener("resize", fit);
  followRatio();
}
