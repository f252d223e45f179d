"""`describe_photos` names the faults of synthetic sets."""

from __future__ import annotations

import doctest
import importlib
import json
import shutil
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from commands import refused, succeeded
from PIL import Image
from scipy import ndimage

from hyrfpack.errors import HyrfDataError
from hyrfpack.survey import PhotoSurvey, describe_photos


def random_rectangles(seed: int, width: int = 160, height: int = 120) -> np.ndarray:
    """Return a (H, W, 3) uint8 picture of overlapping rectangles."""
    generator = np.random.default_rng(seed)
    picture = np.full((height, width, 3), 128, np.uint8)
    for _ in range(80):
        top, left, down, right = (
            generator.integers(0, height),
            generator.integers(0, width),
            *generator.integers(4, 50, 2),
        )
        picture[top : top + down, left : left + right] = generator.integers(30, 225, 3)
    return picture


def save_photo(path: Path, picture: np.ndarray, focal: float | None = None, orientation: int = 1) -> None:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Acme", "Phone 3", orientation
    if focal is not None:
        exif.get_ifd(0x8769)[0xA405] = focal
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, quality=95, exif=exif)


@pytest.fixture
def photos(tmp_path) -> Path:
    """24 photos whose only problem is that they have no poses."""
    for number in range(24):
        save_photo(tmp_path / "photos" / f"{number:03d}.jpg", random_rectangles(number), focal=26)
    return tmp_path / "photos"


def find_problem(survey: PhotoSurvey, word: str) -> str:
    """Return the only problem that contains a word."""
    found = [sentence for sentence in survey.problems if word in sentence.replace(survey.path, "")]
    assert len(found) == 1, survey.problems
    assert ";" in found[0]  # what happened, and what to do
    return found[0]


def test_for_photos_without_poses_only_the_next_command_is_named(photos):
    survey = describe_photos(photos)
    assert (survey.kind, survey.photos, survey.posed, survey.layout) == ("photos", 24, 0, "")
    assert survey.sizes == {"160 x 120": 24}
    assert survey.cameras == {"Acme Phone 3, 26 mm": 24}
    assert survey.sharpness > 0.8 and survey.blurred == ()
    assert len(survey.problems) == 1
    assert (
        f"hyrfpack make {photos}" in find_problem(survey, "no poses")
        and f"hyrfpack poses {photos}" in survey.problems[0]
    )


def test_posed_photos_are_described_with_their_poses(data):
    survey = describe_photos(data)
    assert (survey.photos, survey.posed, survey.layout) == (10, 10, "nerfstudio")
    assert survey.points > 0 and survey.preset.startswith("standard")
    assert survey.problems == ("there are only 10 photos; take 20 or more, from all around and with much overlap",)


def test_blurred_dark_and_copied_photos_are_named(photos):
    blurred = ndimage.uniform_filter1d(random_rectangles(5).astype(float), 9, axis=1).astype(np.uint8)
    save_photo(photos / "005.jpg", blurred, focal=26)
    save_photo(photos / "009.jpg", random_rectangles(9) // 8, focal=26)
    shutil.copy(photos / "012.jpg", photos / "012 (1).jpg")
    survey = describe_photos(photos)
    assert survey.blurred == ("005.jpg",) and "005.jpg" in find_problem(survey, "blurred")
    assert "009.jpg" in find_problem(survey, "darker")
    assert "such as 012 (1).jpg of 012.jpg" in find_problem(survey, "copy of another")


def test_unreadable_photos_are_not_called_copies(photos):
    for name in ("030.jpg", "031.jpg"):
        (photos / name).write_bytes(b"")
    survey = describe_photos(photos)
    assert "030.jpg" in find_problem(survey, "cannot be read")
    assert not any("copy of another" in sentence for sentence in survey.problems)


def test_files_that_differ_only_between_the_compared_samples_are_not_called_copies(photos):
    for number, name in enumerate(("001.jpg", "002.jpg", "003.jpg")):
        data = bytearray((photos / "001.jpg").read_bytes().ljust(400_000, b"\0"))
        data[100_000] = number // 2  # between the sample at the start and that in the middle
        (photos / name).write_bytes(data)
    assert "002.jpg of 001.jpg" in find_problem(describe_photos(photos), "1 photo is a copy")


def test_of_large_sets_few_photos_are_read_whole_to_find_copies(photos, monkeypatch):
    for name in ("001", "002", "003"):
        shutil.copy(photos / f"{name}.jpg", photos / f"{name} (1).jpg")
    read_bytes, read = Path.read_bytes, []
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path.name) or read_bytes(path))
    monkeypatch.setattr("hyrfpack.survey.problems._MAX_HASHED_PHOTOS", 5)
    monkeypatch.setattr("hyrfpack.survey.problems._SAMPLE_BYTES", 64)
    assert "3 photos are copies of others" in find_problem(describe_photos(photos), "3 photos are copies")
    assert read == ["001 (1).jpg", "001.jpg", "002 (1).jpg", "002.jpg"]


