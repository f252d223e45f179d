"""Closed meshes for physics engines: always closed, as thick as stated, and near the surface."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.mesh.clean import reduce_faces
from hyrfpack.mesh.manifold import make_manifold
from hyrfpack.mesh.solid import WALL_VOXELS, make_proxy, measure_distances


def mesh_of(vertices: np.ndarray, faces: np.ndarray, merge: bool = False) -> trimesh.Trimesh:
    """Return a mesh; with `merge`, vertices at one place become one, as in many programs that read files."""
    return trimesh.Trimesh(vertices.astype(np.float32) if merge else vertices, faces, process=merge)


def check_closed(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Check that each edge has two triangles, in opposite directions, also after a program has merged vertices."""
    directed = np.concatenate((faces[:, :2], faces[:, 1:], faces[:, [2, 0]]))
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert {tuple(edge) for edge in directed.tolist()} == {tuple(edge) for edge in directed[:, ::-1].tolist()}
    for merge in (False, True):
        mesh = mesh_of(vertices, faces, merge)
        assert mesh.is_watertight and mesh.is_winding_consistent


def cube(offset=(0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=(np.array(offset), np.array(offset) + 1.0))


def joined(*meshes: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Return one mesh in which vertices at one place are one."""
    mesh = trimesh.util.concatenate(meshes)
    mesh.merge_vertices()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)


def sheet(half: float, step: float, height=lambda x, y: 0 * x) -> tuple[np.ndarray, np.ndarray]:
    """Return a square sheet over [-half, half]^2 that faces up."""
    count = round(2 * half / step) + 1
    x, y = np.meshgrid(np.linspace(-half, half, count), np.linspace(-half, half, count), indexing="ij")
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return np.stack((x, y, height(x, y)), -1).reshape(-1, 3), np.concatenate((np.c_[a, b, c], np.c_[a, c, d]))


# -- cutting sheets apart ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [(1, 1, 0), (1, 1, 1), (0, 1, 1)], ids=["edge", "corner", "another edge"])
def test_cubes_that_touch_are_cut_apart(offset):
    vertices, faces = joined(cube(), cube(offset))
    assert offset == (1, 1, 1) or not mesh_of(vertices, faces).is_watertight
    cut, triangles = make_manifold(vertices, faces, 1e-3)
    check_closed(cut, triangles)
    assert [part.volume for part in mesh_of(cut, triangles).split()] == pytest.approx([1, 1], abs=0.01)
    assert np.abs(cut - np.round(cut)).max() < 1.1e-3


def boundary_of_cells(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the boundary of unit cubes (X, Y, Z) bool, counter-clockwise seen from outside."""
    padded, quads = np.pad(cells, 1), []
    for axis in range(3):
        u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        for side in (0, 1):
            neighbor = np.roll(padded, 1 - 2 * side, axis)
            low = np.argwhere(padded & ~neighbor) - 1 + side * np.eye(3, dtype=int)[axis]
            quad = np.stack((low, low + u, low + u + v, low + v), axis=1)
            quads.append(quad if side else quad[:, ::-1])
    corners, index = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    a, b, c, d = index.reshape(-1, 4).T
    return corners.astype(float), np.concatenate((np.c_[a, b, c], np.c_[a, c, d]))


@given(st.lists(st.booleans(), min_size=27, max_size=27).filter(any))
def test_cells_that_touch_along_edges_and_corners_are_cut_apart(cells):
    vertices, faces = boundary_of_cells(np.array(cells).reshape(3, 3, 3))
    assert mesh_of(vertices, faces).volume == pytest.approx(sum(cells))
    cut, triangles = make_manifold(vertices, faces, 1e-3)
    check_closed(cut, triangles)
    assert mesh_of(cut, triangles).volume == pytest.approx(sum(cells), abs=0.01 * sum(cells))


def test_sheets_of_no_thickness_vanish():
    vertices, faces = joined(cube(), cube((1, 1, 0)))
    cut, triangles = make_manifold(vertices, np.concatenate((faces, faces[:, ::-1], faces)), 1e-3)
    check_closed(cut, triangles)
    assert mesh_of(cut, triangles).volume == pytest.approx(2, abs=0.01)


def test_a_mesh_that_is_manifold_stays_as_it_is():
    sphere = trimesh.creation.icosphere(2)
    vertices, faces = make_manifold(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int64), 0.1)
    assert sorted(map(tuple, vertices.tolist())) == sorted(map(tuple, sphere.vertices.tolist()))
    assert mesh_of(vertices, faces).volume == pytest.approx(sphere.volume)


@examples(25)
@given(st.integers(0, 1000), st.integers(20, 400))
def test_thin_solids_stay_closed_after_any_reduction(seed, count):
    generator = np.random.default_rng(seed)
    waves = generator.uniform(-0.3, 0.3, (4, 4))

    def height(x, y):
        return sum(a * np.sin(3 * b * 9 * x + c * 9) * np.cos(25 * d * y) for a, b, c, d in waves)

    vertices, faces = sheet(1.0, 0.1, height)
    back = vertices - (0, 0, generator.uniform(0.001, 0.1))
    count_top = len(vertices)
    edges = np.concatenate((faces[:, :2], faces[:, 1:], faces[:, [2, 0]]))
    known = {tuple(edge) for edge in edges.tolist()}
    rim = np.array([edge for edge in edges.tolist() if (edge[1], edge[0]) not in known])
    a, b = rim.T
    sides = np.concatenate((np.c_[b, a, a + count_top], np.c_[b, a + count_top, b + count_top]))
    slab = np.concatenate((vertices, back)), np.concatenate((faces, faces[:, ::-1] + count_top, sides))
    assert mesh_of(*slab).is_watertight
    check_closed(*make_manifold(*reduce_faces(*slab, count), 1e-3))


# -- proxies ----------------------------------------------------------------------------------------------------------


@pytest.mark.acceptance
def test_a_sheet_becomes_a_slab_whose_front_is_the_sheet():
    vertices, faces = sheet(1.0, 0.0125)
    proxy = make_proxy(vertices, faces, 0.00625, 300)
    check_closed(proxy.vertices, proxy.faces)
    assert len(proxy.faces) <= 310
    assert proxy.wall == pytest.approx(WALL_VOXELS * 0.0125)
    assert np.abs(proxy.vertices[:, 2].max()) < 0.002 and proxy.vertices[:, 2].min() == pytest.approx(
        -proxy.wall, abs=0.002
    )
    assert mesh_of(proxy.vertices, proxy.faces).volume == pytest.approx(4 * proxy.wall, rel=0.06)
    assert proxy.surface_distances.max() < 0.5 * 0.0125
    assert proxy.proxy_distances.max() < proxy.wall + 0.003


@pytest.mark.acceptance
@pytest.mark.usefixtures("quick_distances")
def test_a_sphere_that_is_open_below_becomes_a_closed_bowl():
    sphere = trimesh.creation.icosphere(5)
    faces = np.asarray(sphere.faces)[sphere.triangles_center[:, 2] > -0.7]
    proxy = make_proxy(np.asarray(sphere.vertices), faces, 0.01, 2000)
    check_closed(proxy.vertices, proxy.faces)
    radii = np.linalg.norm(proxy.vertices, axis=1)
    assert radii.max() < 1.01 and radii.min() > 1 - proxy.wall - 0.01
    assert np.quantile(proxy.surface_distances, 0.95) < 0.01


@pytest.mark.usefixtures("quick_distances")
def test_a_closed_sphere_becomes_solid_without_its_cavity():
    sphere = trimesh.creation.icosphere(5)
    proxy = make_proxy(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int64), 0.01, 2000)
    check_closed(proxy.vertices, proxy.faces)
    mesh = mesh_of(proxy.vertices, proxy.faces)
    assert mesh.body_count == 1 and mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.01)


