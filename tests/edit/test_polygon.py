"""Crops to polygons: against another program, exact fractions and closed forms."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from commands import refused, succeeded
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path as MatplotlibPath
from scenes import QUIET_CONTEXT

from hyrfpack.config.edit import CropPolygon, Remove, Translate, Up
from hyrfpack.edit import plan_edit
from hyrfpack.edit.polygon import find_distinct_corners, inside_mask, read_polygon
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.format import load_model

MODEL_FILE = Path(__file__).parents[1] / "golden" / "trained" / "demo_compact.hyrf"
UPRIGHT = Up((0.0, 0.0, 1.0))
L_SHAPE = np.array([(0, 0), (4, 0), (4, 1), (1, 1), (1, 3), (0, 3)], float)


def world_positions() -> np.ndarray:
    model = load_model(MODEL_FILE)
    return model.config.frame.to_world(model.gaussians.positions.numpy())


def count_kept(*actions) -> int:
    return plan_edit(MODEL_FILE, actions, context=QUIET_CONTEXT).actions[-1].gaussians_after


# -- inside or outside ------------------------------------------------------------------------------------------------


@given(st.integers(3, 40), st.integers(0, 10_000))
def test_concave_polygons_hold_the_points_that_matplotlib_finds_in_them(corner_count, seed):
    generator = np.random.default_rng(seed)
    angles = np.sort(generator.uniform(0, 2 * np.pi, corner_count))
    radii = generator.uniform(0.2, 1, corner_count)  # a polygon around the origin whose sides never meet
    corners = radii[:, None] * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    points = generator.uniform(-1.1, 1.1, (500, 2))
    expected = MatplotlibPath(corners).contains_points(points)
    assert (inside_mask(points, corners) == expected).all()
    assert (inside_mask(points, corners[::-1]) == expected).all()


def test_an_l_shape_is_the_union_of_two_rectangles():
    points = np.random.default_rng(0).uniform(-1, 5, (4000, 2))
    x, y = points.T
    expected = ((0 < x) & (x < 4) & (0 < y) & (y < 1)) | ((0 < x) & (x < 1) & (0 < y) & (y < 3))
    assert (inside_mask(points, L_SHAPE) == expected).all() and 0 < expected.sum() < len(points)


# -- sides that meet --------------------------------------------------------------------------------------------------


def segments_meet(a, b, c, d) -> bool:
    """Return whether the segments ab and cd share a point, by the exact solution of a + s (b - a) = c + t (d - c)."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = ([Fraction(int(value)) for value in point] for point in (a, b, c, d))
    determinant = (bx - ax) * (cy - dy) - (by - ay) * (cx - dx)
    if determinant:
        s = ((cx - ax) * (cy - dy) - (cy - ay) * (cx - dx)) / determinant
        t = ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / determinant
        return 0 <= s <= 1 and 0 <= t <= 1
    if (bx - ax) * (cy - ay) != (by - ay) * (cx - ax):
        return False
    length = (bx - ax) ** 2 + (by - ay) ** 2
    along = sorted(((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length for x, y in ((cx, cy), (dx, dy)))
    return along[0] <= 1 and along[1] >= 0


def leads_back(a, b, c) -> bool:
    """Return whether the side from b to c covers a part of the side from a to b."""
    (ux, uy), (vx, vy) = (b - a).tolist(), (c - b).tolist()
    return ux * vy == uy * vx and ux * vx + uy * vy < 0


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=3, max_size=7, unique=True))
def test_polygons_are_refused_exactly_if_two_of_their_sides_meet(points):
    corners, count = np.array(points, float), len(points)
    sides = [(corners[i], corners[(i + 1) % count]) for i in range(count)]
    meet = any(
        segments_meet(*sides[i], *sides[j]) for i in range(count) for j in range(i + 2, count) if (j + 1) % count != i
    ) or any(leads_back(corners[i - 1], corners[i], corners[(i + 1) % count]) for i in range(count))
    if meet:
        with pytest.raises(HyrfError, match="meets the side after point"):
            find_distinct_corners(corners)
    else:
        assert find_distinct_corners(corners).tolist() == list(range(count))


@pytest.mark.parametrize("closing", [0, 1, 2])
def test_messages_number_the_points_as_they_were_given(closing):
    corners = np.array([(0, 0), (1, 1), (1, 0), (0, 1)], float)
    with pytest.raises(HyrfError, match="the side after point 1 .* the side after point 3"):
        find_distinct_corners(np.concatenate((corners, np.repeat(corners[:1], closing, axis=0))))


def test_a_closing_corner_and_repetitions_are_dropped():
    closed = np.concatenate((L_SHAPE[:2], L_SHAPE[1:], L_SHAPE[:1]))
    assert find_distinct_corners(closed).tolist() == [0, 1, *range(3, len(closed) - 1)]
    with pytest.raises(HyrfError, match="fewer than three corners"):
        find_distinct_corners(np.array([(0, 0), (1, 0), (1, 0), (0, 0)], float))


# -- edits ------------------------------------------------------------------------------------------------------------


