"""The suffix of a file selects its format, and written files can be read again."""

from __future__ import annotations

import os

import numpy as np
import pytest
from scenes import ring

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.files import MAX_FILE_BYTES, READABLE_ENDINGS, bytes_on_disk, list_source_files, read_splats
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats, normalize_quats
from hyrfpack.splats.table import FORMATS

UP_DIRECTION = np.array([0.0, -1.0, 0.0])
SCENE_CENTER_AND_UNIT = {
    "about the origin": ((0, 0, 0), 1),
    "tiny": ((0, 0, 0), 1e-3),
    "huge": ((0, 0, 0), 1e3),
    "far away": ((-3, 700, 2), 0.5),
    "map coordinates": ((4.5e5, 5.4e6, 300), 20),
}


def random_splats(count: int = 50, center=(0, 0, 0), unit: float = 1.0) -> Splats:
    generator = np.random.default_rng(0)
    return Splats(
        generator.uniform(-1, 1, (count, 3)) * unit + center,
        unit * np.exp(generator.uniform(-5, -1, (count, 3))),
        normalize_quats(generator.normal(size=(count, 4))),
        generator.uniform(0.01, 0.99, count),
        generator.normal(size=(count, 16, 3)) * 0.1,
    )


def encode_with_camera(splats: Splats, extension: str) -> bytes:
    return FORMATS[extension].encode(splats, Hints(UP_DIRECTION, ring(1)[0]))


@pytest.mark.parametrize("place", SCENE_CENTER_AND_UNIT)
@pytest.mark.parametrize("extension", FORMATS)
def test_every_format_preserves_count_and_positions(extension, place):
    splats = random_splats(50, *SCENE_CENTER_AND_UNIT[place])
    if extension == ".spz" and place == "map coordinates":
        with pytest.raises(HyrfDataError, match=r"5,4\d\d,\d\d\d units from the origin, and SPZ reaches [^\n]*$"):
            encode_with_camera(splats, extension)
        return
    back = FORMATS[extension].decode(encode_with_camera(splats, extension), "it")
    apart = np.linalg.norm(back.positions[:, None] - splats.positions, axis=-1)
    assert sorted(apart.argmin(0)) == list(range(50))  # formats may reorder Gaussians
    unit = SCENE_CENTER_AND_UNIT[place][1]
    assert apart.min(0).max() < 2e-4 * unit + 2e-7 * np.abs(splats.positions).max()
    assert back.degree == (0 if extension == ".splat" else 3)


@pytest.mark.parametrize("extension", [".ply", ".splat"])
@pytest.mark.parametrize("part", ["position", "scale"])
def test_numbers_too_large_for_a_scene_are_refused(part, extension, tmp_path):
    splats = random_splats(3)
    getattr(splats, f"{part}s")[1] *= 1e37
    path = tmp_path / f"large{extension}"
    path.write_bytes(encode_with_camera(splats, extension))
    with pytest.raises(
        HyrfDataError, match=rf"large{extension}: the {part} of Gaussian \d of 3 is beyond 1e\+30 units"
    ):
        read_splats(path)


@pytest.mark.parametrize("extension", READABLE_ENDINGS)
def test_files_are_read_by_suffix_in_any_case(extension, tmp_path):
    path = tmp_path / f"SCENE{extension.upper()}"
    path.write_bytes(encode_with_camera(random_splats(), extension))
    assert len(read_splats(path)) == 50
    assert len(read_splats(str(path))) == 50


@pytest.mark.parametrize("extension", READABLE_ENDINGS)
def test_the_error_for_a_damaged_file_contains_its_name(extension, tmp_path):
    path = tmp_path / f"broken{extension}"
    path.write_bytes(encode_with_camera(random_splats(), extension)[:-7])
    with pytest.raises(HyrfDataError, match=rf"broken{extension}\b[^\n]*$"):
        read_splats(path)


