"""Files of depth and normals: read back by other programs, with nothing lost silently."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from commands import hyrfpack, refused, succeeded
from PIL import Image
from scenes import ball_points, ring, small_model

from hyrfpack.cameras.files import cameras_from_json, cameras_to_json
from hyrfpack.config.render import GeometryConfig
from hyrfpack.errors import HyrfError
from hyrfpack.format import load_model
from hyrfpack.render.files import make_renderer, render_file_names, render_files
from hyrfpack.render.geometry_files import GeometryWriter, encode_depth, encode_normals

MODEL_FILE = Path(__file__).parents[1] / "golden" / "trained" / "demo_compact.hyrf"


def read_png_with_ffmpeg(data: bytes) -> np.ndarray:
    """Read a picture with ffmpeg's decoder, which shares no code with Pillow."""
    with av.open(io.BytesIO(data), format="png_pipe") as file:
        return next(file.decode(video=0)).to_ndarray()


def depth_map() -> np.ndarray:
    depth = np.random.default_rng(0).uniform(0.5, 60, (20, 30)).astype(np.float32)
    depth[:5] = 0
    return depth


# -- depth ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", [0.001, 0.01, 1 / 1024])
def test_a_png_holds_depth_in_steps_of_the_unit_that_it_states(unit):
    depth = depth_map()
    data = encode_depth(depth, "png", unit)
    steps = read_png_with_ffmpeg(data)
    assert steps.dtype == np.uint16 and (steps == np.asarray(Image.open(io.BytesIO(data)))).all()
    assert np.abs(steps * unit - depth).max() <= unit / 2 * (1 + 1e-6)
    assert f"1 step = {unit!r} world units; 0 = no surface" in Image.open(io.BytesIO(data)).text["Description"]


def test_a_png_is_zero_only_where_there_is_no_surface_or_no_step_for_it():
    depth = np.array([[0, 1e-6, 65.535, 65.5354, 65.536, 1e9]], np.float32)
    assert read_png_with_ffmpeg(encode_depth(depth, "png", 0.001)).tolist() == [[0, 1, 65535, 65535, 0, 0]]


def test_a_tiff_holds_the_exact_depth():
    depth = depth_map()
    assert (np.asarray(Image.open(io.BytesIO(encode_depth(depth, "tiff", 1.0)))) == depth).all()


def test_an_exr_holds_the_exact_depth_as_channel_z(tmp_path):
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
    depth = depth_map()
    (tmp_path / "a.exr").write_bytes(encode_depth(depth, "exr", 1.0))
    with openexr.File(str(tmp_path / "a.exr")) as file:
        assert list(file.channels()) == ["Z"]
        assert file.channels()["Z"].pixels.dtype == np.float32 and (file.channels()["Z"].pixels == depth).all()


@pytest.mark.parametrize(
    ("largest", "warning"),
    [
        (65.5, None),
        (0.3, None),
        (0.0, None),
        (812.0, "depths reach 812 units, but 16-bit steps of 0.001 units end at 65.53; pixels beyond are 0"),
        (0.2, "depths reach only 0.2 units, which are 200 steps of 0.001 units"),
    ],
)
def test_depths_that_do_not_suit_16_bits_are_reported_with_a_unit_that_does(largest, warning, caplog):
    writer = GeometryWriter(GeometryConfig("png"))
    writer.warn_of_losses(largest)
    assert [record.levelname for record in caplog.records] == (["WARNING"] if warning else [])
    if warning:
        assert warning in caplog.text
        unit = float(caplog.text.split("`depth_unit=")[1].split("`")[0])
        assert 30_000 < largest / unit <= 65_535
    GeometryWriter(GeometryConfig("tiff")).warn_of_losses(1e9)
    assert len(caplog.records) == (1 if warning else 0)


# -- normals ----------------------------------------------------------------------------------------------------------


