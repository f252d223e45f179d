"""The actions of the player's editor keep the same Gaussians as the command that it shows."""

from __future__ import annotations

import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layers import only_in_acceptance
from web.native_models import MODEL_FRAME, encode_with_photos, random_model
from web.scripts import run_script

from hyrfpack.cli.edit import edit
from hyrfpack.config.edit import Scale
from hyrfpack.edit.transform import move_frame, placement_of
from hyrfpack.errors import HyrfError
from hyrfpack.format import load_model
from hyrfpack.model import Frame

ROTATED_FRAME = replace(MODEL_FRAME, rotation=(0.5, -0.5, 0.1, 0.7))
FAR_FRAME = Frame((512_000.0, 5_403_000.0, 310.0), 40.0, (1.0, 1.0, 0.4))
CROP_BOX_ACTION = {"option": "crop-box", "value": [7.1, -22.5, 2.0, 12.25, -18.0, 6.5]}
OTHER_BOX = {"option": "crop-box", "value": [9.0, -21.0, 4.0, 30.0, 30.0, 30.0], "isInverted": True}
TURNED_BOX = {"option": "crop-box", "value": [-30.0, -6.0, -40.0, 40.0, 20.0, 40.0]}
FAR_BOX = {"option": "crop-box", "value": [511_990.0, 5_402_980.5, 300.0, 512_031.0, 5_403_010.0, 330.0]}
UP = {"option": "up", "value": [0.3, -0.8, 0.52]}
CASES: dict[str, tuple[Frame, list[dict]]] = {
    "a box": (MODEL_FRAME, [CROP_BOX_ACTION]),
    "a box in a rotated frame": (ROTATED_FRAME, [CROP_BOX_ACTION]),
    "a box far from the origin": (FAR_FRAME, [FAR_BOX]),
    "two boxes, one inverted": (MODEL_FRAME, [CROP_BOX_ACTION, OTHER_BOX]),
    "faint and large Gaussians": (
        MODEL_FRAME,
        [{"option": "min-opacity", "value": 0.6}, {"option": "max-scale", "value": 0.35}],
    ),
    "a box turned about up": (ROTATED_FRAME, [UP, {**CROP_BOX_ACTION, "value": [*CROP_BOX_ACTION["value"], 37.5]}]),
    "a turned box after a turn to +z, inverted": (
        MODEL_FRAME,
        [
            UP,
            {"option": "upright", "value": "z"},
            {"option": "scale", "value": 2.0},
            {**OTHER_BOX, "value": [-60.0, -30.0, -80.0, 40.0, 10.0, 60.0, -120.5]},
        ],
    ),
    "a box after a turn to +y": (MODEL_FRAME, [UP, {"option": "upright", "value": "y"}, TURNED_BOX]),
    "a box after a turn to +z": (ROTATED_FRAME, [UP, {"option": "upright", "value": "z"}, TURNED_BOX]),
    "a box and a length between two scales": (
        ROTATED_FRAME,
        [
            {"option": "scale", "value": 2.5},
            {"option": "crop-box", "value": [17.5, -56.25, 5.0, 30.625, -45.0, 16.25]},
            {"option": "max-scale", "value": 1.1},
            {"option": "scale", "value": 0.4},
            UP,
            {"option": "upright", "value": "y"},
            {"option": "max-scale", "value": 0.4},
        ],
    ),
}


def run_edits(path: Path, actions: list[dict]) -> dict:
    (path.parent / "actions.json").write_text(json.dumps(actions))
    return run_script(Path(__file__).with_name("edits.mjs"), path, path.parent / "actions.json")


# Each of these has its actions and its frame in common with other cases.
SIMILAR_CASES = {
    "a box in a rotated frame",
    "two boxes, one inverted",
    "a box after a turn to +y",
    "a box after a turn to +z",
}


