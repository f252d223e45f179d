"""Hostile scenes, pictures, points, cameras and checkpoints are read or refused in one line.

tests/data covers COLMAP's three binary tables, transforms.json and single damaged bytes of pictures. This file covers
COLMAP's text tables, rigs and frames, Blender's JSON, PLY, camera files, headers of pictures with repaired checksums,
and checkpoints with a repaired digest.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import math
import struct
import tracemalloc
import zlib
from pathlib import Path
from random import Random

import numpy as np
import pycolmap
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from property_tests import examples

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.files import cameras_from_json
from hyrfpack.cameras.paths import Viewpoint, orbit
from hyrfpack.data import load_scene
from hyrfpack.data.pictures import read_header, read_pixels
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.train.checkpoint import load_checkpoint, save_checkpoint
from tools.safety.fuzz_mutate import EXTREME_INTEGERS, HOSTILE_JSON, edit_bytes, list_json_values

# Hypothesis draws only a seed, because mutants are cheap and need no shrinking.
seeded_rng = st.integers(0, 2**32 - 1).map(Random)
with_70_examples = examples(70)

HOSTILE_VALUES = (*HOSTILE_JSON, math.nan, math.inf, "x" * 5000, "a\0b", [[1.0] * 4] * 4, [[1e200] * 4] * 4, [[]] * 4)
IDENTITY_POSE = np.eye(4).tolist()
INTRINSICS_JSON = {"fl_x": 30.0, "fl_y": 31.0, "cx": 17.0, "cy": 11.0, "w": 32, "h": 24}


def check_read_or_refused(read) -> bool:
    """Return whether `read()` succeeds; fail if it raises anything but a HyrfError of one printable line."""
    try:
        read()
    except HyrfError as error:
        assert str(error).isprintable() and 10 < len(str(error)) < 6000
        return False
    return True


def load_pictures(root: Path, layout: str | None = None) -> None:
    for view in load_scene(root, layout=layout, test_every=0).views:
        view.load()


def forge_json(values: dict | list, rng: Random) -> bytes:
    """Delete, double or replace one or two values and return JSON; damage the text too in a tenth of the cases."""
    values = json.loads(json.dumps(values))
    for _ in range(rng.randint(1, 2)):
        node, key = rng.choice(list_json_values(values))
        kind = rng.randrange(4)
        if kind == 0:
            del node[key]
        elif kind == 1 and isinstance(node, list):
            node.append(node[key])
        else:
            node[key] = json.loads(json.dumps(rng.choice(HOSTILE_VALUES)))
        if not values:
            break
    text = json.dumps(values).encode()
    return edit_bytes(text, rng) if rng.random() < 0.1 else text


def frame_entries(names: list[str]) -> list[dict]:
    return [{"file_path": name, "transform_matrix": IDENTITY_POSE} for name in names]


@pytest.fixture(scope="module")
def root(tmp_path_factory, folders) -> Path:
    """Create a folder with three pictures to which transforms files refer."""
    root = tmp_path_factory.mktemp("hostile")
    folders.write_pictures(root, [f"images/{index}.png" for index in range(3)])
    return root


def test_the_files_to_be_forged_are_read_unchanged(root, colmap):
    for tables in colmap[2:]:
        write_tables(colmap[1], tables)
        load_pictures(colmap[0])
    (root / "transforms_train.json").write_text(json.dumps(BLENDER_TRANSFORMS))
    load_pictures(root, "blender")
    for cameras in (HYRFPACK_CAMERAS, NERFSTUDIO_CAMERAS, ANGLE_CAMERAS):
        (root / "cameras.json").write_text(json.dumps(cameras))
        assert len(cameras_from_json(root / "cameras.json")) == len(
            cameras if cameras is HYRFPACK_CAMERAS else cameras["frames"]
        )
    (root / "transforms.json").write_text(json.dumps(TRANSFORMS_WITH_POINTS))
    for data in encode_point_files():
        (root / "points.ply").write_bytes(data)
        assert len(load_scene(root, layout="nerfstudio", test_every=0).points) == 5
    for suffix, data in PICTURE_FILES:
        (root / f"a.{suffix}").write_bytes(data)
        assert read_header(root / f"a.{suffix}").width == 32


# --- COLMAP ---


@pytest.fixture(scope="module")
def colmap(tmp_path_factory, folders):
    """Return (root, model folder, text tables, binary tables) of a COLMAP set with rigs and frames."""
    root = tmp_path_factory.mktemp("colmap")
    folder = folders.ColmapFolder(root, count=3, model=4, params=(30.0, 31, 17, 11, 0.1, 0.01, 0.001, 0.002))
    model = pycolmap.Reconstruction(str(folder.model))
    tables = []
    for write in (model.write_text, model.write_binary):
        for old in folder.model.iterdir():
            old.unlink()
        write(str(folder.model))
        tables.append({file.name: file.read_bytes() for file in folder.model.iterdir()})
    return root, folder.model, *tables


def write_tables(model: Path, tables: dict[str, bytes]) -> None:
    for old in model.iterdir():
        old.unlink()
    for name, content in tables.items():
        (model / name).write_bytes(content)


HOSTILE_WORDS = (
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e400",
    b"9" * 30,
    b"9223372036854775807",
    b"4294967295",
    b"x",
    b"",
    b"\0",
    b"FOV",
)


@with_70_examples
@given(rng=seeded_rng)
def test_forged_colmap_text_tables_are_read_or_refused(colmap, rng):
    root, model, tables, _ = colmap
    forged = dict(tables)
    for _ in range(rng.randint(1, 2)):
        name = rng.choice(list(forged))
        lines = forged[name].split(b"\n")
        at = rng.randrange(len(lines))
        words = lines[at].split(b" ")
        words[rng.randrange(len(words))] = rng.choice(HOSTILE_WORDS)
        kind = rng.randrange(5)
        lines[at : at + 1] = [[], [lines[at]] * 2, [b" ".join(words)]][min(kind, 2)]
        forged[name] = b"\n".join(lines)
    write_tables(model, forged)

    check_read_or_refused(lambda: load_pictures(root))


@with_70_examples
@given(rng=seeded_rng)
def test_forged_colmap_binary_tables_with_rigs_are_read_or_refused(colmap, rng):
    root, model, _, tables = colmap
    forged = dict(tables)
    for _ in range(rng.randint(1, 3)):
        name = rng.choice(["rigs.bin", "frames.bin", *tables])
        content = bytearray(forged[name])
        width, at = rng.choice((4, 8)), rng.randrange(len(content) + 1)
        value = rng.choice((*EXTREME_INTEGERS, *struct.unpack("<2Q", struct.pack("<2d", math.nan, 1e300))))
        content[at : at + width] = (value % 256**width).to_bytes(width, "little")
        forged[name] = bytes(content)
    write_tables(model, forged)

    check_read_or_refused(lambda: load_pictures(root))


# --- transforms files and cameras ---

BLENDER_TRANSFORMS = {"camera_angle_x": 0.9, "frames": frame_entries([f"images/{index}" for index in range(3)])}


@with_70_examples
@given(rng=seeded_rng)
def test_forged_blender_sets_are_read_or_refused(root, rng):
    (root / "transforms_train.json").write_bytes(forge_json(BLENDER_TRANSFORMS, rng))

    check_read_or_refused(lambda: load_pictures(root, "blender"))


@pytest.mark.parametrize("angle", [5e-324, 1e-320, 0, -1, 3.2, 1e308])
def test_angles_without_a_focal_length_are_refused(root, angle):
    content = {"camera_angle_x": angle, "frames": frame_entries(["images/0"])}
    (root / "transforms_train.json").write_text(json.dumps(content))

    with pytest.raises(HyrfDataError):
        load_scene(root, layout="blender", test_every=0)


def test_points_with_an_overlong_file_name_are_reported_as_missing(root):
    content = {**INTRINSICS_JSON, "frames": frame_entries(["images/0.png"]), "ply_file_path": "x" * 5000}
    (root / "transforms.json").write_text(json.dumps(content))

    with pytest.raises(HyrfDataError, match="are not on disk"):
        load_scene(root, layout="nerfstudio", test_every=0)


HYRFPACK_CAMERAS = [
    {"name": "a", "width": 40, "height": 30, "fx": 25, "fy": 2, "cx": 2, "cy": 1, "camera_from_world": IDENTITY_POSE}
] * 2
NERFSTUDIO_CAMERAS = {
    "w": 40,
    "h": 30,
    "fl_x": 25,
    "cx": 1,
    "cy": 2,
    "fl_y": 3,
    "frames": [{"transform_matrix": IDENTITY_POSE}] * 2,
}
ANGLE_CAMERAS = {
    "w": 40,
    "h": 30,
    "camera_angle_x": 0.7,
    "frames": [{"file_path": "x.png", "transform_matrix": IDENTITY_POSE}],
}


@examples(200)
@given(rng=seeded_rng)
def test_forged_camera_files_are_read_or_refused(root, rng):
    path = root / "cameras.json"
    path.write_bytes(forge_json(rng.choice((HYRFPACK_CAMERAS, NERFSTUDIO_CAMERAS, ANGLE_CAMERAS)), rng))

    def read() -> None:
        for _, camera in cameras_from_json(path):
            assert np.isfinite([*camera.intrinsics, *camera.camera_from_world.flat]).all()
            assert np.abs(camera.rotation @ camera.rotation.T - np.eye(3)).max() < 1e-2

    check_read_or_refused(read)


def test_a_field_of_view_of_zero_is_refused(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps(ANGLE_CAMERAS | {"camera_angle_x": 0}))

    with pytest.raises(HyrfDataError, match="camera 0 is not valid"):
        cameras_from_json(tmp_path / "c.json")


@pytest.mark.filterwarnings("error")
def test_a_pose_whose_squares_overflow_is_refused(tmp_path):
    """The products contain inf - inf, a NaN, which no comparison finds to be above a tolerance."""
    pose = np.eye(4)
    pose[:2, :2] = [[1e200, -1e200], [1e200, 1e200]]
    (tmp_path / "c.json").write_text(json.dumps([HYRFPACK_CAMERAS[0] | {"camera_from_world": pose.tolist()}]))

    with pytest.raises(HyrfDataError, match="not finite"):
        cameras_from_json(tmp_path / "c.json")


def test_an_error_quotes_only_the_start_of_a_long_value(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps([HYRFPACK_CAMERAS[0] | {"fx": "\n" * 5000}]))

    with pytest.raises(HyrfDataError) as caught:
        cameras_from_json(tmp_path / "c.json")

    assert str(caught.value).isprintable() and len(str(caught.value)) < 1000


@pytest.mark.filterwarnings("ignore:overflow")
@examples(100)
@given(rng=seeded_rng)
def test_a_forged_viewpoint_is_used_or_refused(rng):
    viewpoint = json.loads(json.dumps(Viewpoint.from_frame((0, 0, 0), 1.0).to_json()))
    node, key = rng.choice(list_json_values(viewpoint))
    node[key] = rng.choice((*HOSTILE_JSON, 1e160, [1e200] * 3, [5e-324] * 3))

    facts = {"provenance": {"viewpoint": viewpoint}, "config": {"frame": None}}
    check_read_or_refused(lambda: orbit(Capture(facts).viewpoint, 3))  # a Camera refuses NaN


# --- points ---

TRANSFORMS_WITH_POINTS = {
    **INTRINSICS_JSON,
    "frames": frame_entries(["images/0.png"]),
    "ply_file_path": "points.ply",
}


def encode_point_files() -> list[bytes]:
    points = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    colors = np.full((5, 3), 7, np.uint8)
    shapes = trimesh.PointCloud(points, colors), trimesh.Trimesh(points, [[0, 1, 2], [1, 2, 3]], process=False)
    return [shape.export(file_type="ply", encoding=encoding) for shape in shapes for encoding in ("ascii", "binary")]


PLY_FORGERIES = [
    (b"float", b"double"),
    (b"float", b"int"),
    (b"uchar", b"list uchar int"),
    (b"property", b"property list int float"),
    *((b"vertex 5", b"vertex %d" % count) for count in (-1, 0, 4, 6, 10**11, 2**63)),
    *((b"face 2", b"face %d" % count) for count in (-1, 10**11, 2**63)),
    (b"end_header", b"element x 4000000000\nend_header"),
    (b"end_header", b"element x 4000000000\nproperty uchar a\nend_header"),
    (b"end_header", b"element x 4000000000\nproperty list uchar int a\nend_header"),
    (b"ascii", b"binary_little_endian"),
    (b"binary_little_endian", b"ascii"),
    (b"little", b"big"),
    (b"property float x\n", b""),
    (b"float x", b"float s"),
    (b"red", b"y"),
    (b"\n", b"\r\n"),
]


@with_70_examples
@given(rng=seeded_rng)
def test_forged_points_are_read_or_refused(root, rng):
    (root / "transforms.json").write_text(json.dumps(TRANSFORMS_WITH_POINTS))
    data = rng.choice(encode_point_files())
    for _ in range(rng.randint(0, 2)):
        data = data.replace(*rng.choice(PLY_FORGERIES), rng.choice((1, -1)))
    if rng.random() < 0.6:
        data = edit_bytes(data, rng)
    (root / "points.ply").write_bytes(data)

    tracemalloc.start()
    check_read_or_refused(lambda: load_scene(root, layout="nerfstudio", test_every=0))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 64 << 20  # the file has about 500 bytes, whatever sizes it declares


def test_a_texture_named_in_a_file_of_points_is_not_opened(root, caplog):
    (root / "transforms.json").write_text(json.dumps(TRANSFORMS_WITH_POINTS))
    data = encode_point_files()[0].replace(b"element vertex", b"comment TextureFile gone.png\nelement vertex")
    (root / "points.ply").write_bytes(data)

    with caplog.at_level(logging.WARNING):
        assert len(load_scene(root, layout="nerfstudio", test_every=0).points) == 5

    assert not caplog.records


# --- pictures ---


def encode_pictures() -> list[tuple[str, bytes]]:
    ramp = np.arange(24 * 32).reshape(24, 32)
    image = Image.fromarray((ramp % 256).astype(np.uint8))
    wide = Image.fromarray((ramp * 80).astype(np.uint16))
    kinds = [("png", mode, {}) for mode in ("RGB", "P", "RGBA", "L", "1")]
    kinds += [("png", "L", {"transparency": 5}), ("png", "I;16", {"transparency": 5})]
    kinds += [("jpeg", "RGB", {}), ("jpeg", "CMYK", {}), ("webp", "RGBA", {}), ("gif", "P", {"transparency": 0})]
    kinds += [("tiff", mode, {}) for mode in ("RGB", "I;16", "F", "CMYK")]
    kinds += [("bmp", "RGB", {}), ("ppm", "RGB", {})]
    files = []
    for suffix, mode, options in kinds:
        buffer = io.BytesIO()
        (wide if mode == "I;16" else image.convert("RGB").convert(mode)).save(buffer, suffix.upper(), **options)
        files.append((suffix, buffer.getvalue()))
    return files


PICTURE_FILES = encode_pictures()


def repair_png_checksums(data: bytes) -> bytes:
    """Return the picture with the checksum of every chunk recomputed."""
    whole, at = bytearray(data[:8]), 8
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunk = data[at + 4 : at + 8 + length]
        whole += data[at : at + 4] + chunk + struct.pack(">I", zlib.crc32(chunk))
        at += 12 + length
    return bytes(whole)


@pytest.mark.filterwarnings("ignore")  # Pillow warns about damaged files
@with_70_examples
@given(rng=seeded_rng)
def test_forged_picture_headers_are_read_or_refused(tmp_path_factory, rng):
    suffix, data = rng.choice(PICTURE_FILES)
    data = edit_bytes(data[:60], rng, 2) + data[60:]
    path = tmp_path_factory.getbasetemp() / f"forged.{suffix}"
    path.write_bytes(repair_png_checksums(data) if suffix == "png" else data)

    def read() -> None:
        header = read_header(path)
        rgb, alpha = read_pixels(path)
        assert rgb.shape == (header.height, header.width, 3)
        assert (alpha is not None) == header.has_alpha

    check_read_or_refused(read)


def test_sixteen_bit_grey_with_a_transparent_level_is_opaque(root, tmp_path, folders):
    """The header declares alpha, but the pixels have none."""
    folders.write_pictures(tmp_path, ["images/0.png"])
    data = next(
        data for suffix, data in PICTURE_FILES if b"tRNS" in data and Image.open(io.BytesIO(data)).mode == "I;16"
    )
    (tmp_path / "images" / "0.png").write_bytes(data)
    (tmp_path / "transforms.json").write_text(
        json.dumps({**INTRINSICS_JSON, "frames": frame_entries(["images/0.png"])})
    )

    scene = load_scene(tmp_path, test_every=0)

    assert not scene.has_alpha
    assert scene.train[0].load().alpha is None


def test_postscript_named_png_is_refused(tmp_path):
    Image.new("RGB", (32, 24)).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / "a.png")

    with pytest.raises(HyrfDataError, match="PostScript"):
        read_pixels(tmp_path / "a.png")


def test_a_small_picture_that_declares_a_huge_one_is_refused(tmp_path):
    data = bytearray(next(data for suffix, data in PICTURE_FILES if suffix == "png"))
    struct.pack_into(">II", data, 16, 1 << 30, 1 << 30)
    (tmp_path / "a.png").write_bytes(repair_png_checksums(bytes(data)))

    with pytest.raises(HyrfDataError, match="the picture has more than 500,000,000 pixels; reduce its size"):
        read_header(tmp_path / "a.png")


# --- checkpoints ---


@with_70_examples
@given(rng=seeded_rng)
def test_a_forged_checkpoint_with_its_digest_right_is_read_or_refused(tmp_path_factory, rng):
    path = tmp_path_factory.getbasetemp() / "checkpoint.pt"
    save_checkpoint(path, settings={"steps": 3}, tensors={"a": torch.arange(6.0)}, progress={"step": 1})
    data = edit_bytes(path.read_bytes()[:-32], rng)
    path.write_bytes(data + hashlib.sha256(data).digest())

    tracemalloc.start()
    check_read_or_refused(lambda: load_checkpoint(path, {"steps": 3}))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 16 << 20
