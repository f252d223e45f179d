"""Names are matched to files by the strictest rule that fits exactly one file, and no file serves two names."""

from __future__ import annotations

import os
import string
import unicodedata
from pathlib import Path, PurePosixPath

import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.data.names import PictureIndex, find_similar_file, path_parts


def make_folder(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


@pytest.mark.parametrize(
    ("listed", "there"),
    [
        ("a", "a.png"),
        ("a.jpg", "a.png"),
        ("a.JPG", "a.jpg"),
        ("A.jpg", "a.TIF"),
        ("a.jpg", "a.jpg.png"),
        ("a.CR2", "a.jpg"),
        ("frame.0001", "frame.0001.png"),
        ("left/a.jpg", "Left/A.png"),
        ("/home/x/images/a.jpg", "a.jpg"),
        ("/home/x/images/left/a.jpg", "left/a.webp"),
        ("C:\\x\\images\\a.jpg", "a.jpg"),
        ("\\\\server\\x\\a.jpg", "a.jpg"),
        ("images/a.jpg", "a.jpg"),
        ("../images/a.jpg", "a.jpg"),
        ("a.jpg", "left/a.jpg"),
        (unicodedata.normalize("NFD", "é.jpg"), "é.png"),
        ("é.jpg", unicodedata.normalize("NFD", "É.jpg")),
        ("straße.jpg", "STRASSE.jpg"),
        ("日本.jpg", "日本.heic"),
        ("a  b .jpg", "a  b .png"),
    ],
)
def test_a_name_matches_the_only_file_that_it_can_mean(tmp_path, listed, there):
    make_folder(tmp_path, there, "other.png", "left/other.png")

    assert PictureIndex(tmp_path).find(listed) == tmp_path / there


@pytest.mark.parametrize(
    ("listed", "there"),
    [
        ("a.jpg", ["a.png", "a.webp"]),
        ("a", ["a.png", "a.jpg"]),
        ("left/a", ["left/a.png", "left/a.PNG"]),
        ("masks/a", ["masks/a.png", "masks/a.jpg", "a.webp"]),
        ("a.jpg", ["left/a.jpg", "right/a.jpg"]),
        ("right/a.jpg", ["left/a.jpg"]),
        ("a.jpg", ["b.jpg"]),
        ("a.jpg", ["aa.jpg"]),
        ("a.0001", ["a.png"]),
        ("a.jpg", ["a.txt"]),
        ("a.jpg", ["masks/a.jpg"]),
        ("a.jpg", [".hidden/a.jpg", ".a.jpg"]),
        ("", ["a.jpg"]),
        ("/", ["a.jpg"]),
        ("x" * 300 + ".jpg", ["a.jpg"]),
        ("a\0b.jpg", ["a.jpg"]),
    ],
)
def test_an_ambiguous_name_is_not_matched(tmp_path, listed, there):
    make_folder(tmp_path, *there)

    assert PictureIndex(tmp_path).find(listed) is None


def test_two_names_of_one_file_do_not_make_a_name_ambiguous(tmp_path):
    make_folder(tmp_path, "a.png")
    os.link(tmp_path / "a.png", tmp_path / "a.PNG")  # as a disk that ignores letter case shows the file

    assert PictureIndex(tmp_path).find("a") == tmp_path / "a.png"


def test_a_name_without_extension_that_fits_two_files_is_noted(tmp_path):
    make_folder(tmp_path, "a.png", "a.jpg", "b.jpg")

    matches = PictureIndex(tmp_path).match(["a", "b"])

    assert matches.found == {"b": tmp_path / "b.jpg"} and matches.ambiguous == ["a"]
    assert "1 photo was not matched (such as a)" in matches.notes[0]


def test_the_strictest_rule_is_tried_first(tmp_path):
    make_folder(tmp_path, "a.jpg", "a.png", "A.JPG", "left/a.jpg")

    index = PictureIndex(tmp_path)

    assert index.find("a.png") == tmp_path / "a.png"
    assert index.find("x/left/a.jpg") == tmp_path / "left" / "a.jpg"


def test_a_file_is_matched_to_one_name_only(tmp_path):
    make_folder(tmp_path, "a.jpg", "b.jpg")

    matches = PictureIndex(tmp_path).match(["a.jpg", "A.png", "left/b.jpg", "right/b.jpg"])

    assert matches.found == {"a.jpg": tmp_path / "a.jpg"}
    assert matches.ambiguous == ["left/b.jpg", "right/b.jpg"]
    assert "2 photos were not matched (such as left/b.jpg)" in matches.notes[0]


def test_a_name_without_extension_does_not_share_the_file_of_its_whole_name(tmp_path):
    make_folder(tmp_path, "1.jpg", "2.jpg")

    matches = PictureIndex(tmp_path).match(["1", "1.jpg", "2"])

    assert matches.found == {"1.jpg": tmp_path / "1.jpg", "2": tmp_path / "2.jpg"}
    assert not matches.ambiguous and not matches.inexact


def test_notes_count_inexact_matches_and_give_an_example(tmp_path):
    make_folder(tmp_path, "a.jpg", "b.jpg", "c.png")

    matches = PictureIndex(tmp_path).match(["a.jpg", "/x/b.jpg", "c.jpg"])

    assert matches.notes == [
        "2 of 3 photos have other names than in the poses and were matched to the only file that fits "
        "(such as /x/b.jpg to b.jpg)"
    ]


def test_the_most_similar_name_is_suggested():
    files = [Path("photos/IMG_0412.jpg"), Path("photos/DSC_0001.jpg")]

    assert find_similar_file("images/IMG_412.jpeg", files) == files[0]
    assert find_similar_file("IMG_412.jpeg", []) is None


@given(name=st.text())
def test_parts_never_lead_out_of_a_folder(name):
    assert all(part not in ("", ".", "..") and "/" not in part and "\\" not in part for part in path_parts(name))


part = st.text(alphabet="aAbéÉß.1 ", min_size=1, max_size=3).filter(lambda text: text.strip(". ") == text)
path = st.lists(part, min_size=1, max_size=3).map("/".join)
ending = st.sampled_from(["", ".jpg", ".JPG", ".png", ".webp", ".NEF"])
listed_names = st.lists(
    st.builds(
        lambda prefix, name, end, form: prefix + unicodedata.normalize(form, name) + end,
        st.sampled_from(["", "/home/", "C:\\", "images/", "../"]),
        path,
        ending,
        st.sampled_from(["NFC", "NFD"]),
    ),
    max_size=8,
)


@examples(150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(names=listed_names, there=st.lists(st.tuples(path, ending), max_size=8))
def test_matching_is_one_to_one_and_between_like_names(tmp_path_factory, names, there):
    root = tmp_path_factory.mktemp("index")
    for name, end in there:
        try:
            make_folder(root, name + end)
        except OSError:  # there is a folder of that name
            continue

    matches = PictureIndex(root).match(names)

    by_file: dict[Path, set[tuple[str, ...]]] = {}
    for name, file in matches.found.items():
        by_file.setdefault(file.resolve(), set()).add(path_parts(name))
        assert file.is_file()
        assert reference_stem(file.name) in (reference_stem(path_parts(name)[-1]), normalize(path_parts(name)[-1]))
    assert all(len(spellings) == 1 for spellings in by_file.values())
    assert not set(matches.ambiguous) & set(matches.found)


def normalize(text: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())


def reference_stem(name: str) -> str:
    """Return what precedes the last dot where letters follow it, independently of the code under test."""
    before, dot, after = normalize(name).rpartition(".")
    return before if dot and before and after and after[0] in string.ascii_lowercase else normalize(name)


@examples(60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_choice_is_made_between_two_equally_good_files(tmp_path_factory, data):
    root = tmp_path_factory.mktemp("twins")
    name = data.draw(part.filter(lambda text: "." not in text))
    first, second = data.draw(st.permutations([".png", ".webp", ".bmp", ".tif"]))[:2]
    make_folder(root, f"{name}{first}", f"{name}{second}")

    listed = data.draw(st.sampled_from(["", "/x/", "images/"])) + f"{name}.jpg"

    matches = PictureIndex(root).match([listed])
    assert matches.found == {} and matches.ambiguous == [listed]
    assert PurePosixPath(listed).name.startswith(name)