def test_photos_that_become_unreadable_do_not_end_the_search_for_copies(photos, monkeypatch):
    shutil.copy(photos / "001.jpg", photos / "001 (1).jpg")
    shutil.copy(photos / "002.jpg", photos / "002 (1).jpg")
    read_bytes = Path.read_bytes

    def deny_some(path: Path) -> bytes:
        if path.name.startswith("001"):
            raise PermissionError(13, "Permission denied", str(path))
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", deny_some)
    monkeypatch.setattr("hyrfpack.survey.problems._SAMPLE_BYTES", 64)
    assert "002 (1).jpg of 002.jpg" in find_problem(describe_photos(photos), "1 photo is a copy")


def test_photos_that_are_too_small_to_measure_are_not_called_blurred(tmp_path):
    for number in range(4):
        Image.fromarray(random_rectangles(number)[:4, :4]).save(tmp_path / f"{number}.png")
    survey = describe_photos(tmp_path)
    assert survey.blurred == () and survey.sharpness == 0 and not any("blurred" in item for item in survey.problems)


def test_a_completely_blurred_set_is_detected(photos):
    for number in range(24):
        save_photo(photos / f"{number:03d}.jpg", ndimage.gaussian_filter(random_rectangles(number), (4, 4, 0)))
    assert "most photos are blurred" in find_problem(describe_photos(photos), "blurred")


