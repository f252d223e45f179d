"""What is measured on: a model, viewpoints, and photos from there if there are any."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import orbit
from hyrfpack.compress.distortion import default_distortion
from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.device import upload
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.metrics import psnr, ssim, to_8bit
from hyrfpack.format import describe, load
from hyrfpack.measure.error import measure_error
from hyrfpack.model import HybridModel
from hyrfpack.scene import Camera, Scene, View, evenly_spaced
from hyrfpack.train import TrainConfig, train

VIEWS = 6
BUILT_IN_STEPS, BUILT_IN_PHOTOS, BUILT_IN_SIDE = 1000, 48, 200


@dataclass(frozen=True)
class Subject:
    """A model and where it is looked at from.

    Attributes:
        name: the file, or "built-in".
        profile: of the file that the model was read from.
        model: what is measured; every loss is against it as it is here.
        cameras: viewpoints.
        photos: for each viewpoint (H, W, 3) in [0, 1] and a mask (H, W) or None; None when there are no photos.
        capture: cameras that compression measures the model at: those of the photos it was trained on.
        distortion: mean squared error in pictures that compression aims at by itself.
    """

    name: str
    profile: str
    model: HybridModel
    cameras: list[Camera]
    photos: list[tuple[Tensor, Tensor | None]] | None
    capture: list[Camera]
    distortion: float

    def scores(self, pictures: Sequence[Tensor], exact: Sequence[Tensor]) -> tuple[float, float]:
        """PSNR and SSIM, means over views, against the photos, or against the `exact` pictures without photos."""
        against = self.photos or [(to_8bit(picture), None) for picture in exact]
        images = [to_8bit(picture) for picture in pictures]
        pairs = [(image, *photo) for image, photo in zip(images, against, strict=True)]
        return fmean(psnr(*pair) for pair in pairs), fmean(ssim(*pair) for pair in pairs)

    def losses(
        self, pictures: Sequence[Tensor], exact: Sequence[Tensor], best: tuple[float, float], what: str
    ) -> dict[str, Any]:
        """What a `Row` says of pictures: `error` and the scores, and their drops from `best` where there are photos.

        Args:
            pictures: (H, W, 3) of each camera.
            exact: the reference's.
            best: `scores` of those.
            what: was measured, for the message.

        Raises:
            HyrfError: a picture holds NaN or infinity.
        """
        psnr, ssim = self.scores(pictures, exact)
        found, right = (torch.cat([picture.flatten() for picture in many]) for many in (pictures, exact))
        drops = {"psnr_drop": best[0] - psnr, "ssim_drop": best[1] - ssim} if self.photos else {}
        return {"error": measure_error(found, right, what), "psnr": psnr, "ssim": ssim, **drops}

    def in_words(self) -> str:
        """What is measured on, and what quality is measured against, in one sentence."""
        camera = self.cameras[0]
        against = (
            f"quality against {len(self.photos)} held-out photos"
            if self.photos
            else f"quality against the model's own pictures from {len(self.cameras)} viewpoints around the scene"
        )
        return (
            f"{self.name}: {len(self.model):,} Gaussians, {'a' if self.model.config.background else 'no'} background "
            f"sphere, views of {camera.width} x {camera.height}, {against}"
        )


def read_subject(path: str | os.PathLike[str], scene: Scene | None) -> Subject:
    """A model file, with the held-out photos of a scene or seen from an orbit around what it was trained on.

    Raises:
        HyrfError: the file cannot be read, has no Gaussians or no usable viewpoint, or no photo is held out.
    """
    facts, model = describe(path), load(path)
    if len(model) == 0:
        raise HyrfError(f"{path}: the model has no Gaussians, so there is nothing to measure; name another")
    capture = Capture(facts, scene)
    if scene is None:
        cameras, photos = orbit(capture.viewpoint, VIEWS), None
    else:
        views, photos = _photos(scene, model)
        cameras = [view.camera for view in views]
    return Subject(
        os.fspath(path),
        facts["profile"],
        model,
        cameras,
        photos,
        capture.cameras,
        default_distortion(facts["provenance"]),
    )


def built_in_subject(say: Callable[[str], None]) -> Subject:
    """The demo's scene, trained for a short while in a temporary folder: the same model every time.

    Args:
        say: told what is going on.
    """
    say(f"training the built-in model: {BUILT_IN_STEPS:,} steps on a made-up scene, about a minute on two cores")
    with tempfile.TemporaryDirectory(prefix="hyrfpack-bench-") as folder:
        scene = load_scene(write_demo_scene(Path(folder) / "scene", views=BUILT_IN_PHOTOS, size=BUILT_IN_SIDE))
        trained = train(scene, Path(folder) / "run", TrainConfig(steps=BUILT_IN_STEPS), quiet=True)
        if trained.model is None:  # Ctrl-C: training took it for a request to stop
            raise KeyboardInterrupt
        subject = read_subject(trained.model, scene)
    return replace(subject, name="built-in")


def _photos(scene: Scene, model: HybridModel) -> tuple[list[View], list[tuple[Tensor, Tensor | None]]]:
    """Held-out views spread over all of them, and their photos; those whose mask leaves no pixel are left out."""
    solid = np.array(model.config.solid, np.float32)
    views, photos = [], []
    for view in evenly_spaced(scene.test, VIEWS):
        photo, mask = upload(view.load(), solid, model.gaussians.positions.device)
        if mask is None or mask.any():
            views.append(view)
            photos.append((photo, mask))
    if not views:
        raise HyrfError(f"{scene.path}: no held-out photo can be scored; name a smaller `test_every` or other masks")
    return views, photos
