"""Metashape's cameras.

The numbers of a real drone flight are from data/composite_georef in github.com/open-forest-observatory/geograypher.
The position and angles that the aircraft recorded for a photo say where its camera must be.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from hyrfpack.data import load_scene
from hyrfpack.data.metashape import _parse_numbers
from hyrfpack.data.undistort import distort
from hyrfpack.errors import HyrfDataError

REAL_CALIBRATION = (
    "<f>3665.6030071110099</f><cx>-25.514956263212593</cx><cy>22.224025593172296</cy><k1>0.0069181007644881559</k1>"
    "<k2>-0.017121106289946286</k2><k3>0.019016806872041245</k3><p1>-0.001565626293122246</p1>"
    "<p2>0.0006376336416036338</p2>"
)
CHUNK_ROTATION = (
    "0.26786212605199339 -0.96344896016433013 0.0039978225544341633 0.57498722528152235 0.15652811627789542 "
    "-0.80304958724698305 0.77307151815984154 0.217405266662895 0.59589879831836678"
)
CHUNK_TRANSLATION = "-2490251.0872162799 -4297975.2206927296 3990598.5772206257"
CHUNK_SCALE = 22.039365691522473
NADIR_TRANSFORM = (
    "0.0043018316431870929 -0.99965428824217073 0.025938354680913017 7.6732946732529754 -0.91501911065257591 "
    "-0.014398373341507842 -0.40315346207826114 -2.8040466887443611 0.40338755730077119 -0.021999791911691269 "
    "-0.91476471716543539 3.2954030087246085 0 0 0 1"
)
OBLIQUE_TRANSFORM = (
    "-0.99328109329913516 0.10505763434178977 -0.04853414427989701 11.778405785692465 0.10412077990762875 "
    "0.62822397206434388 -0.77103404860948044 -0.42477869090217363 -0.050512700243623677 -0.77090695572825541 "
    "-0.63494167663171375 0.65453051913222349 0 0 0 1"
)
# Longitude, latitude, height, tilt of the gimbal from straight down and heading of the aircraft; angles in degrees.
RECORDED_POSES = {"nadir": (-120.087143111111, 38.967084472222197, 2084.445, 0.1, 5.9)}
RECORDED_POSES["oblique"] = (-120.08806625, 38.967859722222201, 1965.585, 25.0, 91.7)


def document(
    cameras: str, *, size=(4864, 3648), kind="frame", calibration=REAL_CALIBRATION, transform="", reference=""
) -> str:
    width, height = size
    resolution = f'<resolution width="{width}" height="{height}"/>'
    inside = (
        f'<calibration type="{kind}" class="adjusted">{resolution}{calibration}</calibration>' if calibration else ""
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="1"><sensor id="0" label="FC6310" type="{kind}">{resolution}{inside}</sensor></sensors>'
        f'<components next_id="1"><component id="0" label="Component 1">{transform}</component></components>'
        f"<cameras>{cameras}</cameras>{reference}</chunk></document>\n"
    )


def camera(label: str, transform: str, index: int = 0, more: str = "") -> str:
    named = f'<camera id="{index}" sensor_id="0" component_id="0" label="{label}" {more}>'
    return f"{named}<transform>{transform}</transform></camera>"


def load_view_at_origin(tmp_path: Path, pictures, size=(64, 48), **kind):
    """Return the view at the origin of a set of two photos."""
    pictures(tmp_path, ["a.jpg", "b.jpg"], size=size)
    placed = camera("a", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1") + camera("b", "1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1", 1)
    (tmp_path / "cameras.xml").write_text(document(placed, size=size, **kind))
    return load_scene(tmp_path, test_every=0).views[0]


def test_cameras_of_a_real_flight_match_the_records_of_the_aircraft(tmp_path, pictures):
    names = ["flight/nadir.JPG", "flight/oblique.JPG"]
    pictures(tmp_path, names, size=(64, 48))
    cameras = camera(names[0], NADIR_TRANSFORM) + camera(names[1], OBLIQUE_TRANSFORM, 1)
    transform = (
        f'<transform><rotation locked="true">{CHUNK_ROTATION}</rotation><translation>{CHUNK_TRANSLATION}</translation>'
        f"<scale>{CHUNK_SCALE}</scale></transform>"
    )
    (tmp_path / "flight.xml").write_text(document(cameras, transform=transform))

    scene = load_scene(tmp_path, test_every=0)

    assert any("georeferenced" in note for note in scene.notes)
    rotation, shift = (
        _parse_numbers(CHUNK_ROTATION, 9, "").reshape(3, 3),
        _parse_numbers(CHUNK_TRANSLATION, 3, ""),
    )
    for view, (longitude, latitude, height, tilt, heading) in zip(scene.views, RECORDED_POSES.values(), strict=True):
        place, axes = geocentric(longitude, latitude, height)
        offset = axes @ (CHUNK_SCALE * rotation @ view.camera.position + shift - place)
        east_north_up = axes @ rotation @ view.camera.rotation.T  # columns: right, down and forward of the camera
        assert np.hypot(*offset[:2]) < 4 and abs(offset[2]) < 60  # metres, the error of a GPS receiver
        assert math.degrees(math.acos(-east_north_up[2, 2])) == pytest.approx(tilt, abs=2)
        top = math.degrees(math.atan2(-east_north_up[0, 1], -east_north_up[1, 1]))
        assert top == pytest.approx(heading, abs=12)  # degrees, the error of a compass


def geocentric(longitude: float, latitude: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a place on WGS 84 in metres from the Earth's centre, and its east, north and up directions as rows."""
    lon, lat = math.radians(longitude), math.radians(latitude)
    squared = 6.69437999014e-3
    normal = 6378137 / math.sqrt(1 - squared * math.sin(lat) ** 2)
    flat = (normal + height) * math.cos(lat)
    up = [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)]
    east = [-math.sin(lon), math.cos(lon), 0]
    place = [flat * math.cos(lon), flat * math.sin(lon), (normal * (1 - squared) + height) * math.sin(lat)]
    return np.array(place), np.array([east, np.cross(up, east), up])