def test_a_crop_keeps_what_is_above_the_polygon_between_its_heights():
    positions = world_positions()
    x, y, z = np.quantile(positions, 0.5, axis=0)
    corners = ((x - 1, y - 1, z), (x + 1, y - 1, z), (x + 1, y, z), (x, y, z), (x, y + 1, z), (x - 1, y + 1, z))
    across = positions[:, :2] - (x, y)
    over = (np.abs(across) < 1).all(axis=1) & ~(across > 0).all(axis=1)
    between = over & (positions[:, 2] >= z - 0.1) & (positions[:, 2] <= z + 0.5)
    assert 0 < between.sum() < over.sum() < len(over)
    assert count_kept(UPRIGHT, CropPolygon(corners)) == over.sum()
    assert count_kept(UPRIGHT, CropPolygon(corners, -0.1, 0.5)) == between.sum()
    assert count_kept(UPRIGHT, Remove(CropPolygon(corners, -0.1, 0.5))) == (~between).sum()


def test_a_polygon_is_seen_along_the_up_direction_of_the_scene():
    positions, up = world_positions(), np.array([0.6, 0.0, 0.8])
    sideways, middle = np.array([0.8, 0.0, -0.6]), np.median(positions, axis=0)
    lift = np.linspace(-3, 3, 4)[:, None] * up  # where a corner lies along the up direction does not matter
    plan = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]) @ np.stack((sideways, (0, 1, 0)))
    corners = tuple(map(tuple, (middle + plan + lift).tolist()))
    across = np.stack(((positions - middle) @ sideways, (positions - middle)[:, 1]))
    inside = (np.abs(across) < 0.5).all(axis=0) & ((positions - middle) @ up <= 0.3)
    assert 0 < inside.sum() < len(inside)
    assert count_kept(Up(tuple(up.tolist())), CropPolygon(corners, max_height=0.3)) == inside.sum()


def test_a_polygon_far_from_the_origin_is_as_exact():
    x, y, z = np.median(world_positions(), axis=0)
    corners = np.array([(x - 1, y - 1, z), (x + 1, y, z), (x, y + 1, z)])
    far = np.array([4e5, 5e6, 0])
    moved = count_kept(
        UPRIGHT, Translate(tuple(far.tolist())), CropPolygon(tuple(map(tuple, (corners + far).tolist())))
    )
    assert moved == pytest.approx(count_kept(UPRIGHT, CropPolygon(tuple(map(tuple, corners.tolist())))), abs=1)


# -- files and options ------------------------------------------------------------------------------------------------


def test_the_command_reads_a_polygon_and_inverts_it(tmp_path):
    x, y, z = np.median(world_positions(), axis=0).tolist()
    points = [[x - 1, y - 1, z], [x + 1, y - 1, z], [x, y + 1, z]]
    (tmp_path / "plain.json").write_text(json.dumps(points))
    (tmp_path / "full.json").write_text(json.dumps({"points": points, "max_height": 0.2}))
    kept = {}
    for name, options in (("plain", ()), ("full", ()), ("full", ("--invert",))):
        words = ("edit", MODEL_FILE, "--plan", "--up", "0,0,1", "--crop-polygon", tmp_path / f"{name}.json")
        (_, step) = json.loads(succeeded(*words, *options, "--json").stdout)["actions"]
        kept[(name, *options)] = step["gaussians_after"]
        total = step["gaussians_before"]
    assert 0 < kept["full",] < kept["plain",] < total
    assert kept["full", "--invert"] == total - kept["full",]
    assert step["action"] == "remove the polygon of 3 points, heights below 0.2"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_polygon_may_have_the_encodings_of_windows_editors(encoding, tmp_path):
    points = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0))
    (tmp_path / "polygon.json").write_text(json.dumps(points), encoding=encoding)
    assert read_polygon(tmp_path / "polygon.json").points == points


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{", "this is not JSON"),
        ("[[0, 0, 0], [1, 0, 0]]", "2 different points; it needs at least three"),
        ("[[0, 0], [1, 0], [1, 1]]", "list of [x, y, z]"),
        ("[[0, 0, 0], [1, 0, 0], [1, 1, NaN]]", "three finite numbers"),
        ('[[0, 0, 0], [1, 0, 0], [1, 1, "a"]]', '"a" is not a number'),
        ("[[0, 0, 0], [1, 0, 0], [1, 1, true]]", "true is not a number"),
        ('{"points": [[0, 0, 0], [1, 0, 0], [1, 1, 0]], "min_height": [1]}', "[1] is not a number"),
        ('{"points": [[0, 0, 0], [1, 0, 0], [1, 1, 0]], "height": 2}', "no key 'height'"),
        ('{"points": [[0, 0, 0], [1, 0, 0], [1, 1, 0]], "min_height": 2, "max_height": 1}', "must be lower"),
        ('{"type": "Polygon"}', "no key 'type'"),
        ("3", "list of [x, y, z]"),
    ],
)
def test_files_that_hold_no_polygon_are_refused(text, problem, tmp_path):
    path = tmp_path / "polygon.json"
    path.write_text(text)
    with pytest.raises(HyrfDataError, match="polygon.json") as caught:
        read_polygon(path)
    assert problem in str(caught.value)


def test_a_polygon_whose_sides_cross_is_refused_with_the_points(tmp_path):
    (tmp_path / "bow.json").write_text("[[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0]]")
    sentence = refused("edit", MODEL_FILE, "--plan", "--up", "0,0,1", "--crop-polygon", tmp_path / "bow.json")
    assert "the side after point 1 of the polygon meets the side after point 3" in sentence
    assert "in their order around the polygon" in sentence
    assert "cannot be read" in refused("edit", MODEL_FILE, "--plan", "--crop-polygon", tmp_path / "missing.json")
