"""Floaters are found by the photos, whatever they look like; surfaces stay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused
from scenes import QUIET_CONTEXT

from hyrfpack.cameras.capture import Capture
from hyrfpack.config.edit import RemoveFloaters
from hyrfpack.edit import plan_edit
from hyrfpack.edit.floaters import find_floaters
from hyrfpack.errors import HyrfError
from hyrfpack.format import describe_file, load_model
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera, Picture, View

RAW_FILE = Path(__file__).parents[1] / "golden" / "trained" / "demo.hyrf"
FLOATERS_PER_CAMERA = 3


def photograph(model: HybridModel, cameras: list[Camera]) -> list[View]:
    """Return views whose photos are renders of the model, rounded to bytes."""

    def picture(camera: Camera) -> Picture:
        rgb = render_view(model, camera, RenderSettings(background_stride=1)).rgb
        return Picture((255 * rgb.clamp(0, 1)).round().to(torch.uint8).numpy())

    pictures = [picture(camera) for camera in cameras]
    return [
        View(f"{number}.png", camera, lambda number=number: pictures[number]) for number, camera in enumerate(cameras)
    ]


def plant(model: HybridModel, cameras: list[Camera]) -> tuple[HybridModel, np.ndarray]:
    """Return the model with opaque Gaussians of random colours halfway between cameras and surface, and their mask."""
    generator = np.random.default_rng(3)
    places = []
    for camera in cameras:
        depth = render_view(model, camera, depth=True).depth.numpy()
        for _ in range(FLOATERS_PER_CAMERA):
            row, column = generator.integers(0, camera.height), generator.integers(0, camera.width)
            z = 0.5 * (depth[row, column] or np.median(depth))
            local = np.array([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z])
            places.append((local - camera.camera_from_world[:3, 3]) @ camera.rotation)
    frame, count = model.config.frame, len(places)
    positions = torch.from_numpy((np.array(places) - frame.center) / frame.scale).float()
    colors = torch.from_numpy(generator.normal(0, 2, (count, 3))).float()
    old = model.gaussians
    model.gaussians = Gaussians(
        torch.cat((old.positions, positions)),
        torch.cat((old.color_logits, colors)),
        torch.cat((old.scale_logits, old.scale_logits.mean().expand(count, 1))),
        torch.cat((old.opacity_logits, torch.full((count, 1), 8.0))),
    )
    return model.requires_grad_(False), np.arange(len(model)) >= len(old)


@pytest.fixture(autouse=True)
def quick_comparison(monkeypatch):
    """Compare the model with its few small photos in a quarter of the steps, which are enough for them."""
    monkeypatch.setattr("hyrfpack.edit.floaters.MIN_FADING_STEPS", 150)


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    return Capture(describe_file(RAW_FILE)).cameras


def test_planted_floaters_are_found_and_surfaces_stay(cameras):
    views = photograph(load_model(RAW_FILE), cameras)
    planted, is_floater = plant(load_model(RAW_FILE), cameras)
    parameters = {name: values.clone() for name, values in planted.named_parameters()}
    found = find_floaters(planted, views, 0.35)
    assert found[is_floater].mean() > 0.9
    assert found[~is_floater].mean() < 0.005
    assert all(torch.equal(values, parameters[name]) for name, values in planted.named_parameters())


@pytest.mark.acceptance
def test_a_model_that_equals_its_photos_has_no_floaters(cameras):
    model = load_model(RAW_FILE)
    assert find_floaters(model, photograph(model, cameras), 0.35).mean() < 0.002


def test_without_photos_the_command_and_the_function_ask_for_them():
    with pytest.raises(HyrfError, match="comparing the model with its photos"):
        plan_edit(RAW_FILE, [RemoveFloaters()], context=QUIET_CONTEXT)
    assert "--data" in refused("edit", RAW_FILE, "--plan", "--remove-floaters", "0.35")


@pytest.mark.parametrize("share", [0, 1, -0.5, float("nan")])
def test_a_share_outside_of_its_range_is_refused(share):
    with pytest.raises(ValueError, match="min_opacity_share"):
        RemoveFloaters(share)