@pytest.mark.parametrize("kind", ["frame", "fisheye", "equidistant_fisheye"])
def test_every_lens_coefficient_has_the_effect_that_the_manual_states(tmp_path, pictures, kind):
    f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2 = values = (
        40.0,
        1.5,
        -2.5,
        0.75,
        0.5,
        -0.1,
        0.03,
        -0.01,
        0.002,
        2e-3,
        -3e-3,
    )
    names = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
    text = "".join(f"<{name}>{value}</{name}>" for name, value in zip(names, values, strict=True))

    lens = load_view_at_origin(tmp_path, pictures, kind=kind, calibration=text).load.lens

    for x, y in ((0.3, -0.2), (-0.5, 0.4), (0.0, 0.0), (0.6, 0.45)):
        bent = np.array(distort(lens, np.array([x]), np.array([y]))).ravel() * (lens.fx, lens.fy) + (lens.cx, lens.cy)
        if kind != "frame" and (x or y):
            r = math.hypot(x, y)
            x, y = x * math.atan(r) / r, y * math.atan(r) / r
        r = math.hypot(x, y)
        radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
        x2 = x * radial + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y
        y2 = y * radial + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y
        np.testing.assert_allclose(bent, (32 + cx + x2 * f + x2 * b1 + y2 * b2, 24 + cy + y2 * f), atol=1e-9)


def test_a_spherical_sensor_gives_six_views_of_each_panorama(tmp_path, pictures):
    view = load_view_at_origin(tmp_path, pictures, size=(128, 64), kind="spherical", calibration="")
    scene = load_scene(tmp_path, test_every=0)

    assert len(scene.views) == 12
    assert [v.name for v in scene.views[:6]] == [
        f"a_{face}.jpg" for face in ("back", "down", "front", "left", "right", "up")
    ]
    assert view.load().rgb.shape == (41, 41, 3) and view.camera.intrinsics == (20.5,) * 4


def test_labels_are_paths_or_names_without_an_ending(tmp_path, pictures):
    pictures(tmp_path, ["photos/101/a.jpg", "photos/102/a.jpg", "photos/35.png"])
    labels = ("/home/user/photos/101/a.jpg", "D:\\photos\\102\\a.jpg", "35")
    poses = [f"1 0 0 {x} 0 1 0 0 0 0 1 0 0 0 0 1" for x in range(3)]
    cameras = "".join(camera(label, pose, i) for i, (label, pose) in enumerate(zip(labels, poses, strict=True)))
    (tmp_path / "cameras.xml").write_text(document(cameras, size=(32, 24), calibration="<f>30</f>"))

    assert [view.name for view in load_scene(tmp_path).views] == ["101/a.jpg", "102/a.jpg", "35.png"]


def test_cameras_without_a_pose_are_skipped(tmp_path, pictures):
    pictures(tmp_path, ["a.jpg", "b.jpg", "c.jpg", "d.jpg"])
    pose = "1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1"
    cameras = camera("a", pose.format(0)) + '<camera id="1" sensor_id="0" label="b"/>'
    cameras += f'<group id="0">{camera("c", pose.format(1), 2)}</group>' + camera(
        "d", pose.format(2), 3, 'enabled="false"'
    )
    (tmp_path / "cameras.xml").write_text(document(cameras, size=(32, 24), calibration="<f>30</f>"))

    scene = load_scene(tmp_path)

    assert [view.name for view in scene.views] == ["a.jpg", "c.jpg"]
    assert any("1 photo has no pose" in note for note in scene.notes)