@pytest.mark.acceptance
@pytest.mark.usefixtures("quick_distances")
def test_narrow_gaps_are_filled_and_wide_ones_stay():
    vertices, faces = sheet(1.0, 0.0125)
    middles = vertices[faces].mean(axis=1)
    for half, genus in ((0.015, 0), (0.2, 1)):
        hole = (np.abs(middles[:, :2]) < half).all(axis=1)
        assert hole.any()
        proxy = make_proxy(vertices, faces[~hole], 0.00625, 1000)
        check_closed(proxy.vertices, proxy.faces)
        assert mesh_of(proxy.vertices, proxy.faces).euler_number == 2 - 2 * genus


@pytest.mark.acceptance
@pytest.mark.usefixtures("quick_distances")
def test_small_parts_are_left_out():
    vertices, faces = sheet(1.0, 0.0125)
    speck = sheet(0.03, 0.0125)[0] + (0.5, 0.5, 0.6), sheet(0.03, 0.0125)[1] + len(vertices)
    proxy = make_proxy(np.concatenate((vertices, speck[0])), np.concatenate((faces, speck[1])), 0.00625, 1000)
    assert proxy.vertices[:, 2].max() < 0.01


def test_distances_are_those_of_parallel_planes():
    low, high = sheet(1.0, 0.5), sheet(1.0, 0.25, lambda x, y: 0 * x + 0.3)
    assert measure_distances(*high, *low) == pytest.approx(0.3)
    assert measure_distances(*low, *high) == pytest.approx(0.3, abs=1e-3)
