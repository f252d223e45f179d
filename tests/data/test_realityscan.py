"""RealityScan's camera parameters.

The real angles and matrix belong to one camera that was exported both ways, in
forums.unrealengine.com/t/different-rotation-of-cameras-in-xmp-and-csv/710449.
"""

from __future__ import annotations

import numpy as np
import pytest

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError

CSV_HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
CSV_ROWS = ("a.jpg,1,2,3,163.736597399311,83.4154313461628,174.386496244756,18,0.01,-0.02,0,0,0,0,0,0",)
CSV_ROWS += ("b.jpg,4,5,6,0,0,0,18,0,0,-0.1,0.02,-0.003,0.0004,0,0",)
# The first row of xcr:Rotation of the same camera, world to camera; the source truncates the last number.
REAL_ROTATION_ROWS = [[0.982594073038806, 0.185426733553445, -0.0112166890261935]]
REAL_ROTATION_ROWS += [
    [-0.032113633044729, 0.11008102707942, -0.993403685341366],
    [-0.18296885582437, 0.976472781986697, 0.114],
]


@pytest.fixture
def folder(tmp_path, pictures):
    pictures(tmp_path, ["a.jpg", "b.jpg"])
    (tmp_path / "cameras.csv").write_text("\n".join((CSV_HEADER, *CSV_ROWS)) + "\n")
    return tmp_path


def rewrite(root, change) -> None:
    (root / "cameras.csv").write_text(change((root / "cameras.csv").read_text()))


def move_cameras(text: str, first: tuple[float, ...], second: tuple[float, ...]) -> str:
    """Replace the positions of both cameras in a table."""
    for old, position in ((",1,2,3,", first), (",4,5,6,", second)):
        text = text.replace(old, f",{','.join(map(str, position))},")
    return text


def test_angles_give_the_matrix_that_realityscan_exports(folder):
    camera = load_scene(folder, test_every=0).views[0].camera

    np.testing.assert_allclose(camera.rotation[:2], REAL_ROTATION_ROWS[:2], atol=1e-12)
    np.testing.assert_allclose(camera.rotation[2], REAL_ROTATION_ROWS[2], atol=2e-4)
    np.testing.assert_allclose(camera.position, (1, 2, 3))


def test_without_angles_a_camera_looks_down_with_north_above(folder):
    camera = load_scene(folder, test_every=0).views[1].camera

    np.testing.assert_allclose(camera.rotation, np.diag([1.0, -1, -1]), atol=1e-12)


def test_intrinsics_are_fractions_of_the_longer_side(folder):
    first, second = load_scene(folder, test_every=0).views

    np.testing.assert_allclose(first.camera.intrinsics, (16, 16, 16.32, 11.36))
    assert second.load.lens.coefficients == (-0.1, 0.02, 0, 0, -0.003, 0, 0, 0, 0.0004)


def test_columns_may_be_fewer_and_in_another_order(folder):
    rewrite(folder, lambda _: "#f,name,x,y,alt,heading,pitch,roll\n18,a.jpg,1,2,3,0,0,0\n18,b.jpg,2,2,3,0,0,0\n")

    assert load_scene(folder).views[0].camera.intrinsics == (16, 16, 16, 12)


def test_a_photo_whose_name_starts_with_a_hash_is_no_comment(folder):
    (folder / "a.jpg").rename(folder / "#a.jpg")
    comments = "# exported today\n# by RealityScan,,,,,,,,,,,,,,,\n# of, 2, photos\n"
    rewrite(folder, lambda text: text.replace("\na.jpg", f"\n{comments}#a.jpg"))

    assert [view.name for view in load_scene(folder, test_every=0).views] == ["#a.jpg", "b.jpg"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_names_with_umlauts_are_read_in_the_encoding_of_the_table(folder, encoding):
    (folder / "a.jpg").rename(folder / "ü.jpg")
    table = folder / "cameras.csv"
    table.write_bytes(table.read_text().replace("a.jpg", "ü.jpg").encode(encoding))

    assert [view.name for view in load_scene(folder, test_every=0).views] == ["b.jpg", "ü.jpg"]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((12.0, 30.0, 0.0), (12.2, 30.2, 40.0)),  # up a mast, which sways by 0.3 m
        ((100.0, 50.0, 1.0), (100.5, 50.2, 1.3)),
        ((0.0, 0.0, 0.0), (0.001, 0.001, 3.0)),  # up a mast at the origin
    ],
)
def test_local_coordinates_in_metres_are_not_taken_for_degrees(folder, first, second):
    rewrite(folder, lambda text: move_cameras(text, first, second))

    positions = [view.camera.position for view in load_scene(folder, test_every=0).views]

    np.testing.assert_allclose(positions, (first, second), atol=1e-9)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((-120.0871, 38.96708, 2084.4), (-120.0881, 38.96786, 1965.6)),  # a real flight, see test_metashape
        ((13.05, 55.7, 60.0), (13.0503, 55.7002, 60.4)),  # a handheld walk of 30 m
        ((8.54, 47.37, 500.0), (8.559, 47.38, 503.0)),  # a flight over 1.8 km at an almost constant altitude
        ((13.05, 55.7, 20.0), (13.05, 55.7, 60.0)),  # straight up
        ((8.54, 47.37, 500.0), (8.59, 47.39, 590.0)),  # a survey of 4 km over hills
    ],
)
def test_positions_in_degrees_are_rejected(folder, first, second):
    rewrite(folder, lambda text: move_cameras(text, first, second))

    with pytest.raises(HyrfDataError, match="the cameras are in geographic coordinates; export them again"):
        load_scene(folder)


def test_other_tables_are_ignored(tmp_path):
    (tmp_path / "table.csv").write_text("name,x,y,z\n")

    with pytest.raises(HyrfDataError, match="no poses found"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda text: text[:-40], "line 3 is incomplete"),
        (lambda text: text.replace("83.4154", "up"), "line 2 .* text in place of a number"),
        (lambda text: text.replace("83.4154", "nan"), "text in place of a number"),
        (lambda text: text.split("\n")[0], "lists no photo"),
        (lambda text: text.replace(",18,", ",0,"), "unusable intrinsics"),
        (lambda text: text.replace("0.0004,0,0", "0,0.1,0"), "'b.jpg' has tangential distortion"),
        (lambda text: text.replace("b.jpg", "a.jpg"), "listed twice"),
        (
            lambda text: text.replace(",1,2,3,", ",-5041986.5,2573482,-2929105,").replace(
                ",4,5,6,", ",-5041974.6,2573499,-2929110,"
            ),
            "geocentric",
        ),
        (
            lambda text: text.replace(",1,2,3,", ",-120.0871,38.96708,2084.4,").replace(
                ",4,5,6,", ",-120.0881,38.96786,1965.6,"
            ),
            "geographic",
        ),
    ],
)
def test_a_broken_set_is_a_clear_error(folder, damage, says):
    rewrite(folder, damage)

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(folder)

    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)