def test_the_largest_component_is_used(tmp_path, pictures):
    """A camera without a component is used with any, and is none of its own."""
    pictures(tmp_path, ["a.jpg", "b.jpg", "c.jpg", "d.jpg"])
    pose = "1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1"
    cameras = "".join(camera(name, pose.format(i), i) for i, name in enumerate("abcd"))
    cameras = cameras.replace('component_id="0" label="c"', 'component_id="1" label="c"')
    cameras = cameras.replace('component_id="0" label="d"', 'label="d"')
    (tmp_path / "cameras.xml").write_text(document(cameras, size=(32, 24), calibration="<f>30</f>"))

    scene = load_scene(tmp_path)

    assert len(scene.views) == 3 and any("there are 2 components" in note for note in scene.notes)


def test_other_xml_files_are_ignored(tmp_path, nerfstudio_folder):
    root = nerfstudio_folder()
    (root / "a.xml").write_text("<project><document/></project>")

    assert load_scene(root).notes == []


VALID_CAMERAS = camera("a", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1") + camera("b", "1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1", 1)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (document(VALID_CAMERAS)[:400], "not valid XML"),
        (
            document(VALID_CAMERAS).replace("<document", '<!DOCTYPE x [<!ENTITY y "z">]><document', 1),
            "declares entities",
        ),
        (document(VALID_CAMERAS).replace("UTF-8", "UTF-99"), "not valid XML"),
        (document(""), "no camera in it has a pose"),
        (document(VALID_CAMERAS.replace("1 0 0 1 ", "1 0 0 nan ")), "16 finite numbers"),
        (document(VALID_CAMERAS.replace("1 0 0 1 ", "1 0 1 ")), "16 finite numbers"),
        (document(VALID_CAMERAS.replace("1 0 0 1 ", "2 0 0 1 ")), "not rigid"),
        (document(VALID_CAMERAS.replace('sensor_id="0"', 'sensor_id="5"')), "does not describe"),
        (document(VALID_CAMERAS.replace('label="b"', "")), "has no label"),
        (document(VALID_CAMERAS, calibration="<f>-5</f>"), "unusable intrinsics"),
        (document(VALID_CAMERAS, calibration="<f>inf</f>"), "1 finite numbers"),
        (document(VALID_CAMERAS, calibration=""), "no calibration"),
        (document(VALID_CAMERAS, calibration="<f>30</f><p3>1</p3>"), "p3 or p4"),
        (document(VALID_CAMERAS, kind="cylindrical"), "'cylindrical', which is not supported"),
        (document(VALID_CAMERAS, size=("wide", 5)), "1 finite numbers"),
        (document(VALID_CAMERAS, size=(99, 5)), "not a uniform rescaling"),
        (document(VALID_CAMERAS, transform="<transform><rotation>1 0</rotation></transform>"), "9 finite numbers"),
        (
            document(VALID_CAMERAS, transform=f"<transform><rotation>{'2 ' * 9}</rotation></transform>"),
            "not a rotation",
        ),
    ],
)
def test_broken_cameras_are_a_clear_error(tmp_path, pictures, text, says):
    pictures(tmp_path, ["a.jpg", "b.jpg"])
    (tmp_path / "cameras.xml").write_text(text)

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(tmp_path)

    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_a_label_that_fits_two_photos_is_not_called_missing(tmp_path, pictures):
    pictures(tmp_path, ["0.jpg", "0.png", "1.jpg"], size=(48, 36))
    (tmp_path / "cameras.xml").write_text(
        document(camera("0", NADIR_TRANSFORM) + camera("1", OBLIQUE_TRANSFORM, 1), size=(48, 36))
    )

    notes = load_scene(tmp_path, test_every=0).notes

    assert any("was not matched (such as 0)" in note for note in notes)
    assert not any("not on disk" in note for note in notes)


def test_labels_that_fit_several_photos_are_an_error(tmp_path, pictures):
    names = [f"{index}.png" for index in range(2)]
    for folder in ("left", "right"):
        pictures(tmp_path / folder, names, size=(48, 36))
    (tmp_path / "cameras.xml").write_text(
        document(camera("0", NADIR_TRANSFORM) + camera("1", OBLIQUE_TRANSFORM, 1), size=(48, 36))
    )

    with pytest.raises(HyrfDataError, match="cannot be assigned to files, because 0 matches more than one file"):
        load_scene(tmp_path)
