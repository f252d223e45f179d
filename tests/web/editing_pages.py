"""Pages whose scenes can be edited, and how tests use their panel."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from web.native_models import MODEL_FRAME, SCENE_CENTER, UP_DIRECTION, make_cameras, random_model
from web.pages import Browser, wait_until

from hyrfpack.format import encode_model
from hyrfpack.model import HybridModel
from hyrfpack.scene import Camera
from hyrfpack.web.html import encode_model_page

FRAME_ROTATION = (0.5, -0.5, 0.1, 0.7)  # a rotation of the frame, as an edit stores one
TURNED_FRAME = replace(MODEL_FRAME, rotation=tuple(np.array(FRAME_ROTATION) / np.linalg.norm(FRAME_ROTATION)))


def make_model(count: int = 600) -> HybridModel:
    return random_model(count, frame=TURNED_FRAME, background=False)


def make_ball_model(places: Sequence[Sequence[float]]) -> HybridModel:
    """Return a model of small opaque balls at places in world units."""
    model = random_model(len(places), frame=TURNED_FRAME, background=False)
    with torch.no_grad():
        model.gaussians.positions.copy_(torch.from_numpy(TURNED_FRAME.to_local(np.array(places))))
        model.gaussians.opacity_logits.fill_(20)
        model.gaussians.scale_logits.fill_(-5)
    return model


def make_editable_page(model: HybridModel, cameras: list[Camera] | None = None) -> bytes:
    return encode_model_page(
        encode_model(model),
        title="a model",
        count=len(model),
        frame=model.config.frame,
        solid=model.config.solid,
        cameras=cameras or make_cameras()[:1],
        up=UP_DIRECTION,
        center=SCENE_CENTER,
        editable_file="model.hyrf",
    )


def load_editable_page(browser: Browser, tmp_path: Path, page: bytes, tool: str = "crop") -> Browser:
    """Open a page and its editing panel with a tool."""
    file = tmp_path / "page.html"
    file.write_bytes(page)
    browser.open(file.as_uri())
    browser.evaluate("hyrfpack.ready")
    wait_until(browser, "document.body.classList.contains('there') && hyrfpack.player.whole")
    click(browser, "#edit-button")
    click(browser, f"[data-tool={tool}]")
    return browser


def click(browser: Browser, selector: str) -> None:
    browser.evaluate(f"document.querySelector({json.dumps(selector)}).click()")


def fill(browser: Browser, selector: str, value: object) -> None:
    """Set the value of an input as a user does."""
    browser.evaluate(
        f"((input) => {{ input.value = {json.dumps(value)};"
        "for (const type of ['input', 'change']) input.dispatchEvent(new Event(type)); })"
        f"(document.querySelector({json.dumps(selector)}))"
    )


def list_actions(browser: Browser) -> list[dict[str, Any]]:
    return browser.evaluate("hyrfpack.editor.actions")


def wait_until_applied(browser: Browser) -> int | None:
    """Wait until the picture shows all actions; return the number of Gaussians that are left, None for all."""
    wait_until(browser, "!hyrfpack.editor.isApplying")
    return browser.evaluate("hyrfpack.editor.count")


def read_text(browser: Browser, name: str) -> str:
    return browser.evaluate(f"document.getElementById('{name}').textContent")


def middle_of(browser: Browser, selector: str, number: int = 0) -> tuple[float, float]:
    """Return the centre of one of the elements of a selector."""
    box = f"document.querySelectorAll({json.dumps(selector)})[{number}].getBoundingClientRect()"
    return tuple(
        browser.evaluate(f"(({{ left, top, right, bottom }}) => [(left + right) / 2, (top + bottom) / 2])({box})")
    )


def project(browser: Browser, camera: Camera, point: Sequence[float]) -> tuple[float, float]:
    """Return the place in CSS pixels at which a camera of the window shows a point in world units."""
    x, y, depth = camera.rotation @ np.asarray(point) + camera.camera_from_world[:3, 3]
    ratio = browser.evaluate("hyrfpack.player.canvas.clientWidth") / camera.width
    return ratio * (camera.fx * x / depth + camera.cx), ratio * (camera.fy * y / depth + camera.cy)


def place_on_axis(camera: Camera, place: Sequence[float], point: np.ndarray, axis: int) -> float:
    """Return the coordinate along a world axis through a point at which it is nearest to the ray through a pixel."""
    ray = camera.rotation.T @ ((place[0] - camera.cx) / camera.fx, (place[1] - camera.cy) / camera.fy, 1)
    sides = np.stack((np.eye(3)[axis], -ray), axis=1)
    (along, _), *_ = np.linalg.lstsq(sides, camera.position - point, rcond=None)
    return float(point[axis] + along)


def catch_downloads(browser: Browser) -> None:
    """Keep what the page saves, instead of a download."""
    browser.evaluate(
        "void (URL.createObjectURL = (blob) => { window.saved = blob; return 'data:,'; },"
        "HTMLAnchorElement.prototype.click = () => {})"
    )


def read_saved_bytes(browser: Browser) -> bytes:
    text = "String.fromCharCode(...new Uint8Array(buffer))"
    return base64.b64decode(browser.evaluate(f"saved.arrayBuffer().then((buffer) => btoa({text}))"))


def read_saved_text(browser: Browser) -> str:
    return browser.evaluate("saved.text()")