def test_dark_sets_and_changing_light_are_reported(photos):
    for number in range(24):
        save_photo(photos / f"{number:03d}.jpg", random_rectangles(number) // 9)
    assert "more light" in find_problem(describe_photos(photos), "dark")
    for number in range(24):
        save_photo(
            photos / f"{number:03d}.jpg",
            np.minimum(255, (random_rectangles(number) * (0.3 + 0.1 * number))).astype(np.uint8),
        )
    survey = describe_photos(photos)
    assert survey.stops > 2.5 and "lock exposure" in find_problem(survey, "in brightness")


def test_cut_outs_on_a_transparent_ground_are_not_called_dark(photos):
    for number in range(24):
        (photos / f"{number:03d}.jpg").unlink()
        picture = np.zeros((120, 160, 4), np.uint8)
        picture[50:70, 60:100] = (*random_rectangles(number)[0, 0] // 2 + 128, 255)
        Image.fromarray(picture).save(photos / f"{number:03d}.png")
    assert not any("dark" in sentence for sentence in describe_photos(photos).problems)


def test_photos_of_a_single_view_are_detected(photos):
    for number in range(24):
        save_photo(photos / f"{number:03d}.jpg", random_rectangles(1), focal=26)
    assert "walk around" in find_problem(describe_photos(photos), "same picture")


def test_zooms_orientations_and_sizes_are_distinguished(photos):
    for number in range(10):
        save_photo(photos / f"{number:03d}.jpg", random_rectangles(number), focal=52)
    save_photo(photos / "011.jpg", random_rectangles(11), focal=26, orientation=6)
    save_photo(photos / "big.jpg", random_rectangles(11, 2400, 1800), focal=26)
    survey = describe_photos(photos)
    assert "Acme Phone 3" in find_problem(survey, "focal lengths")
    assert survey.sizes == {"160 x 120": 23, "120 x 160": 1, "2400 x 1800": 1}
    assert any("stored rotated" in note for note in survey.notes)
    assert any("1 of 25 photos is larger" in note for note in survey.notes)


def test_one_mask_for_all_photos_is_no_problem(photos):
    save_photo(photos / "masks" / "lens.png", random_rectangles(1))
    assert [problem for problem in describe_photos(photos).problems if " mask" in problem] == []


def test_masks_of_photos_that_were_not_opened_are_no_problem(photos, monkeypatch):
    for number, photo in enumerate(sorted(photos.glob("*.jpg"))):
        save_photo(photos / "masks" / f"{photo.stem}.png", random_rectangles(number))
    monkeypatch.setattr("hyrfpack.survey.measure.MAX_OPENED_PHOTOS", 3)
    assert [problem for problem in describe_photos(photos).problems if " mask" in problem] == []


def test_a_damaged_mask_is_a_problem_and_no_error(photos):
    (photos / "masks").mkdir()
    (photos / "masks" / "lens.png").write_bytes(b"no picture")
    assert "lens.png" in find_problem(describe_photos(photos), "masks")


def test_masks_without_matching_photos_are_detected(photos):
    for number in range(24):
        save_photo(photos / "masks" / f"{number:03d}.jpg.png", random_rectangles(number))
    assert len(describe_photos(photos).problems) == 1  # the missing poses
    save_photo(photos / "masks" / "other.png", random_rectangles(1))
    assert "other.png" in find_problem(describe_photos(photos), "masks")


def test_photos_without_a_pose_among_posed_ones_are_counted(data, tmp_path):
    shutil.copytree(data, tmp_path / "set")
    for number in range(3):
        save_photo(tmp_path / "set" / "images" / f"new{number}.png", random_rectangles(number, 48, 48))
    survey = describe_photos(tmp_path / "set")
    assert (survey.photos, survey.posed) == (13, 10)
    assert "hyrfpack poses" in find_problem(survey, "3 of 13 photos have no pose")


def test_a_photo_that_a_link_leads_to_is_counted_once(data, tmp_path):
    shutil.copytree(data, tmp_path / "set")
    (tmp_path / "set" / "images").rename(tmp_path / "set" / "photos")
    (tmp_path / "set" / "images").symlink_to("photos")
    survey = describe_photos(tmp_path / "set")
    assert (survey.photos, survey.posed) == (10, 10)
    assert all("copy" not in problem and "pose" not in problem for problem in survey.problems)


def test_other_versions_of_posed_photos_are_not_counted(data, tmp_path):
    shutil.copytree(data, tmp_path / "set")
    shutil.copytree(data / "images", tmp_path / "set" / "input")
    survey = describe_photos(tmp_path / "set")
    assert (survey.photos, survey.posed) == (10, 10)
    assert all("copy" not in problem and "pose" not in problem for problem in survey.problems)


def test_damaged_photos_are_named_and_the_others_described(photos):
    (photos / "003.jpg").write_bytes(b"no picture")
    whole = (photos / "004.jpg").read_bytes()
    (photos / "004.jpg").write_bytes(whole[: len(whole) // 2])
    survey = describe_photos(photos)
    assert survey.decoded == 22
    assert "003.jpg" in find_problem(survey, "2 of 24 photos cannot be read")


def test_unusable_poses_are_reported_as_a_problem_of_the_set(data, tmp_path):
    shutil.copytree(data, tmp_path / "set")
    for table in [*(tmp_path / "set").rglob("*.json"), *(tmp_path / "set").rglob("*.bin")]:
        table.write_bytes(table.read_bytes()[: table.stat().st_size // 2])
    survey = describe_photos(tmp_path / "set")
    assert survey.posed == 0 and survey.photos == 10
    assert any(str(tmp_path / "set") in sentence for sentence in survey.problems)


def test_only_some_photos_of_large_sets_are_examined(photos, monkeypatch):
    monkeypatch.setattr("hyrfpack.survey.measure.MAX_DECODED_PHOTOS", 8)
    survey = describe_photos(photos)
    assert survey.decoded == 8 and any("8 of 24 photos" in note for note in survey.notes)


def test_a_zip_archive_is_described_like_its_folder(data, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as archive:
        for file in sorted(data.rglob("*")):
            archive.write(file, Path("set") / file.relative_to(data))
    survey = describe_photos(tmp_path / "set.zip")
    assert survey.path == str(tmp_path / "set.zip") and survey.photos == 10


def test_a_folder_without_photos_is_reported_as_such(tmp_path):
    for name, sentence in (("", "no photos here"), ("IMG.dng", "raw file"), ("clip.MP4", "name the video itself")):
        if name:
            (tmp_path / name).touch()
        with pytest.raises(HyrfDataError, match=sentence):
            describe_photos(tmp_path)
    with pytest.raises(HyrfDataError, match="no such folder"):
        describe_photos(tmp_path / "nowhere")


def test_info_prints_the_survey_as_text_and_as_json(photos):
    survey = describe_photos(photos)
    found = json.loads(succeeded("info", photos, "--json").stdout)
    assert found == json.loads(json.dumps(asdict(survey)))
    printed = succeeded("info", photos).stdout
    assert printed.startswith(f"{photos}: 24 photos\n") and "160 x 120" in printed
    assert "what to do\n  - the photos have no poses" in printed


@pytest.mark.acceptance
def test_info_of_a_video_says_how_many_frames_would_be_taken(tmp_path):
    av = pytest.importorskip("av")
    wall = random_rectangles(3, 700, 120)
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "16"})
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for number in range(80):
            frame = np.ascontiguousarray(wall[:, 4 * number : 4 * number + 160])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        container.mux(stream.encode())
    found = json.loads(succeeded("info", tmp_path / "clip.mp4", "--json").stdout)
    assert found["kind"] == "video" and found["photos"] == 80 and 20 < found["frames"] <= 80
    assert "hyrfpack make" in found["problems"][0]
    assert "frames would be" in succeeded("info", tmp_path / "clip.mp4").stdout


def test_info_of_a_file_that_is_no_photo_is_a_clear_error(tmp_path):
    (tmp_path / "clip.mp4").write_bytes(b"no video")
    assert "cannot be read as a video" in refused("info", tmp_path / "clip.mp4")
    (tmp_path / "set.zip").write_bytes(b"no archive")
    assert "set.zip" in refused("info", tmp_path / "set.zip")
    (tmp_path / "empty").mkdir()
    assert "no photos here" in refused("info", tmp_path / "empty")
    for name, sentence in (("a.glb", "written for other programs and not read"), ("a.json", "with their photos")):
        (tmp_path / name).touch()
        assert sentence in refused("info", tmp_path / name)


@pytest.mark.parametrize("name", ["data.quality", "survey.describe", "poses.frames"])
def test_the_examples_of_these_modules_run(name, data, tmp_path, monkeypatch):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "bonsai").symlink_to(data)
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(importlib.import_module(f"hyrfpack.{name}"))
    assert found.attempted and not found.failed