def test_missing_files_unknown_suffixes_and_folders_are_refused(tmp_path):
    (tmp_path / "scene.obj").write_bytes(b"v 0 0 0")
    (tmp_path / "empty").mkdir()
    (tmp_path / "folder.ply").mkdir()
    for name in ("none.ply", "none.obj", "scene.obj", "empty", "folder.ply", "meta.json", "empty/meta.json"):
        with pytest.raises(HyrfDataError) as refusal:
            read_splats(tmp_path / name)
        assert str(tmp_path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_missing_picture_of_an_unbundled_sog_is_named(tmp_path):
    for name, data in sog.encode_files(random_splats()).items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "means_u.webp").unlink()
    for source in (tmp_path, tmp_path / "meta.json"):
        with pytest.raises(HyrfDataError, match=r"means_u\.webp is missing; put it beside"):
            read_splats(source)


def test_the_size_of_an_unbundled_sog_counts_its_own_files_only(tmp_path):
    files = sog.encode_files(random_splats())
    for name, data in {**files, "notes.txt": b"other", "unrelated.webp": b"picture"}.items():
        (tmp_path / name).write_bytes(data)
    size = sum(map(len, files.values()))
    for source in (tmp_path, tmp_path / "meta.json"):
        assert bytes_on_disk(source) == size
        assert sorted(path.name for path in list_source_files(source)) == sorted(files)


def test_a_file_above_the_size_limit_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "large.ply"
    path.touch()
    os.truncate(path, MAX_FILE_BYTES + 1)  # a sparse file, which takes no space
    with pytest.raises(HyrfDataError, match="is larger than 4,294,967,296 bytes; split it first$"):
        read_splats(path)


@pytest.mark.parametrize(
    "holds, message_part",
    [
        ((), "this one holds nothing; name another"),
        (("b.webp", "a.webp"), "this one holds a.webp, b.webp; name another"),
        (("scene.ply", "scene.SPZ", "notes.txt"), "this one holds notes.txt, scene.SPZ, scene.ply; name scene.SPZ in"),
        (tuple(f"{n}.webp" for n in range(9)), "holds 0.webp, 1.webp, 2.webp, 3.webp and 5 more; name another"),
    ],
)
def test_the_error_for_a_folder_without_a_sog_lists_its_files(holds, message_part, tmp_path):
    for name in holds:
        (tmp_path / name).write_bytes(b"")
    for source in (tmp_path, tmp_path / "meta.json"):
        with pytest.raises(HyrfDataError) as refusal:
            read_splats(source)
        assert "a folder of splats is an unbundled SOG, meta.json with its pictures" in str(refusal.value)
        assert message_part in str(refusal.value)


def test_the_error_for_a_folder_names_no_point_cloud(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n{}end_header\n"
    (tmp_path / "a.ply").write_text(header.format(""))
    with pytest.raises(HyrfDataError, match="holds a.ply; name another folder, or use 'hyrfpack make'"):
        read_splats(tmp_path)
    (tmp_path / "b.ply").write_text(header.format("property float f_dc_0\n"))
    with pytest.raises(HyrfDataError, match="name b.ply in it"):
        read_splats(tmp_path)
    (tmp_path / "level" / "0_0").mkdir(parents=True)
    (tmp_path / "level" / "0_0" / "meta.json").touch()
    with pytest.raises(HyrfDataError, match="name 0_0 in it"):
        read_splats(tmp_path / "level")


@pytest.mark.parametrize("ending", [".ply", ".spz"])
def test_the_error_for_a_folder_names_no_folder_with_the_ending_of_splats(ending, tmp_path):
    (tmp_path / f"backup{ending}").mkdir()
    with pytest.raises(HyrfDataError, match=f"holds backup{ending}; name another folder, or use 'hyrfpack make'"):
        read_splats(tmp_path)


def test_a_model_is_not_read_as_splats(tmp_path):
    (tmp_path / "a.hyrf").touch()
    with pytest.raises(HyrfDataError, match="this is a model already, not splats of another program"):
        read_splats(tmp_path / "a.hyrf")


@pytest.mark.parametrize("name", ["none.ply", "none.txt", "none", "none/meta.json"])
def test_a_missing_file_is_reported_for_any_suffix(name, tmp_path):
    with pytest.raises(HyrfDataError, match="none.*: the file cannot be read"):
        read_splats(tmp_path / name)
