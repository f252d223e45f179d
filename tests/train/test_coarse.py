"""Photos at half their size: the same picture, seen by the same camera."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import ball_scene

from hyrfpack.render import render
from hyrfpack.scene import Camera
from hyrfpack.train import TrainConfig, Trainer, coarse
from hyrfpack.train.coarse import can_be_halved, halved


def a_camera(width: int, height: int) -> Camera:
    return Camera(width, height, 50.0, 60.0, 0.4 * width, 0.6 * height, np.eye(4))


@pytest.mark.parametrize(("width", "height"), [(8, 6), (9, 6), (8, 7), (3, 3), (2, 2)])
def test_each_pixel_is_the_mean_of_four(width, height):
    photo = torch.rand(height, width, 3, dtype=torch.float64)
    camera, small, mask = halved(a_camera(width, height), photo, None)
    assert mask is None and (camera.width, camera.height) == (width // 2, height // 2)
    for y in range(height // 2):
        for x in range(width // 2):
            assert torch.allclose(small[y, x], photo[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].mean((0, 1)))


def test_a_pixel_counts_where_all_four_did():
    mask = torch.tensor([[1, 1, 1, 0, 1], [1, 1, 1, 1, 1], [0, 0, 1, 1, 1]], dtype=torch.bool)
    _, _, small = halved(a_camera(5, 3), torch.zeros(3, 5, 3), mask)
    assert small.tolist() == [[True, False]]


@pytest.mark.parametrize(("width", "height"), [(40, 30), (41, 31)])
def test_rays_through_the_corners_of_pixels_stay(width, height):
    camera = a_camera(width, height)
    small, *_ = halved(camera, torch.zeros(height, width, 3), None)
    points = np.random.default_rng(0).normal(size=(50, 3)) + [0, 0, 5]
    project = [points[:, :2] / points[:, 2:] * (c.fx, c.fy) + (c.cx, c.cy) for c in (camera, small)]
    assert np.allclose(project[0], 2 * project[1])
    assert np.array_equal(small.camera_from_world, camera.camera_from_world)


@pytest.mark.parametrize(("width", "height", "expected"), [(128, 128, True), (127, 500, False), (500, 127, False)])
def test_small_photos_stay_as_they_are(width, height, expected):
    assert can_be_halved(a_camera(width, height)) is expected


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_first_part_of_a_run_sees_halves(share, monkeypatch):
    monkeypatch.setattr(coarse, "SMALLEST", 8)
    seen: list[tuple[int, int]] = []

    def drawn(model, camera, **options):
        seen.append((camera.width, camera.height))
        return render(model, camera, **options)

    monkeypatch.setattr("hyrfpack.train.trainer.render", drawn)
    scene = ball_scene(views=4, points=40, side=25)
    Trainer(scene, TrainConfig(steps=8, max_gaussians=60, coarse=share)).run()
    assert seen == [(12, 12)] * round(8 * share) + [(25, 25)] * (8 - round(8 * share))


def test_a_mask_that_halving_leaves_nothing_of_is_a_view_without_pixels(monkeypatch):
    monkeypatch.setattr(coarse, "SMALLEST", 8)
    scene = ball_scene(views=4, points=40, side=24)
    dots = np.zeros((24, 24), bool)
    dots[::2, ::2] = True

    def masked(view):
        picture = dataclasses.replace(view.load(), mask=dots)
        return dataclasses.replace(view, load=lambda: picture)

    scene = dataclasses.replace(scene, train=[masked(view) for view in scene.train])
    trainer = Trainer(scene, TrainConfig(steps=8, max_gaussians=60, coarse=0.5))
    trainer.run()
    assert [record["step"] for record in trainer.records] == [5, 6, 7, 8]
    assert all(bool(torch.isfinite(p).all()) for p in trainer.model.parameters())
