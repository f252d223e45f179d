"""Random models for the tests of native pages, and how these tests open pages and read what they draw."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scenes import camera_at, shift_cameras
from web.pages import Browser

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.format.codec import encode_model
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.merged import MergedModel
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera
from hyrfpack.web.html import encode_model_page
from tools.safety.make_golden import add_golden_residuals

MODEL_FRAME = Frame((10.0, -20.0, 5.0), 7.0, (1.0, 0.5, 0.8))


EXACT_SETTINGS = RenderSettings(background_threshold=0.0, background_stride=1)


UP_DIRECTION, SCENE_CENTER = np.array([0.0, 0.0, 1.0]), np.array(MODEL_FRAME.center)


CAMERA_POSITIONS = [(0.4, -2.4, 0.7), (-2.0, 0.3, 0.2), (0.1, 0.1, 0.05), (3.5, 2.0, -1.5)]


SMALL_GRID = HashGridConfig(log2_table_size=9, levels=4, base=4, finest=40)


SIXTEEN_LEVEL_GRID = HashGridConfig(log2_table_size=11, levels=16, base=4, finest=256)


ONE_LEVEL_GRID = HashGridConfig(log2_table_size=12, levels=1, base=12, finest=12)


def random_model(count: int = 2600, seed: int = 0, residual_degree: int | None = None, **config: object) -> HybridModel:
    """Return a model with large random fields and Gaussians of all shapes and colours, inside and outside the frame."""
    shape = {"geometry": SMALL_GRID, "radiance": SMALL_GRID, "hidden": 16, "solid": (0.2, 0.3, 0.1), **config}
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator)

    positions = normal(count, 3) * 0.4 * torch.exp(normal(count, 1) * 0.5)
    gaussians = Gaussians(positions, normal(count, 3), normal(count, 1) * 0.5 - 3, normal(count, 1) + 1)
    model = HybridModel(ModelConfig(**{"frame": MODEL_FRAME, **shape}), gaussians, generator)
    with torch.no_grad():
        for field in (model.geometry, model.radiance):
            field.grid.table.copy_(normal(*field.grid.table.shape))
            for bias in field.biases:
                bias.copy_(normal(*bias.shape) * 0.3)
        # The background is evaluated along directions from the centre; trained models hardly depend on these.
        model.radiance.weights[0][:, model.radiance.grid.feature_count :] *= 0.5
    return model if residual_degree is None else add_golden_residuals(model, residual_degree)


def make_cameras(width: int = 120, height: int = 90) -> list[Camera]:
    """Return cameras around, among and far from the Gaussians, in world units."""
    local = [camera_at(place, up=UP_DIRECTION, width=width, height=height, focal=100.0) for place in CAMERA_POSITIONS]
    return shift_cameras([replace(camera, camera_from_world=_scale_pose(camera)) for camera in local], SCENE_CENTER)


def _scale_pose(camera: Camera) -> np.ndarray:
    pose = camera.camera_from_world.copy()
    pose[:3, 3] *= MODEL_FRAME.scale
    return pose


def make_model_page(model: HybridModel, data: bytes | None = None) -> bytes:
    data = encode_model(model) if data is None else data
    facts = {"count": len(model), "frame": model.config.frame, "solid": model.config.solid}
    return encode_model_page(
        data, title="a model", cameras=make_cameras(), up=UP_DIRECTION, center=SCENE_CENTER, **facts
    )


def encode_with_photos(model: HybridModel, width: int = 40, **more: object) -> bytes:
    """Encode a model with cameras of smaller photos, from the same places as `make_cameras`."""
    cameras = [shrink_camera(camera, width) for camera in make_cameras()]
    return encode_model(model, provenance={"cameras": provenance_cameras(cameras), **more})


def make_near_parts(scale: float, depth: float) -> tuple[MergedModel, Camera]:
    """Return a scene, and a part of one opaque Gaussian, which has another unit, before a camera.

    Args:
        scale: unit of the part, in units of the scene.
        depth: depth of the Gaussian, in units of the scene.
    """
    scene, part, camera = random_model(300), random_model(1, seed=1, background=False), make_cameras()[0]
    with torch.no_grad():
        part.gaussians.positions.zero_()
        part.gaussians.opacity_logits.fill_(20)
        part.gaussians.scale_logits.fill_(-2)
    center = camera.position + MODEL_FRAME.scale * depth * camera.rotation[2]
    frame = Frame((center[0], center[1], center[2]), MODEL_FRAME.scale * scale, (1.0, 1.0, 1.0))
    return MergedModel(("scene", "part"), (scene, with_frame(part, frame))), camera


def with_frame(model: HybridModel, frame: Frame) -> HybridModel:
    """Return a model of the same numbers in another frame."""
    moved = HybridModel(replace(model.config, frame=frame), model.gaussians)
    moved.geometry, moved.radiance = model.geometry, model.radiance
    return moved


def render_reference(model: HybridModel, camera: Camera, settings: RenderSettings = EXACT_SETTINGS) -> np.ndarray:
    """Return the picture of `hyrfpack.render_view`, (H, W, 3) in 0 to 255."""
    with torch.no_grad():
        return render_view(model, camera, settings).rgb.clamp(0, 1).numpy() * 255


def load_page(browser: Browser, tmp_path: Path, page: bytes, complete: bool = True) -> Browser:
    """Open a page in the browser and, if `complete`, wait until its picture is complete."""
    file = tmp_path / "page.html"
    file.write_bytes(page)
    browser.open(file.as_uri())
    browser.evaluate("hyrfpack.ready")
    if complete:
        wait_until_complete(browser)
    return browser


def run_statements(browser: Browser, statements: str) -> None:
    """Run JavaScript statements in the page. Properties of `window` keep values for later calls."""
    browser.evaluate(f"(() => {{ {statements} }})()")


def wait_until_complete(browser: Browser) -> None:
    browser.evaluate("hyrfpack.player.settled.then(() => true)")


def read_typed_array(browser: Browser, expression: str, kind: type) -> np.ndarray:
    """Return the value of a JavaScript expression, a typed array of `kind` or a promise of one."""
    text = "(a) => btoa(Array.from(new Uint8Array(a.buffer), (b) => String.fromCharCode(b)).join(''))"
    return np.frombuffer(base64.b64decode(browser.evaluate(f"Promise.resolve({expression}).then({text})")), kind)


def read_texture(browser: Browser, name: str, width: int, words: int) -> np.ndarray:
    """Return the first `words` components of each texel of a content's texture, (texels, words) uint32."""
    script = f"""(() => {{
        const {{ gl, content }} = hyrfpack.player.renderer, height = content.height;
        const target = gl.createFramebuffer(), words = new Uint32Array(4 * {width} * height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, target);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, content.{name}, 0);
        gl.readPixels(0, 0, {width}, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
        gl.deleteFramebuffer(target);
        return words;
    }})()"""
    return read_typed_array(browser, script, np.uint32).reshape(-1, 4)[:, :words]


def lose_and_restore_device(browser: Browser) -> None:
    """Lose and restore the WebGL device, and wait until the picture is complete."""
    browser.evaluate(
        "new Promise((resolve) => { const { player } = hyrfpack;"
        "const device = player.renderer.gl.getExtension('WEBGL_lose_context'), back = () => device.restoreContext();"
        "player.canvas.addEventListener('webglcontextlost', () => setTimeout(back, 0), {once: true});"
        "player.addEventListener('loaded', () => resolve(true), {once: true});"
        "device.loseContext(); })"
    )
    wait_until_complete(browser)


def store_file_in_page(browser: Browser, data: bytes) -> None:
    file = base64.b64encode(data).decode()
    run_statements(browser, f"window.file = Uint8Array.from(atob('{file}'), (c) => c.charCodeAt(0));")


def open_file_error(browser: Browser, stream: str, name: str = "x.hyrf") -> str:
    """Open a file whose bytes these statements of a generator yield; return the error message, or "" on success."""
    opening = f"hyrfpack.player.open({{ name: '{name}', stream: (async function* () {{ {stream} }})() }})"
    return browser.evaluate(f"{opening}.then(() => '', (error) => error.message)")
