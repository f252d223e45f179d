"""Golden files of released versions are still read, and are still written with the same bytes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hyrfpack.choices import CONSISTENT_EXPOSURE
from hyrfpack.edit.transform import replace_config
from hyrfpack.format import describe_file, load_model, metadata
from hyrfpack.model import Frame, HashGridConfig, ModelConfig
from hyrfpack.render import RenderSettings, render_view
from tools.safety.make_golden import GOLDEN_FILES, add_golden_residuals, make_golden_camera
from tools.safety.synthetic_encoding import encode

GOLDEN_FOLDER = Path(__file__).parents[1] / "golden"
GOLDEN_PATHS = sorted(GOLDEN_FOLDER.glob("*.hyrf"))


def test_golden_files_exist():
    assert set(GOLDEN_FILES) <= {file.stem for file in GOLDEN_PATHS}


@pytest.mark.parametrize("file", GOLDEN_PATHS, ids=lambda file: file.stem)
def test_golden_file_decodes_to_the_recorded_numbers(file):
    recorded = np.load(file.with_suffix(".npz"))

    decoded = {name: value.numpy() for name, value in load_model(file).state_dict().items()}

    assert sorted(decoded) == sorted(name for name in recorded.files if not name.startswith(("exposure.", "sampling.")))
    for name, values in decoded.items():
        # Bits are compared, so that -0.0 differs from 0.0 and denormals count.
        assert np.array_equal(values.view(np.uint32), recorded[name].view(np.uint32)), name


@pytest.mark.parametrize("file", GOLDEN_PATHS, ids=lambda file: file.stem)
def test_golden_file_has_the_recorded_configuration(file):
    config = load_model(file).config

    assert config == ModelConfig(
        frame=Frame(
            center=(1e6, -0.1, 3.0),
            scale=12.5,
            half_extent=(1.0, 0.75, 0.25),
            rotation=(0.5, -0.1, 0.7, 0.5) if file.stem == "v1.3_compact_rotated" else (1.0, 0.0, 0.0, 0.0),
        ),
        geometry=HashGridConfig(log2_table_size=4, levels=2, base=2, finest=5),
        radiance=HashGridConfig(log2_table_size=5, levels=2, base=3, finest=7),
        hidden=3,
        background=True,
        solid=(0.0, 0.5, 1.0),
        scale_rule="sum",
        scale_grows=True,
        direction_encoding="sh",
        position_gradients=False,
        antialiased=True,
        residual_degree=GOLDEN_FILES[file.stem].residual_degree,
    )


NAMES_WITH_EXPOSURE_MAP = sorted(name for name, golden in GOLDEN_FILES.items() if golden.exposure is not None)


def test_golden_files_have_an_exposure_map_from_version_1_2_on():
    assert NAMES_WITH_EXPOSURE_MAP == ["v1.2_compact_exposure", "v1.3_compact_rotated"]
    for file in GOLDEN_PATHS:
        assert (load_model(file).exposure is not None) == (file.stem in NAMES_WITH_EXPOSURE_MAP)


@pytest.mark.parametrize("name", NAMES_WITH_EXPOSURE_MAP)
def test_golden_exposure_map_gives_the_recorded_log_gains(name):
    recorded = np.load(GOLDEN_FOLDER / f"{name}.npz")
    exposure = load_model(GOLDEN_FOLDER / f"{name}.hyrf").exposure
    lowest, highest = exposure.limits

    gains = exposure.predict_log_gains(recorded["exposure.positions"], recorded["exposure.directions"])

    np.testing.assert_allclose(gains, recorded["exposure.log_gains"], rtol=0, atol=1e-12)
    assert np.isclose(gains, lowest).any() and np.isclose(gains, highest).any()  # the cases reach both limits
    assert ((gains > lowest) & (gains < highest)).all(1).sum() > 5


@pytest.mark.parametrize("name", NAMES_WITH_EXPOSURE_MAP)
def test_golden_file_with_an_exposure_map_renders_the_recorded_picture(name):
    recorded = np.load(GOLDEN_FOLDER / f"{name}.npz")["exposure.picture"]
    model = load_model(GOLDEN_FOLDER / f"{name}.hyrf")
    camera = make_golden_camera(GOLDEN_FILES[name].rotation)

    picture = render_view(model, camera).rgb.numpy()

    np.testing.assert_allclose(picture, recorded, rtol=0, atol=2e-3)
    assert (
        np.abs(render_view(model, camera, RenderSettings(exposure=CONSISTENT_EXPOSURE)).rgb.numpy() - recorded).max()
        > 0.02
    )


def test_a_golden_file_with_cameras_and_their_rate_ratio_gives_the_recorded_pixel_sizes():
    recorded = np.load(GOLDEN_FOLDER / "v1.1_compact_sampling.npz")["sampling.pixel_sizes"]

    sizes = load_model(GOLDEN_FOLDER / "v1.1_compact_sampling.hyrf").gaussians.pixel_sizes.numpy()

    np.testing.assert_allclose(sizes, recorded, rtol=1e-5)
    assert len(np.unique(recorded)) == len(recorded)


def test_the_rotated_golden_file_renders_the_picture_of_the_straight_one_from_the_rotated_camera():
    straight = render_view(load_model(GOLDEN_FOLDER / "v1.2_compact_exposure.hyrf"), make_golden_camera()).rgb.numpy()
    model = load_model(GOLDEN_FOLDER / "v1.3_compact_rotated.hyrf")

    picture = render_view(model, make_golden_camera(model.config.frame.rotation)).rgb.numpy()

    np.testing.assert_allclose(picture, straight, rtol=0, atol=1e-5)
    assert np.abs(render_view(model, make_golden_camera()).rgb.numpy() - straight).max() > 0.1


@pytest.mark.parametrize("name", GOLDEN_FILES)
def test_golden_model_encodes_to_the_same_bytes(name, monkeypatch):
    golden = (GOLDEN_FOLDER / f"{name}.hyrf").read_bytes()
    info, expected = describe_file(GOLDEN_FOLDER / f"{name}.hyrf"), GOLDEN_FILES[name]
    monkeypatch.setattr(metadata, "writer_name", lambda: info["writer"])
    model = load_model(GOLDEN_FOLDER / "v1.0_raw.hyrf")
    model = replace_config(model, frame=replace(model.config.frame, rotation=expected.rotation))
    model.exposure = expected.exposure
    if expected.residual_degree is not None:
        model = add_golden_residuals(model, expected.residual_degree)

    data = encode(model, expected.profile, info["provenance"], **expected.settings)

    assert data == golden
    assert (info["version"], info["profile"]) == (name[1:4], expected.profile)
