"""The Python code of the documentation runs as written; `tools/safety/run_docs.py` runs it with all training steps."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_up_photos import FOCAL_PIXELS, PHOTO_SIZE, write_photos

from tools.safety.run_docs import DOCUMENTED_PAGES, extract_python, run_page


def test_code_of_a_page_keeps_its_line_numbers():
    fenced = "Words\n\n```python\nimport hyrfpack\n\nx = 1\n```\n"
    indented = "\n    hyrfpack train a -o b\n\nMore words:\n\n    import hyrfpack\n    y = 2\n\nEnd\n"
    lines = extract_python(fenced + indented).split("\n")
    assert {number: line for number, line in enumerate(lines, start=1) if line} == {
        4: "import hyrfpack",
        6: "x = 1",
        13: "import hyrfpack",
        14: "y = 2",
    }


@pytest.fixture
def photos(tmp_path):
    """Photos with poses; their poses can also be estimated."""
    poses = write_photos(tmp_path / "images", 5)
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": opengl(pose).tolist()} for name, pose in poses.items()
    ]
    camera = {
        "fl_x": FOCAL_PIXELS,
        "fl_y": FOCAL_PIXELS,
        "cx": PHOTO_SIZE[0] / 2,
        "cy": PHOTO_SIZE[1] / 2,
        "w": PHOTO_SIZE[0],
        "h": PHOTO_SIZE[1],
    }
    (tmp_path / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return tmp_path


def opengl(pose: np.ndarray) -> np.ndarray:
    """Return world_from_camera (4, 4), with y up and z backwards, of a camera_from_world (3, 4)."""
    return np.linalg.inv(np.vstack((pose, (0, 0, 0, 1)))) * (1, -1, -1, 1)


def test_every_page_runs_as_written(photos, capfd):
    assert all(run_page(page, photos, 2) for page in DOCUMENTED_PAGES), capfd.readouterr().err


def test_a_page_with_an_error_is_detected(tmp_path, data):
    page = tmp_path / "page.md"
    page.write_text("```python\nimport hyrfpack\nhyrfpack.load('missing.hyrf')\n```\n")
    assert not run_page(page, data, None)
    page.write_text("No Python.\n")
    assert not run_page(page, data, None)
