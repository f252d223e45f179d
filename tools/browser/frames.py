"""Access to the frames that the web player draws."""

from __future__ import annotations

_ON_FRAME_SCRIPT = """(() => {
  const observe = %s;
  const { renderer } = hyrfpack.player, draw = renderer.draw.bind(renderer);
  renderer.draw = (...values) => {
    draw(...values);
    const { gl, content, frame: { target, size: [width, height] } } = renderer;
    const rgba = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    observe(rgba);
    content.fadedAt = performance.now() - 1000; // so that the next step of a fade is the largest one
  };
})()"""


def frame_observer_script(observe: str) -> str:
    """Return a script after which the player passes each frame of a scene folder that it draws to a function.

    The steps of fades between levels of detail are as long as on a slow device.

    Args:
        observe: the function in JavaScript, which gets the RGBA bytes of a frame.
    """
    return _ON_FRAME_SCRIPT % observe