def unit_normals() -> np.ndarray:
    normals = np.random.default_rng(0).normal(size=(20, 30, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[:5] = 0
    return normals.astype(np.float32)


def test_a_png_holds_normals_as_half_n_plus_a_half():
    normals = unit_normals()
    codes = read_png_with_ffmpeg(encode_normals(normals, "png"))
    assert np.abs(codes / 255 - (0.5 * normals + 0.5)).max() <= 0.5 / 255 + 1e-6
    assert (codes[:5] == 128).all()
    assert read_png_with_ffmpeg(encode_normals(np.eye(3)[None], "png")).tolist() == [
        [[255, 128, 128], [128, 255, 128], [128, 128, 255]]
    ]


def test_an_exr_holds_exact_normals_as_r_g_and_b(tmp_path):
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
    normals = unit_normals()
    (tmp_path / "a.exr").write_bytes(encode_normals(normals, "exr"))
    with openexr.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        channels = file.channels()
        assert sorted(channels) == ["B", "G", "R"]
        assert all((channels[name].pixels == normals[..., axis]).all() for axis, name in enumerate("RGB"))
    with av.open(str(tmp_path / "a.exr")) as file:  # a second reader
        assert next(file.decode(video=0)).format.name.startswith("gbrp")


def test_files_are_the_same_for_the_same_picture():
    pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
    for extension in ("png", "exr"):
        assert encode_normals(unit_normals(), extension) == encode_normals(unit_normals(), extension)
        assert encode_depth(depth_map(), extension, 0.1) == encode_depth(depth_map(), extension, 0.1)


# -- renders ----------------------------------------------------------------------------------------------------------


def test_rendered_files_hold_the_surface_of_the_render(tmp_path):
    points, _ = ball_points(300)
    model, camera = small_model(points, scale_logits=-2.0), ring(1)[0]
    geometry = GeometryConfig("tiff", "png")
    (path,) = render_files(model, [("deep/a.jpg", camera)], tmp_path, geometry=geometry)
    expected = make_renderer(model, geometry=geometry)(camera)
    assert expected.depth is not None and expected.normals is not None and expected.depth.max() > 0
    assert (np.asarray(Image.open(tmp_path / "deep" / "a.depth.tiff")) == expected.depth.numpy()).all()
    codes = np.asarray(Image.open(path.with_suffix(".normals.png")))
    assert np.abs(codes / 255 - (0.5 * expected.normals.numpy() + 0.5)).max() <= 0.5 / 255 + 1e-6
    assert render_file_names(["deep/a.jpg"], geometry) == ["deep/a.png", "deep/a.depth.tiff", "deep/a.normals.png"]


def test_two_files_of_one_name_are_refused():
    cameras = ["a", "a.depth"]
    assert len(render_file_names(cameras, GeometryConfig("tiff"))) == 4
    with pytest.raises(HyrfError, match=r"a\.depth\.png: two of the files"):
        render_file_names(cameras, GeometryConfig("png"))


def test_files_whose_names_differ_in_case_only_are_refused():
    with pytest.raises(HyrfError, match=r"[aA]\.depth\.png: two of the files"):
        render_file_names(["A", "a.depth"], GeometryConfig("png"))


def test_a_file_with_the_name_of_a_folder_is_refused():
    with pytest.raises(HyrfError, match=r"b\.png: a file and a folder"):
        render_file_names(["b", "b.png/c"])


def test_without_overwrite_geometry_is_named_after_the_picture_that_was_written(tmp_path):
    (tmp_path / "a.png").write_bytes(b"of an earlier run")
    camera = ring(1, radius=3.0, width=30, height=20)[0]
    files = render_files(
        load_model(MODEL_FILE), [("a", camera)], tmp_path, geometry=GeometryConfig("tiff"), overwrite=False
    )
    assert [path.name for path in files] == ["a-2.png"]
    assert sorted(path.name for path in tmp_path.iterdir() if path.suffix != ".lock") == [
        "a-2.depth.tiff",
        "a-2.png",
        "a.png",
    ]


def test_without_the_package_openexr_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    sentence = refused("render", MODEL_FILE, "-o", tmp_path / "out", "--orbit", 2, "--depth", "exr")
    assert "writing OpenEXR files needs OpenEXR; run 'pip install \"hyrfpack[exr]\"'" in sentence
    assert not (tmp_path / "out").exists()


def test_the_command_writes_geometry_with_the_cameras_that_saw_it(tmp_path):
    cameras = [(f"c{number}", camera) for number, camera in enumerate(ring(2, radius=3.0, width=30, height=20))]
    (tmp_path / "path.json").write_text(cameras_to_json(cameras))
    words = ("render", MODEL_FILE, "-o", tmp_path / "out", "--cameras", tmp_path / "path.json", "--normals")
    result = succeeded(*words, "--depth", "png", "--depth-unit", "0.00001", "--json")
    names = {"cameras.json"} | {f"c{n}{end}" for n in range(2) for end in (".png", ".depth.png", ".normals.png")}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    assert cameras_from_json(tmp_path / "out" / "cameras.json") == cameras
    assert "units end at 0.6554; pixels beyond are 0. Use --depth-unit" in result.stderr
    assert [Path(path).name for path in json.loads(result.stdout)["pictures"]] == ["c0.png", "c1.png"]
    assert "of the files to be written are there" in refused(*words)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--depth", "jpg"), "'jpg' is not one of 'tiff', 'png', 'exr'"),
        (("--normals", "tiff"), "'tiff' is not one of 'png', 'exr'"),
        (("--depth-unit", "0.01"), "give it with --depth png"),
        (("--depth", "exr", "--depth-unit", "0.01"), "give it with --depth png"),
        (("--depth", "png", "--depth-unit", "0"), "--depth-unit"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, problem, tmp_path):
    result = hyrfpack("render", MODEL_FILE, "-o", tmp_path / "out", *options)
    assert result.exit_code == 2 and problem in result.stderr and not (tmp_path / "out").exists()
