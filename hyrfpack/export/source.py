"""The source of an export: a model, and the cameras from which it was photographed."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hyrfpack.cameras.capture import MISMATCH_REMEDY, Capture
from hyrfpack.cameras.paths import Viewpoint, downward_direction, look_at, orbit
from hyrfpack.cameras.view_sampling import interpolate_views
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.format import describe_file
from hyrfpack.format.parts import load_model_or_parts
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel, scene_of
from hyrfpack.scene import Camera, Scene, View, evenly_spaced

MAX_FIT_CAMERAS = 256  # because each camera takes memory and time
MAX_MEASURED_VIEWS = 12
HELD_OUT_INTERVAL = 8
MIN_CAMERAS_TO_HOLD_OUT = 16
# Coarse cameras are fitted together with many others, so that each of them matters less.
MIN_COARSE_CAMERAS_TO_HOLD_OUT = 8
VIEWS_BETWEEN_PER_CAMERA = 4
RING_CAMERAS = 24
RING_HEIGHTS_PER_DISTANCE = (-0.2, 0.0, 0.2)
# A stored up direction within 45 degrees of that of cameras that look down was stated, and is kept.
MIN_STATED_UP_AGREEMENT = math.cos(math.radians(45))


@dataclass(frozen=True)
class Source:
    """A model with the cameras from which it was photographed.

    Attributes:
        model: the model; the scene of a merged file, its first part.
        all_parts: what is shown and exported: `model`, or the merged model of all parts of a merged file.
        cameras: names and cameras of the training photos; empty if the file keeps none and no photos are given. Files
            keep no names, so without photos these are "camera-0000.png" and so on.
        fit_cameras: cameras at which colours are fitted; generated ones around the scene if none are known.
        measured_views: cameras at which the loss is measured, with their photos or None. They are not fitted, unless
            the file keeps fewer than MIN_CAMERAS_TO_HOLD_OUT cameras, or MIN_COARSE_CAMERAS_TO_HOLD_OUT coarse ones.
        up: (3,) unit vector that points up in the scene.
        center: (3,) point at the centre of interest, world units.
        has_coarse_cameras: whether `cameras` are approximate, as in small files, and so unsuitable for training.
        fits_measured_views: whether `measured_views` are among `fit_cameras`, because there are too few cameras.
    """

    model: HybridModel
    all_parts: HybridModel | MergedModel
    cameras: list[tuple[str, Camera]]
    fit_cameras: list[Camera]
    measured_views: list[tuple[Camera, View | None]]
    up: np.ndarray
    center: np.ndarray
    has_coarse_cameras: bool = False
    fits_measured_views: bool = False

    @classmethod
    def read(cls, path: str | os.PathLike[str], data: Scene | None = None) -> Source:
        """Read a `.hyrf` file, with the cameras of the given photos or else those that the file keeps.

        Raises:
            HyrfError: the file cannot be read or holds no Gaussian, or the photos do not belong to the model.
        """
        facts = describe_file(path)
        capture = Capture(facts, data)
        if mismatch := capture.mismatch:
            raise HyrfDataError(mismatch, fix=MISMATCH_REMEDY)
        all_parts = load_model_or_parts(path)
        model = scene_of(all_parts)
        if not len(all_parts):
            raise HyrfError(f"{path}: there is no Gaussian in it, so there is nothing to export", fix="train it again")
        try:
            viewpoint = capture.viewpoint
        except HyrfDataError as error:  # photos would not help, because the model's own viewpoint is needed
            reason = error.__cause__
            raise HyrfDataError(
                f"{path}: its viewpoint cannot be used ({reason!s:.160})",
                fix="train the model again",
            ) from reason
        up, center = viewpoint.up / math.hypot(*viewpoint.up), viewpoint.center
        if data is not None and data.train:
            chosen = _choose_photo_cameras(capture, data)
        elif capture.is_synthetic:
            chosen = _choose_orbit_cameras(capture, viewpoint, center, up)
        else:
            chosen = _choose_stored_cameras(capture, viewpoint, center, up)
        return cls(
            model=model,
            all_parts=all_parts,
            cameras=chosen.named,
            fit_cameras=chosen.fit,
            measured_views=chosen.measured,
            up=up if capture.is_synthetic else _choose_up(capture.cameras, up),
            center=center,
            has_coarse_cameras=capture.is_coarse,
            fits_measured_views=chosen.fits_measured,
        )


class _ChosenCameras(NamedTuple):
    """The cameras of a `Source`: its `cameras`, `fit_cameras`, `measured_views` and `fits_measured_views`."""

    named: list[tuple[str, Camera]]
    fit: list[Camera]
    measured: list[tuple[Camera, View | None]]
    fits_measured: bool = False


def _choose_photo_cameras(capture: Capture, data: Scene) -> _ChosenCameras:
    """Choose the cameras of the photos: training photos to fit colours, held-out photos to measure the loss."""
    return _ChosenCameras(
        [(view.name, view.camera) for view in data.train],
        evenly_spaced(capture.cameras, MAX_FIT_CAMERAS),
        [(view.camera, view) for view in evenly_spaced(data.test, MAX_MEASURED_VIEWS)],
    )


def _choose_orbit_cameras(capture: Capture, viewpoint: Viewpoint, center: np.ndarray, up: np.ndarray) -> _ChosenCameras:
    """Choose generated cameras around a scene whose file keeps none."""
    # The orbit has twice as many cameras as RING_CAMERAS; every other one lies between the fitted ones.
    between = evenly_spaced(capture.cameras[1::2], MAX_MEASURED_VIEWS)
    return _ChosenCameras([], _make_ring_cameras(viewpoint, center, up), [(camera, None) for camera in between])


def _choose_stored_cameras(
    capture: Capture, viewpoint: Viewpoint, center: np.ndarray, up: np.ndarray
) -> _ChosenCameras:
    """Choose among the cameras that a file keeps; every HELD_OUT_INTERVAL-th is not fitted if there are enough."""
    cameras = capture.cameras
    measured = fit = cameras
    holds_out = len(cameras) >= (MIN_COARSE_CAMERAS_TO_HOLD_OUT if capture.is_coarse else MIN_CAMERAS_TO_HOLD_OUT)
    if holds_out:
        measured = cameras[::HELD_OUT_INTERVAL]
        fit = [camera for number, camera in enumerate(cameras) if number % HELD_OUT_INTERVAL]
    if capture.is_coarse:
        # Coarse cameras are too few to fit harmonics, so cameras between them and around the scene are added.
        between = [camera for seed in range(VIEWS_BETWEEN_PER_CAMERA) for camera in interpolate_views(fit, seed)]
        fit = [*fit, *between, *_make_ring_cameras(viewpoint, center, up)]
    return _ChosenCameras(
        [(f"camera-{number:04d}.png", camera) for number, camera in enumerate(cameras)],
        fit,
        [(camera, None) for camera in evenly_spaced(measured, MAX_MEASURED_VIEWS)],
        fits_measured=not holds_out,
    )


def _choose_up(cameras: list[Camera], up: np.ndarray) -> np.ndarray:
    """Return the unit vector that points up, also for cameras that look straight down, as those of drones do.

    Training stores the up direction of a picture of theirs. A stored direction that is nearly opposite to their views
    was stated by an edit, and is kept.
    """
    down = downward_direction(cameras)
    return up if down is None or -up @ down >= MIN_STATED_UP_AGREEMENT else -down


def _make_ring_cameras(viewpoint: Viewpoint, center: np.ndarray, up: np.ndarray) -> list[Camera]:
    """Make cameras in rings around a scene, at several heights, as a photographer might have stood."""
    cameras = []
    for camera in orbit(viewpoint, RING_CAMERAS):
        distance = np.linalg.norm(camera.position - center)
        for lift in RING_HEIGHTS_PER_DISTANCE:
            pose = look_at(camera.position + lift * distance * up, center, up)
            cameras.append(replace(camera, camera_from_world=pose))
    return cameras
