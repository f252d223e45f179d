"""three.js reads our files: what its object of splats would draw is what we wrote."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from independent.clouds import (
    BAND_0,
    TURN_ABOUT_X,
    Cloud,
    Differences,
    cloud_of_ours,
    differences,
    made_up,
    turned_back,
)
from independent.formats import BYTE, FORMATS, UP

from hyrfpack.splats.formats import gltf
from hyrfpack.splats.formats.hints import Hints

# three.js keeps colours and harmonics as bytes, whatever the file holds.
ROUNDING = Differences(0, 0, 1e-6, BYTE, color=0.02, harmonic=BYTE / BAND_0)


def cloud_of_three(answer: dict) -> Cloud:
    positions = np.reshape(answer["positions"], (-1, 3))
    colors = np.reshape(answer["colors"], (-1, 4))
    harmonics = [((colors[:, :3] - 0.5) / BAND_0)[:, None]]
    harmonics += [np.reshape(band, (len(positions), -1, 3)) for band in answer["harmonics"]]
    upper = np.reshape(answer["covariances"], (-1, 6))
    covariances = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return Cloud(positions, covariances, colors[:, 3], np.concatenate(harmonics, axis=1))


@pytest.mark.parametrize("kind", [kind for kind in FORMATS if kind != "sog"])
def test_three_reads_what_we_write(kind, node, tmp_path):
    form = FORMATS[kind]
    files = [tmp_path / f"{degree}.{form.extension}" for degree in form.degrees]
    for degree, file in zip(form.degrees, files, strict=True):
        file.write_bytes(form.encode(made_up(degree)))
    for degree, answer in zip(form.degrees, node("three.mjs", *files), strict=True):
        assert "error" not in answer, answer["error"]
        theirs = cloud_of_three(answer)
        if form.extension == "spz":
            theirs = turned_back(theirs, TURN_ABOUT_X)
        if form.extension == "glb":
            theirs = in_our_axes(theirs, answer["matrix"], UP)
        found = differences(cloud_of_ours(made_up(degree)), theirs)
        assert found.within(form.precision + ROUNDING), degree


def in_our_axes(cloud: Cloud, matrix: list[float], up: np.ndarray) -> Cloud:
    """A mesh of splats of a glTF, in the scene of which y is up."""
    scene_from_mesh = np.reshape(matrix, (4, 4)).T
    turn, shift = scene_from_mesh[:3, :3], scene_from_mesh[:3, 3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(turn @ up, [0, 1, 0], atol=1e-6)
    assert np.linalg.det(turn) > 0
    return replace(cloud, positions=cloud.positions + turn.T @ shift)


def test_a_gltf_stands_upright_whichever_way_was_up(node, tmp_path):
    ups = np.concatenate((np.eye(3), -np.eye(3)))
    files = [tmp_path / f"{number}.glb" for number in range(len(ups))]
    for up, file in zip(ups, files, strict=True):
        file.write_bytes(gltf.encode(made_up(0), Hints(up)))
    for up, answer in zip(ups, node("three.mjs", *files), strict=True):
        theirs = in_our_axes(cloud_of_three(answer), answer["matrix"], up)
        assert differences(cloud_of_ours(made_up(0)), theirs).within(FORMATS["glb"].precision + ROUNDING), up


def test_a_gltf_far_from_the_origin_stays_sharp(node, tmp_path):
    splats = made_up(0)
    splats = replace(splats, positions=splats.positions + [3e6, -5e6, 2e6])
    file = tmp_path / "far.glb"
    file.write_bytes(gltf.encode(splats, Hints(UP)))
    (answer,) = node("three.mjs", file)
    theirs = in_our_axes(cloud_of_three(answer), answer["matrix"], UP)
    assert differences(cloud_of_ours(splats), theirs).position < 1e-5  # float32 would be off by 0.25
