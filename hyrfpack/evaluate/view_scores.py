"""Scores of one view: a render of a model against the photo."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from hyrfpack.choices import AS_PHOTOGRAPHED, CONSISTENT_EXPOSURE
from hyrfpack.device import upload
from hyrfpack.evaluate.exposure import correct_colors
from hyrfpack.evaluate.figures import draw_comparison
from hyrfpack.evaluate.lpips import LPIPS
from hyrfpack.evaluate.metrics import psnr, ssim, to_8bit
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel, scene_of
from hyrfpack.render import RenderSettings, apply_exposure_map, render_view
from hyrfpack.scene import Camera, View
from hyrfpack.splats.draw import Drawable, draw


@dataclass(frozen=True)
class ViewScore:
    """Scores of one held-out view; the quantities are those of `Evaluation`."""

    name: str
    psnr: float
    psnr_consistent: float | None
    psnr_corrected: float
    ssim: float
    lpips: float | None


@dataclass(frozen=True)
class Comparison:
    """A render beside its photo.

    Attributes:
        photo: (H, W, 3) in [0, 1].
        render: (H, W, 3) in [0, 1], in steps of 1/255.
        mask: (H, W) bool, True where pixels are scored; None for all pixels.
        score: the scores of the render.
        seconds: time to render.
    """

    photo: Tensor
    render: Tensor
    mask: Tensor | None
    score: ViewScore
    seconds: float

    def draw(self) -> Image.Image:
        """Draw a picture of photo, render and error, with the scores above."""
        perceptual = "" if self.score.lpips is None else f"   LPIPS {self.score.lpips:.3f}"
        caption = f"{self.score.name}   {self.score.psnr:.2f} dB   SSIM {self.score.ssim:.3f}{perceptual}"
        return draw_comparison(self.photo, self.render, self.mask, caption)


class ViewScorer:
    """Renders views of one model and compares them with their photos."""

    def __init__(
        self, model: HybridModel | MergedModel | Drawable, settings: RenderSettings, perceptual: LPIPS | None
    ) -> None:
        """Decode what does not depend on the view.

        Args:
            model: the model, or splats, which are drawn over black.
            settings: settings of the renders.
            perceptual: the network of LPIPS; None for scores without it.
        """
        if isinstance(model, Drawable):
            self._solid, self._device = np.zeros(3, np.float32), model.device
        else:
            scene = scene_of(model)
            self._solid = np.array(scene.config.solid, dtype=np.float32)
            self._device = scene.gaussians.positions.device
        self._perceptual = perceptual
        self._draw_colors = _color_renderer(model, settings)

    def warm_up(self, camera: Camera) -> None:
        """Render once, which compiles kernels and fills caches."""
        self._draw_colors(camera)

    def compare(self, view: View) -> Comparison | None:
        """Render a view and score it; None if its mask leaves no pixel.

        Raises:
            HyrfError: the photo cannot be read, or a number that the view needs is NaN or infinite.
        """
        photo, mask = upload(view.load(), self._solid, self._device)
        if mask is not None and not mask.any():
            return None
        started = self._synchronized_seconds()
        rgb, consistent = self._draw_colors(view.camera)
        seconds = self._synchronized_seconds() - started
        image = to_8bit(rgb)
        distance = None
        if self._perceptual is not None:
            unmasked = image if mask is None else torch.where(mask[..., None], image, photo)
            distance = self._perceptual(unmasked, photo)
        score = ViewScore(
            name=view.name,
            psnr=psnr(image, photo, mask),
            psnr_consistent=None if consistent is None else psnr(to_8bit(consistent), photo, mask),
            psnr_corrected=psnr(correct_colors(image, photo, mask), photo, mask),
            ssim=ssim(image, photo, mask),
            lpips=distance,
        )
        return Comparison(photo, image, mask, score, seconds)

    def _synchronized_seconds(self) -> float:
        """Return the time at which the device has done all its work."""
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()


def _color_renderer(
    model: HybridModel | MergedModel | Drawable, settings: RenderSettings
) -> Callable[[Camera], tuple[Tensor, Tensor | None]]:
    """Return a function that renders a camera: (H, W, 3) as `settings` ask, and (H, W, 3) at the consistent exposure.

    The second is None for splats, merged models and models without an exposure map. Everything that does not depend on
    the view is decoded once.
    """
    if isinstance(model, Drawable):
        return lambda camera: (draw(model, camera, settings).rgb, None)
    if isinstance(model, MergedModel):
        decoded_parts = model.decode()
        return lambda camera: (render_view(model, camera, settings, decoded=decoded_parts).rgb, None)
    decoded, consistent_settings = model.decode(), replace(settings, exposure=CONSISTENT_EXPOSURE)

    def draw_colors(camera: Camera) -> tuple[Tensor, Tensor | None]:
        rgb = render_view(model, camera, consistent_settings, decoded=decoded).rgb
        if model.exposure is None:
            return rgb, None
        return apply_exposure_map(model, camera, rgb) if settings.exposure == AS_PHOTOGRAPHED else rgb, rgb

    return draw_colors
