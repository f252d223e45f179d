"""The page chooses the same viewpoint as Python and a valid one for any provenance."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import ball_scene, camera_at, ring, small_model, view_of
from web.scripts import run_script

import hyrfpack
from hyrfpack.cameras.capture import scene_provenance
from hyrfpack.cameras.files import camera_from_json, camera_to_json
from hyrfpack.export.pages import MAX_PAGE_CAMERAS
from hyrfpack.export.source import Source
from hyrfpack.model import Frame
from hyrfpack.rotations import Quaternion
from hyrfpack.scene import Camera, Scene, evenly_spaced

VIEWPOINTS_SCRIPT = Path(__file__).parent / "viewpoints.mjs"
MODEL_FRAME = Frame((40.0, -3.0, 7.0), 2.5, (1.0, 0.5, 0.25))


def make_metadata(provenance: Any, **frame: Any) -> dict:
    numbers = {
        "center": list(MODEL_FRAME.center),
        "scale": MODEL_FRAME.scale,
        "half_extent": list(MODEL_FRAME.half_extent),
    }
    return {"provenance": provenance, "config": {"frame": {**numbers, **frame}}}


def viewpoints_in_node(tmp_path: Path, all_metadata: list[dict]) -> list[dict]:
    file = tmp_path / "metadata.json"
    file.write_text(json.dumps(all_metadata))
    return run_script(VIEWPOINTS_SCRIPT, file)


def provenance_of_cameras(cameras: list[Camera]) -> dict:
    """Return the provenance of a model trained on photos from these cameras."""
    scene = ball_scene(2)
    views = [view_of(f"{k}.png", camera, scene.train[0].load()) for k, camera in enumerate(cameras)]
    parts = {"points": scene.points, "point_colors": scene.point_colors}
    return json.loads(json.dumps(scene_provenance(Scene("made", "colmap", views, [], **parts))))


def drone_cameras(count: int) -> list[Camera]:
    """Return cameras that look straight down and are rotated against each other."""
    turns = [(math.cos(a), math.sin(a), 0) for a in 2 * np.pi * np.arange(count) / count]
    return [camera_at((0.1 * k, 0, 9), (0.1 * k, 0, 0), up) for k, up in enumerate(turns)]


VALID_PROVENANCES = {
    "nothing": {},
    "ring": provenance_of_cameras(ring(40, width=80, height=60)),
    "few": provenance_of_cameras(ring(3)),
    "one": provenance_of_cameras([camera_at((0, -3, 1))]),
    "drone": provenance_of_cameras(drone_cameras(14)),
    "drone with a stated direction": {
        **provenance_of_cameras(drone_cameras(14)),
        "viewpoint": {**provenance_of_cameras(drone_cameras(14))["viewpoint"], "up": [0.1, 0.0, 2.0]},
    },
    "cameras alone": {"cameras": provenance_of_cameras(ring(30))["cameras"]},
    "viewpoint alone": {"viewpoint": provenance_of_cameras(ring(30))["viewpoint"]},
    "viewpoint of an arc": {
        "viewpoint": provenance_of_cameras([camera_at((3, 0.1 * k, 1)) for k in range(7)])["viewpoint"]
    },
}


def camera_array(cameras: list[Camera]) -> np.ndarray:
    return camera_json_array([camera_to_json(camera) for camera in cameras])


def camera_json_array(cameras: list[dict]) -> np.ndarray:
    order = ("width", "height", "fx", "fy", "cx", "cy")
    return np.array([[*(item[key] for key in order), *np.ravel(item["camera_from_world"])] for item in cameras])


FRAME_ROTATIONS_WXYZ = {"straight": None, "rotated": (0.5, -0.1, 0.7, 0.5)}


@pytest.fixture(scope="module")
def viewpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], dict]:
    """Return the viewpoints that the page chooses, by the names of rotation and provenance."""
    cases = {
        (turn, name): make_metadata(provenance, **({} if rotation is None else {"rotation": list(rotation)}))
        for turn, rotation in FRAME_ROTATIONS_WXYZ.items()
        for name, provenance in VALID_PROVENANCES.items()
    }
    found = viewpoints_in_node(tmp_path_factory.mktemp("viewpoints"), list(cases.values()))
    return dict(zip(cases, found, strict=True))


@pytest.mark.parametrize("turn", FRAME_ROTATIONS_WXYZ)
@pytest.mark.parametrize("name", VALID_PROVENANCES)
def test_the_page_has_the_same_viewpoint_as_python(name: str, turn: str, viewpoints: dict, tmp_path: Path) -> None:
    file = tmp_path / "model.hyrf"
    rotation: Quaternion | None = FRAME_ROTATIONS_WXYZ[turn]
    frame = MODEL_FRAME if rotation is None else replace(MODEL_FRAME, rotation=rotation)
    hyrfpack.save_model(small_model([[0, 0, 0]], frame=frame), file, provenance=VALID_PROVENANCES[name])
    read = Source.read(file)
    cameras = [camera for _, camera in read.cameras] or [camera for camera, _ in read.measured_views]

    found = viewpoints[turn, name]
    close = {"rtol": 1e-9, "atol": 1e-9}
    np.testing.assert_allclose(
        camera_json_array(found["cameras"]), camera_array(evenly_spaced(cameras, MAX_PAGE_CAMERAS)), **close
    )
    np.testing.assert_allclose(found["up"], read.up, **close)
    np.testing.assert_allclose(found["target"], read.center, **close)
    assert found["madeUp"] is (not read.cameras)
    if found["madeUp"]:
        np.testing.assert_allclose(camera_json_array(found["fitted"]), camera_array(read.fit_cameras), **close)
    else:
        np.testing.assert_allclose(
            camera_json_array(found["fitted"]), camera_array(evenly_spaced(cameras, 48)), **close
        )


def invalid_provenances() -> list[Any]:
    """Return provenances in each of which one number, list or key is invalid."""
    row, view = VALID_PROVENANCES["few"]["cameras"][0], VALID_PROVENANCES["few"]["viewpoint"]
    wrong = [None, "<b>", [], {}, True, 1e308, -1e300, 0, [[[1]]], "1", 2**53]
    made: list[Any] = [None, 7, [], "text", {"cameras": 3}, {"viewpoint": 3}, {"cameras": {"length": 3}}]
    for value in wrong:
        made += [{"cameras": value}, {"viewpoint": value}, {"cameras": [value]}]
        for place in range(len(row)):
            made.append({"cameras": [row, [*row[:place], value, *row[place + 1 :]]]})
        for key in view:
            made.append({"viewpoint": {**view, key: value}})
            made.append({"viewpoint": {other: view[other] for other in view if other != key}})
            if isinstance(view[key], list):
                for place in range(len(view[key])):
                    changed = copy.deepcopy(view)
                    changed[key][place] = value
                    made.append({"viewpoint": changed})
    return made


@pytest.mark.acceptance
def test_an_invalid_provenance_still_gives_a_valid_viewpoint(tmp_path: Path) -> None:
    cases = [make_metadata(provenance) for provenance in invalid_provenances()]
    frames = [{"center": [1e308, 0, 0]}, {"scale": 1e308}, {"scale": 5e-324}, {"center": [1e37, 1e37, -1e37]}]
    cases += [make_metadata(provenance, **frame) for frame in frames for provenance in ({}, VALID_PROVENANCES["ring"])]

    distinct_cameras = set()
    for found in viewpoints_in_node(tmp_path, cases):
        assert found["cameras"] and found["fitted"]
        distinct_cameras |= {json.dumps(camera) for camera in (*found["cameras"], *found["fitted"])}
        assert math.isclose(math.hypot(*found["up"]), 1, rel_tol=1e-9) and np.isfinite(found["target"]).all()
    for camera in distinct_cameras:
        camera_from_json(json.loads(camera))  # raises an error for anything but a valid camera