@pytest.mark.parametrize("name", only_in_acceptance(CASES, SIMILAR_CASES))
def test_the_player_keeps_the_gaussians_that_its_command_keeps(name: str, tmp_path: Path, monkeypatch):
    frame, actions = CASES[name]
    path = tmp_path / "it's a scene.hyrf"
    model = random_model(2600, frame=frame)
    path.write_bytes(encode_with_photos(model, width=8))

    found = run_edits(path, actions)
    program, *arguments = shlex.split(found["command"])
    monkeypatch.chdir(tmp_path)
    edit.main(arguments[1:], standalone_mode=False)

    edited = load_model(tmp_path / "it's a scene-edited.hyrf")
    assert program == "hyrfpack" and 100 < len(edited) < 2500
    np.testing.assert_array_equal(
        edited.gaussians.positions.detach(), model.gaussians.positions.detach()[found["left"]]
    )
    assert found["counts"][-1] == len(edited)


def test_a_direction_that_is_stated_after_a_box_does_not_turn_the_box(tmp_path: Path):
    script = tmp_path / "put.mjs"
    module = Path(__file__).parents[2] / "hyrfpack" / "web" / "viewer" / "edit" / "actions.js"
    before = [{"option": "up", "value": [0, 0, 1]}, {"option": "crop-box", "value": [0, 0, 0, 1, 1, 1, 30]}]
    later, last = ({"option": "up", "value": value} for value in ([0, 1, 0], [1, 0, 0]))
    script.write_text(
        f"import {{ putAction }} from {json.dumps(module.as_uri())};\n"
        f"const later = putAction({json.dumps(before)}, {json.dumps(later)});\n"
        f"console.log(JSON.stringify([later, putAction(later, {json.dumps(last)})]));\n"
    )
    assert run_script(script) == [[*before, later], [*before, last]]


@pytest.mark.parametrize("factor", [-1.0, 0.0, 1e-32, 1e-31, 1.0, 1e23, 1e24, math.inf, math.nan])
def test_the_player_scales_only_to_sizes_that_the_command_accepts(factor: float, tmp_path: Path):
    script = tmp_path / "storable.mjs"
    module = Path(__file__).parents[2] / "hyrfpack" / "web" / "viewer" / "edit" / "actions.js"
    actions = json.dumps([{"option": "scale", "value": factor}])  # infinite numbers and NaN are those of JavaScript
    scene = json.dumps({"center": FAR_FRAME.center, "unit": FAR_FRAME.scale, "up": [0, -1, 0]})
    script.write_text(
        f"import {{ isStorable }} from {json.dumps(module.as_uri())};\n"
        f"console.log(JSON.stringify(isStorable({actions}, {scene})));\n"
    )
    try:
        move_frame(placement_of(Scale(factor)), FAR_FRAME)
        is_accepted = True
    except (HyrfError, ValueError):
        is_accepted = False
    assert run_script(script) == is_accepted


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("bonsai.hyrf", "hyrfpack edit bonsai.hyrf -o bonsai-edited.hyrf"),
        ("C:\\my scenes\\a.HYRF", "hyrfpack edit 'C:\\my scenes\\a.HYRF' -o a-edited.hyrf"),
        ("-rf $(x).hyrf", "hyrfpack edit './-rf $(x).hyrf' -o './-rf $(x)-edited.hyrf'"),
        ("Bob's room.hyrf", '''hyrfpack edit "Bob's room.hyrf" -o "Bob's room-edited.hyrf"'''),
        ("Bob\u2019s room.hyrf", 'hyrfpack edit "Bob\u2019s room.hyrf" -o "Bob\u2019s room-edited.hyrf"'),
        ("C:\\Bob's\\a.hyrf", """hyrfpack edit "C:\\Bob's\\a.hyrf" -o a-edited.hyrf"""),
        ("Bob's $5.hyrf", r"hyrfpack edit 'Bob'\''s $5.hyrf' -o 'Bob'\''s $5-edited.hyrf'"),
    ],
)
def test_a_command_names_files_safely(file: str, words: str, tmp_path: Path):
    script = tmp_path / "name.mjs"
    module = Path(__file__).parents[2] / "hyrfpack" / "web" / "viewer" / "edit" / "actions.js"
    script.write_text(
        f"import {{ commandText }} from {json.dumps(module.as_uri())};\n"
        f"console.log(JSON.stringify(commandText([{{ option: 'up', value: [0, 0, 1] }}], {json.dumps(file)})));\n"
    )
    assert run_script(script) == f"{words} --up=0,0,1"
