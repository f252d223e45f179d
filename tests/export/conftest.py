from __future__ import annotations

from pathlib import Path

import pytest
from level_scenes import write_level_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Path:
    """A scene folder of four chunks at three levels, beside its model, model.hyrf. Tests must not change it."""
    return write_level_scene(tmp_path_factory.mktemp("levels"))
