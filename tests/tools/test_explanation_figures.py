from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import ball_points, camera_at, ring, small_model

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.format import encode_model
from tools.studies.explanation_figures import draw_figures, read_sizes, render_stages, resized


@pytest.fixture
def model():
    positions, _ = ball_points(60)
    return small_model(positions, fields=0.5, background=True)


def test_three_pictures_are_written(model, tmp_path):
    path = tmp_path / "model.hyrf"
    path.write_bytes(encode_model(model, provenance={"cameras": provenance_cameras(ring(6))}))
    figures = draw_figures(path, tmp_path / "figures", size=16)
    assert len(set(figures)) == 3
    for figure in figures:
        with Image.open(figure) as picture:
            assert picture.width == 960
            assert np.asarray(picture.convert("RGB"))[0, 0].tolist() == [255, 255, 255]


def test_sizes_of_sections_add_up_to_the_file(model, tmp_path):
    path = tmp_path / "model.hyrf"
    path.write_bytes(encode_model(model))
    assert sum(read_sizes(path).values()) == path.stat().st_size


def test_each_stage_adds_to_the_picture_and_the_last_is_the_plain_render(model):
    camera = camera_at((3.0, 0.0, 1.0))
    pictures = [picture for _, picture in render_stages(model, camera)]
    assert all((before != after).any() for before, after in zip(pictures, pictures[1:], strict=False))
    with torch.no_grad():
        assert np.abs(pictures[-1] - hyrfpack.render_view(model, camera).rgb.numpy()).max() < 1e-6


def test_a_resized_camera_sees_the_same_field_of_view():
    camera = camera_at((3.0, 0.0, 1.0), width=32, height=16)
    large = resized(camera, 64)
    assert (large.width, large.height) == (64, 32)
    assert large.fx / large.width == camera.fx / camera.width
