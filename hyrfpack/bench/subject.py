"""The subject of a measurement: a model, viewpoints, and photos from these viewpoints if there are any."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.capture import Capture, place_photos
from hyrfpack.cameras.paths import orbit
from hyrfpack.compress.distortion import default_distortion
from hyrfpack.context import RunContext
from hyrfpack.counts import format_count
from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.device import upload
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.metrics import psnr, ssim, to_8bit
from hyrfpack.format import describe_file, load_model
from hyrfpack.format.codec import packed_provenance
from hyrfpack.measure.error import measure_error
from hyrfpack.model import HybridModel
from hyrfpack.scene import Camera, Scene, View, evenly_spaced
from hyrfpack.train import TrainConfig, train_model

_LOG = logging.getLogger(__name__)

MAX_VIEWS = 6
# Settings for training the built-in model.
BUILT_IN_STEPS = 1000
BUILT_IN_PHOTOS = 48
BUILT_IN_PHOTO_SIDE_PIXELS = 200


@dataclass(frozen=True)
class Subject:
    """A model and the viewpoints at which it is measured.

    Attributes:
        name: the file, or "built-in".
        profile: profile of the file that the model was read from.
        model: the model to measure; all losses are relative to it.
        cameras: the viewpoints.
        photos: (H, W, 3) photo in [0, 1] and (H, W) mask or None of each viewpoint; None if there are no photos.
        capture: the cameras of the training photos, at which compression measures sensitivities.
        distortion: mean squared error of pictures that compression aims at by default.
        provenance: what a compressed file says of the model's origin.
        scene: the photos whose loss compression limits; None if there are none.
    """

    name: str
    profile: str
    model: HybridModel
    cameras: list[Camera]
    photos: list[tuple[Tensor, Tensor | None]] | None
    capture: list[Camera]
    distortion: float
    provenance: dict[str, Any] = field(default_factory=dict)
    scene: Scene | None = None

    def measure_scores(self, pictures: Sequence[Tensor], exact: Sequence[Tensor]) -> tuple[float, float]:
        """Measure the mean PSNR and SSIM over views, against the photos, or without photos against `exact`."""
        references = self.photos or [(to_8bit(picture), None) for picture in exact]
        images = [to_8bit(picture) for picture in pictures]
        pairs = [(image, *photo) for image, photo in zip(images, references, strict=True)]
        return fmean(psnr(*pair) for pair in pairs), fmean(ssim(*pair) for pair in pairs)

    def measure_losses(
        self, pictures: Sequence[Tensor], exact: Sequence[Tensor], exact_scores: tuple[float, float], what: str
    ) -> dict[str, Any]:
        """Measure the fields of a `Row` about pictures: the error, the scores and, with photos, their drops.

        Args:
            pictures: (H, W, 3) picture of each camera.
            exact: the reference's pictures.
            exact_scores: `measure_scores` of `exact`.
            what: what is measured, for the error message.

        Raises:
            HyrfError: a picture holds NaN or infinity.
        """
        psnr, ssim = self.measure_scores(pictures, exact)
        measured, expected = (torch.cat([picture.flatten() for picture in images]) for images in (pictures, exact))
        drops = {"psnr_drop": exact_scores[0] - psnr, "ssim_drop": exact_scores[1] - ssim} if self.photos else {}
        return {"error": measure_error(measured, expected, what), "psnr": psnr, "ssim": ssim, **drops}

    def describe(self) -> str:
        """Describe the model, and what quality is measured against, in one sentence."""
        camera = self.cameras[0]
        quality = (
            f"quality against {format_count(len(self.photos), 'held-out photo')}"
            if self.photos
            else f"quality against exact renders of the model from {len(self.cameras)} viewpoints around the scene"
        )
        return (
            f"{self.name}: {format_count(len(self.model), 'Gaussian')}, "
            f"{'a' if self.model.config.background else 'no'} background sphere, "
            f"views of {camera.width} x {camera.height}, {quality}"
        )


def read_subject(path: str | os.PathLike[str], scene: Scene | None) -> Subject:
    """Read a model file; its viewpoints are a scene's held-out views, or an orbit around the trained scene.

    Raises:
        HyrfError: the file cannot be read, has no Gaussians or no usable viewpoint, or no held-out photo can be scored.
    """
    facts, model = describe_file(path), load_model(path)
    if len(model) == 0:
        raise HyrfError(
            f"{path}: the model has no Gaussians, so there is nothing to measure",
            fix="choose another model",
        )
    scene = place_photos(facts, scene)
    capture = Capture(facts, scene)
    if scene is None:
        cameras, photos = orbit(capture.viewpoint, MAX_VIEWS), None
    else:
        views, photos = _load_held_out_photos(scene, model)
        cameras = [view.camera for view in views]
    return Subject(
        os.fspath(path),
        facts["profile"],
        model,
        cameras,
        photos,
        capture.cameras,
        default_distortion(facts["provenance"]),
        packed_provenance(facts["provenance"], model),
        scene,
    )


def train_built_in_subject() -> Subject:
    """Train a small model on the demo's scene in a temporary folder.

    It trains on the CPU, also beside a GPU, so that the result is the same every time.
    """
    _LOG.info(
        f"training the built-in model: {BUILT_IN_STEPS:,} steps on a synthetic scene, about a minute on two cores"
    )
    with tempfile.TemporaryDirectory(prefix="hyrfpack-bench-") as folder:
        scene = load_scene(
            write_demo_scene(Path(folder) / "scene", views=BUILT_IN_PHOTOS, size=BUILT_IN_PHOTO_SIDE_PIXELS)
        )
        trained = train_model(
            scene, Path(folder) / "run", TrainConfig(steps=BUILT_IN_STEPS), context=RunContext("cpu", progress=None)
        )
        if trained.model is None:  # training treats Ctrl-C as a request to stop
            raise KeyboardInterrupt
        subject = read_subject(trained.model, scene)
    return replace(subject, name="built-in", scene=None)  # whose photos were removed with the folder


def _load_held_out_photos(scene: Scene, model: HybridModel) -> tuple[list[View], list[tuple[Tensor, Tensor | None]]]:
    """Select evenly spaced held-out views and load their photos, without views whose mask leaves no pixel."""
    solid = np.array(model.config.solid, np.float32)
    views, photos = [], []
    for view in evenly_spaced(scene.test, MAX_VIEWS):
        photo, mask = upload(view.load(), solid, model.gaussians.positions.device)
        if mask is None or mask.any():
            views.append(view)
            photos.append((photo, mask))
    if not views:
        raise HyrfError(
            f"{scene.path}: no held-out photo can be scored",
            fix="use a smaller `test_every` or other masks",
        )
    return views, photos
