"""Bundler files; the numbers of a real reconstruction are from bundle/bundle.out in github.com/davidar/pixelstruct."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from hyrfpack.data import load_scene
from hyrfpack.data.undistort import distort
from hyrfpack.errors import HyrfDataError

# Cameras 0, 1, 2 and 4 (4 is not registered), and four points with their pixels in cameras 0 to 2, measured from the
# middle of the picture with y up.
REAL_BUNDLE = """# Bundle file v0.3
4 4
6.8458150610e+02 -9.2868493344e-02 1.1613540173e-02
9.9187742625e-01 -1.2167982186e-01 3.7056608646e-02
1.0496140768e-01 9.4754083757e-01 3.0190969515e-01
-7.1848967919e-02 -2.9556789758e-01 9.5261605263e-01
1.6236485553e-01 1.0240328975e+00 -8.2961699418e-01
6.8493708601e+02 -8.2453988891e-02 9.2039428737e-04
9.7730529089e-01 6.4295668603e-02 -2.0184260054e-01
-1.2826713588e-02 9.6903877288e-01 2.4657520571e-01
2.1144702366e-01 -2.3839027592e-01 9.4787142194e-01
-5.6618455560e-01 8.5037881491e-01 -6.0599634693e-01
7.0933444482e+02 -4.2448082933e-02 -4.0611728645e-03
8.1231529545e-01 3.2338204135e-01 -4.8535339301e-01
-1.4301730259e-01 9.1723906360e-01 3.7177755628e-01
5.6541127680e-01 -2.3258666240e-01 7.9133654821e-01
-1.3504364474e+00 1.1756357026e+00 -1.6465005946e+00
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
-4.4479506154e-01 -5.5406170002e-01 -2.7713737452e+00
100 164 102
3 0 150 -65.6200 -80.0600 1 169 -102.0200 -77.7000 2 235 -98.1100 -53.4000
-1.6509693582e-01 -3.1893064866e-01 -2.6313567518e+00
207 206 203
3 0 160 -11.5000 -18.6900 1 180 -48.1400 -23.6400 2 242 -58.1100 -13.7700
-7.4492824522e-01 -2.3382405722e-01 -2.6136853074e+00
103 173 181
3 0 321 -137.4200 -13.6300 1 349 -167.3500 -2.4400 2 433 -132.5600 16.4400
7.9310228165e-02 -4.4482392623e-01 -2.7602327917e+00
25 21 25
3 0 867 39.5700 -45.8100 1 655 8.8900 -57.9400 2 818 -17.3700 -51.9900
"""


@pytest.fixture
def folder(tmp_path, pictures):
    names = [f"{index}.png" for index in range(4)]
    pictures(tmp_path / "images", names, size=(400, 300))
    (tmp_path / "list.txt").write_text("".join(f"./{name}\n" for name in names))
    (tmp_path / "bundle.out").write_text(REAL_BUNDLE)
    return tmp_path


def test_points_of_a_real_reconstruction_project_to_where_they_were_seen(folder):
    scene = load_scene(folder, test_every=0)
    numbers = [line.split() for line in REAL_BUNDLE.splitlines()[-10::3]]
    seen = np.array([[float(n) for n in line[1:]] for line in numbers]).reshape(4, 3, 4)[:, :, 2:]

    assert [view.name for view in scene.views] == ["0.png", "1.png", "2.png"]
    assert "1 photo is not registered and was skipped" in scene.notes
    for number, view in enumerate(scene.views):
        local = scene.points @ view.camera.rotation.T + view.camera.camera_from_world[:3, 3]
        assert (local[:, 2] > 0).all()
        lens = view.load.lens
        x, y = distort(lens, local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
        pixels = np.column_stack((lens.fx * x + lens.cx, lens.fy * y + lens.cy))
        expected = seen[:, number] * (1, -1) + (200, 150)
        assert np.abs(pixels - expected).max() < 3, number  # in pixels, the error of the reconstruction itself
        assert np.abs(pixels - expected).mean() < 0.7
    np.testing.assert_allclose(scene.point_colors[0] * 255, (100, 164, 102), atol=1e-4)


@pytest.mark.parametrize("line", ["{name}", "{name} 0 653.2", "C:\\\\work\\\\{name}", "/home/me/set/{name} 0 1.2e3"])
def test_all_known_forms_of_the_list_file_are_read(folder, line):
    (folder / "list.txt").write_text("".join(line.format(name=f"{index}.png") + "\n" for index in range(4)))

    assert len(load_scene(folder).views) == 3


def test_a_photo_whose_name_starts_with_a_hash_is_no_comment(folder):
    (folder / "images" / "0.png").rename(folder / "images" / "#0.png")
    (folder / "list.txt").write_text("#0.png\n1.png\n2.png\n3.png\n")

    assert [view.name for view in load_scene(folder, test_every=0).views] == ["#0.png", "1.png", "2.png"]


def test_comments_in_the_list_file_are_ignored(folder):
    (folder / "list.txt").write_text("# four photos\n0.png\n1.png\n\n2.png\n3.png\n")

    assert len(load_scene(folder).views) == 3


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_names_with_umlauts_are_read_in_the_encoding_of_the_list_file(folder, encoding):
    (folder / "images" / "0.png").rename(folder / "images" / "ü.png")
    (folder / "list.txt").write_bytes("ü.png\n1.png\n2.png\n3.png\n".encode(encoding))

    assert [view.name for view in load_scene(folder, test_every=0).views] == ["1.png", "2.png", "ü.png"]


@pytest.mark.parametrize("name", ["scene.list.txt", "imagelist.lst", "image_list.txt"])
def test_all_known_names_of_the_bundle_file_are_read(folder, name):
    (folder / "list.txt").rename(folder / name)
    (folder / "bundle.out").rename(folder / "scene.bundle.out")

    assert load_scene(folder).layout == "bundler"


def test_the_folder_bundle_is_searched_for_the_file(folder):
    (folder / "bundle").mkdir()
    (folder / "bundle.out").rename(folder / "bundle" / "bundle.out")

    assert len(load_scene(folder).views) == 3


def rewrite(root, change) -> None:
    (root / "bundle.out").write_text(change((root / "bundle.out").read_text()))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda root: rewrite(root, lambda text: text[:500]), "is truncated"),
        (lambda root: rewrite(root, lambda text: text.replace("4 4\n", "4 400000000000\n")), "is truncated"),
        (
            lambda root: rewrite(root, lambda text: "# Bundle file v0.3\n1 1\n"),
            "1 camera and 1 point take 9 lines, but",
        ),
        (lambda root: rewrite(root, lambda text: text.replace("4 4\n", "many\n")), "how many cameras"),
        (lambda root: rewrite(root, lambda text: text.replace("4 4\n", "-1 4\n")), "is truncated"),
        (lambda root: rewrite(root, lambda text: text.replace("4 4\n", 4_300 * "9" + " 4\n")), "how many cameras"),
        (lambda root: rewrite(root, lambda text: text.replace("6.8458150610e+02", "nan")), "not finite"),
        (lambda root: rewrite(root, lambda text: text.replace("6.8458150610e+02", "-1")), "unusable intrinsics"),
        (lambda root: rewrite(root, lambda text: text.replace("9.9187742625e-01", "9")), "not rigid"),
        (lambda root: rewrite(root, lambda text: text.replace("100 164 102", "100 164")), "three numbers"),
        (lambda root: (root / "list.txt").unlink(), "the list of its photos is missing"),
        (lambda root: (root / "list.txt").write_text("0.png\n"), "4 cameras, but list.txt lists 1 photo"),
        (lambda root: (root / "list.txt").write_text("0.png\n0.png\n2.png\n3.png\n"), "listed twice"),
    ],
)
def test_a_broken_set_is_a_clear_error(folder, damage, says):
    damage(folder)

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(folder)

    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)


def test_points_that_are_not_finite_are_dropped(folder):
    rewrite(folder, lambda text: text.replace("-4.4479506154e-01 ", "inf "))

    assert "1 of 4 points is not finite and was dropped" in load_scene(folder).notes


def test_copies_of_unknown_size_are_rejected(folder):
    (folder / "images").rename(folder / "images_4")

    with pytest.raises(HyrfDataError, match="does not say how large its photos are"):
        load_scene(folder)


def test_the_list_may_name_the_folder_of_photos(folder):
    (folder / "list.txt").write_text("".join(f"images/{index}.png\n" for index in range(4)))

    scene = load_scene(folder)

    assert {view.name for view in scene.views} == {"0.png", "1.png", "2.png"}
    assert not any("have other names" in note for note in scene.notes)


def test_smaller_copies_are_used_where_the_list_names_them(folder, pictures):
    names = [f"{index}.png" for index in range(4)]
    pictures(folder / "images_2", names, size=(200, 150))
    (folder / "list.txt").write_text("".join(f"images_2/{name}\n" for name in names))

    scene = load_scene(folder)

    assert {(view.camera.width, view.camera.height) for view in scene.views} == {(200, 150)}
    assert max(view.camera.fx for view in scene.views) == pytest.approx(709.33444482)


@pytest.mark.parametrize("inside", ["", "left/"])
def test_smaller_copies_are_rejected_because_the_size_is_unknown(folder, pictures, inside):
    names = [f"{inside}{index}.png" for index in range(4)]
    shutil.rmtree(folder / "images")
    pictures(folder / "images_2", names, size=(200, 150))
    (folder / "list.txt").write_text("".join(f"{name}\n" for name in names))

    with pytest.raises(HyrfDataError, match="images_2: a Bundler file does not say how large its photos are"):
        load_scene(folder)
