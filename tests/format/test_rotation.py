"""Files of rotated scenes: their version, what is refused, and that other files are as before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from forged_files import MODEL_CONFIG, assemble_file, make_meta, metadata_json, section_shapes, zero_payloads

from hyrfpack.edit.transform import replace_config
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import decode_model, describe_file, load_model, save_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.format.container import Container
from hyrfpack.format.rewrite import with_metadata

GOLDEN_FOLDER = Path(__file__).parents[1] / "golden"
ROTATION = (0.5, -0.5, 0.5, 0.5)
VERSION_BY_OLDER_FILE = {"v1.0_raw": "1.0", "v1.1_compact": "1.1", "v1.2_compact_exposure": "1.2"}


def rotate_frame(model, rotation=ROTATION):
    return replace_config(model, frame=replace(model.config.frame, rotation=rotation))


def file_with_rotation(rotation: object) -> bytes:
    """Return a file without Gaussians that has a rotation, valid or not."""
    plain, frame = make_meta(0), MODEL_CONFIG["frame"]
    text = metadata_json(make_meta(0, frame={**frame, "rotation": rotation}))
    return assemble_file(text, zero_payloads(plain), section_shapes(plain))


@pytest.mark.parametrize("name", VERSION_BY_OLDER_FILE)
def test_a_rotated_file_has_version_1_3_and_turned_back_that_of_its_sections(name, tmp_path):
    source, there, back = GOLDEN_FOLDER / f"{name}.hyrf", tmp_path / "there.hyrf", tmp_path / "back.hyrf"
    model, provenance = load_with_provenance(source)

    for old, new, config in ((source, there, rotate_frame(model).config), (there, back, model.config)):
        with Container.open(old) as container:
            new.write_bytes(with_metadata(container, config, provenance))

    assert describe_file(there)["version"] == "1.3"
    assert load_model(there).config == rotate_frame(model).config
    assert describe_file(back)["version"] == VERSION_BY_OLDER_FILE[name]
    with Container.open(source) as old, Container.open(back) as new:
        assert all(bytes(old[name].data) == bytes(new[name].data) for name in old.entries if name != "META")


@pytest.mark.parametrize(("profile", "version"), [("raw", "1.0"), ("paper", "1.0")])
def test_a_saved_model_states_a_rotation_only_if_it_has_one(profile, version, tmp_path):
    model = load_model(GOLDEN_FOLDER / "v1.0_raw.hyrf")

    save_model(model, tmp_path / "straight.hyrf", profile)
    save_model(rotate_frame(model), tmp_path / "rotated.hyrf", profile)

    straight, rotated = (describe_file(tmp_path / f"{name}.hyrf") for name in ("straight", "rotated"))
    assert straight["version"] == version and "rotation" not in straight["config"]["frame"]
    assert rotated["version"] == "1.3" and rotated["config"]["frame"]["rotation"] == list(ROTATION)


def test_a_rotation_of_nearly_unit_length_is_read_and_normalised():
    frame = decode_model(file_with_rotation([0, 1 - 9e-7, 0, 0])).config.frame

    assert frame.to_world([[1.0, 2.0, 3.0]]).tolist() == [[1.0, -2.0, -3.0]]  # half a turn about x, exactly


@pytest.mark.parametrize(
    "rotation",
    [
        *([], [1, 0, 0], [1, 0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0.01], [1 + 2e-6, 0, 0, 0], [1e308] * 4),
        *(["1", 0, 0, 0], [True, 0, 0, 0], [None, 0, 0, 1], 1, None, {"w": 1}, [[1, 0, 0, 0]], [10**400, 0, 0, 0]),
    ],
    ids=repr,
)
def test_other_rotations_are_refused(rotation):
    with pytest.raises(HyrfFormatError, match="rotation"):
        decode_model(file_with_rotation(rotation))
