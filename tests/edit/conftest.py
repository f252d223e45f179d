"""Photos of the built-in scene, of which the golden models were trained."""

from __future__ import annotations

from pathlib import Path

import pytest

from hyrfpack.data import load_scene
from hyrfpack.scene import Scene
from tools.safety.train_golden import write_demo_photos


@pytest.fixture(scope="package")
def photos(tmp_path_factory) -> Path:
    return write_demo_photos(tmp_path_factory.mktemp("demo"))


@pytest.fixture(scope="package")
def scene(photos) -> Scene:
    return load_scene(photos)


@pytest.fixture(autouse=True)
def quick_comparisons(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare the pictures of an edit in two views."""
    monkeypatch.setattr("hyrfpack.edit.run.MAX_COMPARED_VIEWS", 2)
