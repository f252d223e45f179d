"""three.js reads the files that we write: its splat object holds the same Gaussians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from independent.clouds import (
    BAND_0_VALUE,
    HALF_TURN_ABOUT_X,
    Cloud,
    Differences,
    cloud_from_splats,
    compare_clouds,
    sample_splats,
    undo_rotation,
)
from independent.formats import MAX_BYTE_ERROR, SPLAT_FORMATS, UP_DIRECTION
from layers import only_in_acceptance

from hyrfpack.splats.formats import gltf
from hyrfpack.splats.formats.hints import Hints

# three.js stores colours and harmonics as bytes, whatever the precision of the file.
THREE_PRECISION = Differences(0, 0, 1e-6, MAX_BYTE_ERROR, color=0.02, harmonic=MAX_BYTE_ERROR / BAND_0_VALUE)

READABLE_FORMATS = [kind for kind in SPLAT_FORMATS if kind != "sog"]


def cloud_from_three(answer: dict) -> Cloud:
    positions = np.reshape(answer["positions"], (-1, 3))
    colors = np.reshape(answer["colors"], (-1, 4))
    harmonics = [((colors[:, :3] - 0.5) / BAND_0_VALUE)[:, None]]
    harmonics += [np.reshape(band, (len(positions), -1, 3)) for band in answer["harmonics"]]
    upper = np.reshape(answer["covariances"], (-1, 6))
    covariances = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return Cloud(positions, covariances, colors[:, 3], np.concatenate(harmonics, axis=1))


@pytest.mark.parametrize("kind", only_in_acceptance(READABLE_FORMATS, {"ply", "splat", "spz3"}))
def test_three_reads_what_we_write(kind, node, tmp_path):
    form = SPLAT_FORMATS[kind]
    files = [tmp_path / f"{degree}.{form.extension}" for degree in form.degrees]
    for degree, file in zip(form.degrees, files, strict=True):
        file.write_bytes(form.encode(sample_splats(degree)))
    for degree, answer in zip(form.degrees, node("three.mjs", *files), strict=True):
        assert "error" not in answer, answer["error"]
        theirs = cloud_from_three(answer)
        if form.extension == "spz":
            theirs = undo_rotation(theirs, HALF_TURN_ABOUT_X)
        if form.extension == "glb":
            theirs = undo_node_transform(theirs, answer["matrix"], UP_DIRECTION)
        measured = compare_clouds(cloud_from_splats(sample_splats(degree)), theirs)
        assert measured.is_within(form.precision + THREE_PRECISION), degree


def undo_node_transform(cloud: Cloud, matrix: list[float], up: np.ndarray) -> Cloud:
    """Return the cloud of a glTF node in our axes; assert that the node turns `up` to the y axis of its scene."""
    scene_from_mesh = np.reshape(matrix, (4, 4)).T
    turn, shift = scene_from_mesh[:3, :3], scene_from_mesh[:3, 3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(turn @ up, [0, 1, 0], atol=1e-6)
    assert np.linalg.det(turn) > 0
    return replace(cloud, positions=cloud.positions + turn.T @ shift)


def test_a_gltf_is_upright_for_every_up_direction(node, tmp_path):
    ups = np.concatenate((np.eye(3), -np.eye(3)))
    files = [tmp_path / f"{number}.glb" for number in range(len(ups))]
    for up, file in zip(ups, files, strict=True):
        file.write_bytes(gltf.encode(sample_splats(0), Hints(up)))
    for up, answer in zip(ups, node("three.mjs", *files), strict=True):
        theirs = undo_node_transform(cloud_from_three(answer), answer["matrix"], up)
        assert compare_clouds(cloud_from_splats(sample_splats(0)), theirs).is_within(
            SPLAT_FORMATS["glb"].precision + THREE_PRECISION
        ), up


def test_a_gltf_far_from_the_origin_keeps_its_precision(node, tmp_path):
    splats = sample_splats(0)
    splats = replace(splats, positions=splats.positions + [3e6, -5e6, 2e6])
    file = tmp_path / "far.glb"
    file.write_bytes(gltf.encode(splats, Hints(UP_DIRECTION)))
    (answer,) = node("three.mjs", file)
    theirs = undo_node_transform(cloud_from_three(answer), answer["matrix"], UP_DIRECTION)
    # Float32 positions would be off by 0.25.
    assert compare_clouds(cloud_from_splats(splats), theirs).position < 1e-5
