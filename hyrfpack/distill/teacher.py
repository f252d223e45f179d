"""The original as a teacher: its pictures as a scene of photos, and what each of its Gaussians gives to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from hyrfpack.device import make_current
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.rasterize.light import sent_light
from hyrfpack.parallel.pool import parallel_map, torch_on_one_thread
from hyrfpack.render import RenderSettings, render
from hyrfpack.scene import Camera, Picture, Scene, View
from hyrfpack.splats.draw import Drawable, draw

LIT_AT_ONCE = 8  # views whose light is in memory together
LEAST_ALPHA = 1e-6  # below it a pixel has no colour of its own


def teaching_scene(name: str, drawable: Drawable, train: Sequence[Camera], test: Sequence[Camera]) -> Scene:
    """The original seen by cameras, as a scene of photos with coverage; drawn when they are asked for."""
    count = len(str(len(train) + len(test)))
    taught, scored = (
        [
            View(f"{kind}/{number:0{count}d}", camera, partial(photograph, drawable, camera))
            for number, camera in enumerate(cameras)
        ]
        for kind, cameras in (("train", train), ("test", test))
    )
    return Scene(name, "splats", taught, scored, np.zeros((0, 3)), np.zeros((0, 3), np.float32), has_alpha=True)


def photograph(drawable: Drawable, camera: Camera) -> Picture:
    """The original as a camera sees it, 8 bits, straight alpha."""
    make_current(drawable.device)  # in this thread, which may be one that reads photos ahead
    drawn = draw(drawable, camera)
    alpha = 1 - drawn.transmittance
    rgb = drawn.rgb / alpha.clamp_min(LEAST_ALPHA)[..., None]
    return Picture(*((values.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy() for values in (rgb, alpha)))


@torch_on_one_thread()
def light_of(drawable: Drawable, cameras: Sequence[Camera]) -> Tensor:
    """(N,) the light that each Gaussian sends to a picture, in pixels: the sum of T alpha, mean over cameras."""
    total = torch.zeros(len(drawable.positions), device=drawable.device)
    settings = RenderSettings()

    def light(camera: Camera) -> tuple[Tensor, Tensor]:
        pose = torch.as_tensor(drawable.frame.local_pose(camera), dtype=torch.float32)
        size = camera.intrinsics, camera.width, camera.height
        index = frustum_cull(drawable.positions, pose, *size, settings.near, settings.cull_tolerance)
        parts = (drawable.positions, drawable.quats, drawable.scales, drawable.opacities)
        means, quats, scales, opacities = (part[index] for part in parts)
        light, _ = sent_light(
            means, quats, scales, opacities, pose, *size, near=settings.near, antialiased=drawable.antialiased
        )
        return index, light

    for first in range(0, len(cameras), LIT_AT_ONCE):
        for index, sent in parallel_map(light, cameras[first : first + LIT_AT_ONCE], drawable.device):
            total.index_add_(0, index, sent)
    return total / max(1, len(cameras))


@dataclass(frozen=True)
class Sample:
    """What splats look like from some cameras, for models to be compared with.

    Attributes:
        cameras: where from.
        pictures: of each, (H, W, 3) over black, cut to [0, 1].
    """

    cameras: list[Camera]
    pictures: list[Tensor]

    @classmethod
    def of(cls, drawable: Drawable, cameras: Sequence[Camera]) -> Sample:
        """Draw the splats once, however many models are compared with them."""
        pictures = parallel_map(lambda camera: draw(drawable, camera).rgb.clamp(0, 1), cameras, drawable.device)
        return cls(list(cameras), pictures)

    @torch.no_grad()
    def likeness(self, model: HybridModel) -> list[float]:
        """PSNR in dB of a model's pictures, over black and cut to [0, 1], against these, by camera; on one device."""
        decoded = model.decode()

        @torch.no_grad()  # of this thread
        def score(place: int) -> float:
            shown = render(model, self.cameras[place], decoded=decoded).rgb
            return psnr(shown.clamp(0, 1), self.pictures[place])

        return parallel_map(score, range(len(self.cameras)), model.gaussians.positions.device)
