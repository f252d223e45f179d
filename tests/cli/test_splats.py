"""Splats of other programs, and `hyrfpack convert`, on the command line."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import refused, succeeded
from explicit_balls import ball_splats
from PIL import Image
from scenes import ring, small_model

from hyrfpack.cameras.capture import scene_provenance
from hyrfpack.cameras.files import cameras_to_json
from hyrfpack.data import load_scene
from hyrfpack.format import save_model
from hyrfpack.model import Frame
from hyrfpack.splats.files import READABLE_ENDINGS
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.hints import NO_HINTS
from hyrfpack.splats.names import SPLATS_SUFFIXES, is_splats
from hyrfpack.splats.table import FORMATS

BALL_SPLATS = ball_splats(60)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    """The same splats in every format that can be read, and as an unbundled SOG."""
    folder = tmp_path_factory.mktemp("splats")
    paths = {ending: folder / f"ball{ending}" for ending in READABLE_ENDINGS}
    for ending, path in paths.items():
        path.write_bytes(FORMATS[ending].encode(BALL_SPLATS, NO_HINTS))
    loose = folder / "loose"
    loose.mkdir()
    for name, data in sog.encode_files(BALL_SPLATS).items():
        (loose / name).write_bytes(data)
    return {**paths, "loose": loose, "meta.json": loose / "meta.json"}


FILE_KINDS = [*SPLATS_SUFFIXES, "loose", "meta.json"]


def test_every_ending_of_splats_is_recognised():
    assert sorted(SPLATS_SUFFIXES) == sorted(READABLE_ENDINGS)


def test_a_folder_with_another_meta_json_is_not_read_as_splats(tmp_path):
    (tmp_path / "meta.json").write_text('{"camera": 1}')
    assert not is_splats(tmp_path) and not is_splats(tmp_path / "meta.json")
    assert "poses are described with their photos" in refused("info", tmp_path / "meta.json")


@pytest.mark.parametrize("name", ["none.glb", "none.json", "meta.json", "none.hyrf"])
def test_info_says_of_a_missing_file_that_it_is_missing(name, tmp_path):
    assert f"{name}: there is no such file" in refused("info", tmp_path / name)


def test_info_prints_escapes_for_unprintable_characters_of_a_name(files, tmp_path):
    path = tmp_path / "a\x1b[31m.ply"
    path.write_bytes(files[".ply"].read_bytes())
    assert succeeded("info", path).stdout.splitlines()[0].startswith(f"{tmp_path}/a\\x1b[31m.ply: ")


@pytest.mark.parametrize("kind", FILE_KINDS)
def test_info_prints_format_count_degree_bounds_and_bytes(kind, files):
    path = files[kind]
    facts = json.loads(succeeded("info", path, "--json").stdout)
    loose = kind in ("loose", "meta.json")
    size = sum(file.stat().st_size for file in files["loose"].iterdir()) if loose else path.stat().st_size
    assert (facts["gaussians"], facts["bytes"]) == (60, size)
    assert facts["format"] == ("sog folder" if loose else kind[1:])
    assert facts["degree"] == min(1, FORMATS[".sog" if loose else kind].max_degree)
    assert facts["low"] == pytest.approx(BALL_SPLATS.positions.min(0), abs=2e-3)
    assert facts["high"] == pytest.approx(BALL_SPLATS.positions.max(0), abs=2e-3)
    printed = succeeded("info", path).stdout
    assert printed.splitlines()[0] == f"{path}: {size:,} bytes, 60 Gaussians"
    assert f"degree {facts['degree']}" in printed and "centres" in printed


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        pytest.param((500123.4, 4e6, 98.7), (500321.9, 4000150, 131.3), "500123.4", id="map"),
        pytest.param(
            (-0.0001, -1, 0), (2.5, 1.5, 3.25), "from (0.000, -1.000, 0.000) to (2.500, 1.500, 3.250)", id="room"
        ),
        pytest.param((-409.7, 0, 0), (1000, 2e5, 1e6), "from (-410, 0, 0) to (1000, 200000, 1000000)", id="sky"),
        pytest.param((0, 0, 0), (0.01, 0, 0.02), "to (0.01000, 0.00000, 0.02000)", id="insect"),
        pytest.param((500123.5, 0, 0), (500123.5, 0, 0), "from (500123.5, 0, 0) to (500123.5, 0, 0)", id="one place"),
    ],
)
def test_info_prints_positions_to_a_thousandth_of_the_box(low, high, expected, tmp_path):
    splats = replace(BALL_SPLATS[:2], positions=np.array([low, high], np.float64))
    path = tmp_path / "box.ply"
    path.write_bytes(FORMATS[".ply"].encode(splats, NO_HINTS))
    (line,) = (line for line in succeeded("info", path).stdout.splitlines() if "centres" in line)
    assert expected in line and "e+" not in line


def test_info_prints_the_box_of_a_model_in_map_coordinates_with_decimals(tmp_path):
    frame = Frame((500123.44, 4000000.56, 98.7), 50.0, (1.0, 1.0, 0.5))
    save_model(small_model(np.zeros((1, 3)), frame=frame, fields=0.0), tmp_path / "survey.hyrf")
    box = "100.0 x 100.0 x 50.0 around (500123.4, 4000000.6, 98.7), world units"
    assert box in succeeded("info", tmp_path / "survey.hyrf").stdout


@pytest.mark.parametrize("kind", FILE_KINDS)
def test_render_draws_splats_from_given_cameras_and_from_an_orbit(kind, files, tmp_path):
    cameras = ring(2, width=24, height=24)
    (tmp_path / "path.json").write_text(cameras_to_json([(f"c{n}", camera) for n, camera in enumerate(cameras)]))
    succeeded("render", files[kind], "-o", tmp_path / "out", "--cameras", tmp_path / "path.json")
    pictures = [np.asarray(Image.open(tmp_path / "out" / f"c{n}.png")) for n in range(2)]
    assert all(picture.shape == (24, 24, 3) and picture[12, 12].max() > 30 for picture in pictures)
    assert all(picture[0, 0].max() == 0 for picture in pictures)  # the background is black


def test_an_orbit_of_splats_is_centred_on_them(files, tmp_path):
    succeeded("render", files[".ply"], "-o", tmp_path / "out", "--orbit", 3)
    for path in (tmp_path / "out").iterdir():
        picture = np.asarray(Image.open(path)).max(axis=2) > 20
        assert picture[300, 400] and not picture[0, 0] and picture.mean() > 0.05


def test_depth_and_normals_of_splats_are_in_world_units_and_axes(tmp_path):
    opaque = replace(BALL_SPLATS, opacities=np.full(60, 0.99, np.float32), scales=np.full((60, 3), 0.3, np.float32))
    (tmp_path / "ball.ply").write_bytes(FORMATS[".ply"].encode(opaque, NO_HINTS))
    (camera,) = ring(1, radius=5.0, elevation=0.0, width=33, height=33)
    (tmp_path / "path.json").write_text(cameras_to_json([("c", camera)]))
    words = ("render", tmp_path / "ball.ply", "-o", tmp_path / "out", "--cameras", tmp_path / "path.json")
    succeeded(*words, "--depth", "--normals")
    depth = np.asarray(Image.open(tmp_path / "out" / "c.depth.tiff"))
    assert 3 < depth[16, 16] < 5 and depth[0, 0] == 0  # a ball of radius 1 seen from a distance of 5
    toward_camera = -camera.forward
    normal = np.asarray(Image.open(tmp_path / "out" / "c.normals.png"))[16, 16] / 127.5 - 1
    assert normal @ toward_camera > 0.8


def test_an_exported_file_has_the_score_that_the_export_printed(data, tmp_path):
    positions = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))
    trained_on = scene_provenance(load_scene(data))
    save_model(small_model(positions, fields=2.0, background=True), tmp_path / "model.hyrf", provenance=trained_on)
    export = ("export", tmp_path / "model.hyrf", "-o", tmp_path / "a.ply", "--data", data, "--sh-degree", 1, "--json")
    messages = json.loads(succeeded(*export).stdout)
    scored = {
        name: json.loads(succeeded("evaluate", tmp_path / name, "--data", data, "--json").stdout)
        for name in ("a.ply", "model.hyrf")
    }
    assert scored["a.ply"]["psnr"] == pytest.approx(messages["photos_file"], abs=0.01)
    assert scored["model.hyrf"]["psnr"] == pytest.approx(messages["photos_model"], abs=0.01)
    assert scored["a.ply"]["gaussians"] == messages["gaussians"]
    assert scored["a.ply"]["bytes"] == (tmp_path / "a.ply").stat().st_size


def test_evaluate_writes_pictures_of_splats_too(files, data, tmp_path):
    succeeded("evaluate", files[".spz"], "--data", data, "--pictures", tmp_path / "pictures")
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 2


@pytest.mark.parametrize("command", ["render", "evaluate"])
def test_part_of_a_splats_file_is_rejected(command, files, data, tmp_path):
    output = ("-o", tmp_path / "out") if command == "render" else ()
    messages = refused(command, files[".ply"], "--data", data, "--allow-partial", *output)
    assert "splats are read whole; leave out --allow-partial" in messages


@pytest.mark.parametrize("arguments", [("compress", "{}", "-o", "x.hyrf"), ("decompress", "{}", "-o", "x.hyrf")])
def test_commands_for_models_reject_splats_and_name_the_import(arguments, files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    messages = refused(*(word.format(files[".ply"]) for word in arguments))
    assert f"import it first: 'hyrfpack import {files['.ply']} -o ball.hyrf'" in messages


def test_export_of_splats_names_convert_or_import(files, tmp_path):
    convert = f"'hyrfpack convert {files['.ply']} {tmp_path / 'a.spz'}'"
    assert convert in refused("export", files[".ply"], "-o", tmp_path / "a.spz")
    assert f"'hyrfpack import {files['.ply']} -o ball.hyrf'" in refused(
        "export", files[".ply"], "-o", tmp_path / "a.html"
    )


@pytest.mark.parametrize("command", ["view", "export"])
def test_a_page_of_an_unbundled_sog_is_rejected(command, files, tmp_path):
    output = ("-o", tmp_path / "player") if command == "export" else ("--no-browser",)
    assert f"'hyrfpack convert {files['loose']} " in refused(command, files["loose"], *output)


# -- convert -----------------------------------------------------------------------------------------------------------


def test_convert_describes_input_and_output(files, tmp_path):
    target = tmp_path / "a.splat"
    result = succeeded("convert", files[".ply"], target)
    rows = [re.split(r" {2,}", line) for line in result.stdout.splitlines()]
    assert rows[0] == ["file", "Gaussians", "SH degree", "bytes"]
    assert rows[2] == ["ball.ply", "60", "1", f"{files['.ply'].stat().st_size:,}"]
    assert rows[3] == ["a.splat", "60", "0", f"{32 * 60:,}"]
    assert re.fullmatch(
        r"PSNR against renders of .*, 12 views: mean \d+\.\d\d dB, worst \d+\.\d\d dB", result.stdout.splitlines()[-1]
    )
    assert "stores harmonics up to degree 0" in result.stderr


@pytest.mark.acceptance
def test_convert_prints_json_and_replaces_only_with_overwrite(files, tmp_path):
    target = tmp_path / "a.spz"
    options = ("--sh-degree", 0, "--crop", "-9,-9,-9,9,9,0", "--min-opacity", 0.5, "--json")
    report = json.loads(succeeded("convert", files[".ply"], target, *options).stdout)
    wanted = ((BALL_SPLATS.positions[:, 2] <= 0) & (BALL_SPLATS.opacities >= 0.5)).sum()
    assert (report["gaussians_before"], report["gaussians_after"], report["degree_after"]) == (60, wanted, 0)
    before = target.read_bytes()
    assert "replace it with --overwrite" in refused("convert", files[".sog"], target)
    assert target.read_bytes() == before
    succeeded("convert", files[".sog"], target, "--overwrite")
    assert target.read_bytes() != before


def test_convert_never_writes_into_the_unbundled_sog_that_it_reads(files, tmp_path):
    loose = shutil.copytree(files["loose"], tmp_path / "loose")
    for name in ("new.ply", "means_l.webp"):
        assert refused("convert", loose, loose / name, "--overwrite")
    assert sorted(path.name for path in loose.iterdir()) == sorted(path.name for path in files["loose"].iterdir())
