"""The first picture of a native page is an estimate, which exact values replace."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from web.native_models import (
    load_page,
    make_cameras,
    make_model_page,
    open_file_error,
    random_model,
    render_reference,
    run_statements,
    store_file_in_page,
    wait_until_complete,
)
from web.pages import Browser, camera_json, psnr, render_in_page, wait_for_message

from hyrfpack.format.codec import encode_model
from hyrfpack.format.parts import encode_parts
from hyrfpack.model import HybridModel

pytestmark = pytest.mark.in_turn

# Keeps the first frame that the canvas shows, and whether rows could be evaluated then.
RECORD_JS = """
  const { prototype } = WebGL2RenderingContext, { blitFramebuffer, shaderSource } = prototype;
  prototype.blitFramebuffer = function (...values) {
    blitFramebuffer.apply(this, values);
    window.firstPicture ??= { address: this.canvas.toDataURL(), isReady: hyrfpack.player.renderer.content.isReady };
  };
"""
REFUSE_JS = """
  window.refuses = true;
  prototype.shaderSource = function (shader, text) {
    shaderSource.call(this, shader, refuses && text.includes("u_half_extent") ? "refused" : text);
  };
"""


def make_smooth_model() -> HybridModel:
    """Return a model with more Gaussians than anchors, whose fields hardly vary between neighbours."""
    model = random_model(6000)
    with torch.no_grad():
        for field in (model.geometry, model.radiance):
            field.grid.table.mul_(0.1)
    return model


def read_canvas(address: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"), np.float64)


def test_the_first_picture_is_an_estimate_near_the_exact_one(browser: Browser, tmp_path: Path):
    model, camera = make_smooth_model(), make_cameras()[0]
    with browser.before_every_page(RECORD_JS):
        load_page(browser, tmp_path, make_model_page(model))
    assert not browser.evaluate("firstPicture.isReady") and browser.evaluate("hyrfpack.player.renderer.content.isReady")
    final = browser.evaluate(
        "hyrfpack.player.capture().then((blob) => new Promise((resolve) => {"
        "  const reader = new FileReader(); reader.onload = () => resolve(reader.result);"
        "  reader.readAsDataURL(blob); }))"
    )
    assert psnr(read_canvas(browser.evaluate("firstPicture.address")), read_canvas(final)) > 20
    assert psnr(render_in_page(browser, camera), render_reference(model, camera)) > 45


def test_a_picture_of_the_estimate_is_not_returned_as_an_exact_one(browser: Browser, tmp_path: Path):
    camera = make_cameras()[0]
    show_early = f"""
      let page;
      const show = () => page.player.show({camera_json(camera)}).then(() => "a picture", (error) => error.message);
      Object.defineProperty(window, "hyrfpack", {{
        get: () => page,
        set: (value) => {{
          page = value;
          page.player.addEventListener("loaded", () => (window.early ??= show()));
        }},
      }});
    """
    with browser.before_every_page(show_early):
        load_page(browser, tmp_path, make_model_page(make_smooth_model()))
    assert "not ready for exact pictures" in browser.evaluate("early")


def test_a_merged_file_that_the_driver_refuses_is_reported_and_another_opens(browser: Browser, tmp_path: Path):
    model = random_model(300)
    merged = encode_parts([("one", encode_model(model)), ("two", encode_model(random_model(50, seed=1)))])
    file = tmp_path / "page.html"
    file.write_bytes(make_model_page(model, merged))
    with browser.before_every_page(RECORD_JS + REFUSE_JS):
        browser.open(file.as_uri())
        assert "refuses" in wait_for_message(browser)
        assert not browser.evaluate("firstPicture.isReady")  # the estimate was shown
        assert browser.evaluate("hyrfpack.ready.then(() => '', () => 'rejected')") == "rejected"
        assert "refuses" in browser.evaluate("hyrfpack.player.settled.then(() => '', ({ message }) => message)")
        run_statements(browser, "window.refuses = false;")
        store_file_in_page(browser, encode_model(model))
        assert open_file_error(browser, "yield file;") == ""
        wait_until_complete(browser)
        assert browser.evaluate("hyrfpack.player.scene.count") == 300
