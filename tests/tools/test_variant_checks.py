"""tools/safety/variants: which differences from the original set a check finds, and what it does without a package."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import ball_scene

from hyrfpack.scene import Scene
from tools.safety.variants import check
from tools.safety.variants.check import check_variant
from tools.safety.variants.differences import find_difference
from tools.safety.variants.variant import Variant


@pytest.fixture(scope="module")
def original() -> Scene:
    return ball_scene(views=8, points=40, side=16)


def change_pictures(scene: Scene, **changes) -> Scene:
    """Return the scene with changed pictures."""
    views = [replace(view, load=lambda view=view: replace(view.load(), **changes)) for view in scene.train]
    return replace(scene, train=views)


def test_a_scene_equals_itself(original: Scene):
    assert find_difference(original, original, None) == ""


def test_other_pictures_are_a_difference(original: Scene):
    black = change_pictures(original, rgb=np.zeros((16, 16, 3), np.uint8))
    assert "different picture" in find_difference(black, original, None)


def test_photos_of_which_a_mask_hides_everything_are_a_difference(original: Scene):
    hidden = change_pictures(original, rgb=np.zeros((16, 16, 3), np.uint8), mask=np.zeros((16, 16), bool))
    assert "no pixel to compare" in find_difference(hidden, original, None)


def test_missing_photos_are_a_difference_unless_the_variant_may_lack_them(original: Scene):
    fewer = replace(original, train=original.train[::2])
    assert "4 photos instead of 8" in find_difference(fewer, original, None)
    assert find_difference(fewer, original, None, may_lack_photos=True) == ""


def test_a_variant_that_needs_a_missing_package_is_skipped(original: Scene, tmp_path: Path):
    def need_package(_: object) -> None:
        raise ModuleNotFoundError("No module named 'missing'", name="missing")

    (tmp_path / "images").mkdir()
    outcome = check_variant(Variant("names: x", need_package), tmp_path, "colmap", tmp_path / "work", original)
    assert (outcome.kind, outcome.message) == ("skipped", "the package missing is not installed")


def test_a_package_that_is_missing_when_the_set_is_read_is_wrong(original: Scene, tmp_path: Path, monkeypatch):
    def need_package(_: object) -> Scene:
        raise ModuleNotFoundError("No module named 'missing'", name="missing")

    monkeypatch.setattr(check, "load_scene", need_package)
    (tmp_path / "images").mkdir()
    outcome = check_variant(Variant("names: x", bool), tmp_path, "colmap", tmp_path / "work", original)
    assert outcome.kind == "WRONG" and "missing" in outcome.message
