"""Frames of native pages while the view moves, and when it comes to rest."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from web.native_models import (
    load_page,
    make_model_page,
    random_model,
    read_typed_array,
    render_reference,
    run_statements,
    wait_until_complete,
)
from web.pages import Browser, psnr

from hyrfpack.cameras.files import camera_from_json


@pytest.mark.in_turn
def test_a_still_window_requests_no_frames(browser: Browser, tmp_path: Path):
    load_page(browser, tmp_path, make_model_page(random_model()))
    frames = browser.evaluate("hyrfpack.frames()")
    run_statements(browser, "window.requests = 0; const request = requestAnimationFrame;"
                 "window.requestAnimationFrame = (frame) => (window.requests++, request(frame));")  # fmt: skip
    time.sleep(0.5)
    assert browser.evaluate("hyrfpack.frames()") == frames and browser.evaluate("window.requests") == 0


@pytest.mark.in_turn
def test_colors_are_complete_for_the_view_after_a_drag(browser: Browser, tmp_path: Path):
    model = random_model()
    load_page(browser, tmp_path, make_model_page(model))
    browser.drag((120, 90), (200, 110), steps=8)
    wait_until_complete(browser)
    rows = "hyrfpack.player.renderer.content.rows"
    turned = browser.evaluate(
        f"Array.from({{length: {rows}.count}}, (_, r) => Math.hypot(...[0, 1, 2].map("
        f"(k) => {rows}.eyes[3 * r + k] - hyrfpack.player.view().eye[k])))"
    )
    assert max(turned) < 0.05


def draw_moving_frame(browser: Browser, scale: float) -> np.ndarray:
    """Draw a frame of the page's view at `scale` times its resolution; return the rows of its picture (H, W, 3)."""
    script = f"""(() => {{
        const {{ player }} = hyrfpack, {{ renderer }} = player, {{ gl }} = renderer;
        renderer.draw(player.view(), {scale}, {{}});
        const {{ target, size: [width, height] }} = renderer.frame, rgba = new Uint8Array(4 * width * height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, target);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
        return rgba;
    }})()"""
    width = browser.evaluate(f"Math.round(hyrfpack.player.canvas.width * {scale})")
    return read_typed_array(browser, script, np.uint8).reshape(-1, width, 4)[..., :3]


@pytest.mark.parametrize("is_antialiased", [False, True])
def test_a_frame_at_half_the_resolution_is_near_the_reduced_render(
    browser: Browser, tmp_path: Path, is_antialiased: bool
):
    model = random_model(3000, background=False, antialiased=is_antialiased)
    model.gaussians.scale_logits.data -= 1
    model.gaussians.opacity_logits.data += 2
    load_page(browser, tmp_path, make_model_page(model))
    browser.evaluate("hyrfpack.player.pause()")
    camera = camera_from_json(browser.evaluate("hyrfpack.camera()"))
    height, width = camera.height // 2, camera.width // 2
    exact = render_reference(model, camera)[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3).mean((1, 3))
    drawn = draw_moving_frame(browser, 0.5).astype(float)
    assert drawn.shape[:2] == (2 * height, width)
    assert psnr(drawn.reshape(height, 2, width, 3).mean(1), exact) > 40


@pytest.mark.in_turn
def test_a_moving_view_has_its_own_background_where_that_is_quick(browser: Browser, tmp_path: Path):
    model = random_model(30)
    load_page(browser, tmp_path, make_model_page(model))
    run_statements(
        browser, "const { player } = hyrfpack; window.content = player.renderer.content; player.pause();"
                 "player.eye.orbit(0.4, 0.1); window.view = player.view();"
    )  # fmt: skip
    for unit_ms, follows in (("null", False), ("1e4", False), ("1e-4", True)):
        run_statements(browser, f"content.panorama.pace.unit = {unit_ms}; content.recolor(view, 0.3, 8, true);")
        assert browser.evaluate("content.sky.of(view) !== null") == follows
    camera = camera_from_json(browser.evaluate("hyrfpack.camera()"))
    assert psnr(draw_moving_frame(browser, 1).astype(float), render_reference(model, camera)) > 45
