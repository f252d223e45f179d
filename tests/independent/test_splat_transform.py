"""splat-transform reads the files that we write, and we read the files that splat-transform writes.

It is by PlayCanvas and handles SPZ by Niantic's own library.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from independent.clouds import cloud_from_ply, cloud_from_splats, compare_clouds, ply_from_splats, sample_splats
from independent.formats import COMPRESSED_PLY_PRECISION, SOG_PRECISION, SPLAT_FORMATS, SPZ_PRECISION
from independent.ply_files import read_ply, write_ply
from layers import only_in_acceptance

from hyrfpack.splats.formats import gltf
from hyrfpack.splats.table import FORMATS as FORMATS_BY_SUFFIX

READABLE_FORMATS = ("ply", "splat", "spz3", "spz4", "sog")


def convert_files(node: Callable, conversions: list[tuple]) -> None:
    complaints = node("convert.mjs", json.dumps([[str(word) for word in conversion] for conversion in conversions]))
    assert complaints == [None] * len(conversions)


@pytest.mark.parametrize("kind", only_in_acceptance(READABLE_FORMATS, {"ply", "splat", "spz3"}))
def test_splat_transform_reads_what_we_write(kind, node, tmp_path):
    form = SPLAT_FORMATS[kind]
    files = {degree: tmp_path / f"{degree}.{form.extension}" for degree in form.degrees}
    for degree, file in files.items():
        file.write_bytes(form.encode(sample_splats(degree)))
    convert_files(node, [(file, file.with_suffix(".read.ply")) for file in files.values()])
    for degree, file in files.items():
        theirs = cloud_from_ply(read_ply(file.with_suffix(".read.ply")))
        measured = compare_clouds(cloud_from_splats(sample_splats(degree)), theirs)
        assert measured.is_within(form.precision), degree


# By file name: the degree of harmonics, the options of splat-transform and the precision of the format.
WRITTEN_FILES = {
    "plain.ply": (3, (), SPLAT_FORMATS["ply"].precision),
    "packed.compressed.ply": (3, (), COMPRESSED_PLY_PRECISION),
    "packed_0.compressed.ply": (0, (), COMPRESSED_PLY_PRECISION),
    "version_3.spz": (3, ("--spz-version", "3"), SPZ_PRECISION),
    "version_4.spz": (2, ("--spz-version", "4"), SPZ_PRECISION),
    "bundle.sog": (1, ("--iterations", "2"), SOG_PRECISION),
}


@pytest.fixture(scope="module")
def written_folder(node, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Have splat-transform convert PLY files to the files of WRITTEN_FILES; return their folder."""
    folder = tmp_path_factory.mktemp("splat_transform")
    for degree in range(4):
        write_ply(folder / f"{degree}.ply", ply_from_splats(sample_splats(degree)))
    convert_files(
        node, [(folder / f"{d}.ply", folder / name, *options) for name, (d, options, _) in WRITTEN_FILES.items()]
    )
    return folder


@pytest.mark.acceptance
@pytest.mark.parametrize("name", WRITTEN_FILES)
def test_we_read_what_splat_transform_writes(name, written_folder):
    degree, _, precision = WRITTEN_FILES[name]
    ours = FORMATS_BY_SUFFIX[Path(name).suffix].decode((written_folder / name).read_bytes(), name)
    assert compare_clouds(cloud_from_splats(sample_splats(degree)), cloud_from_splats(ours)).is_within(precision)


@pytest.mark.acceptance
def test_we_read_a_glb_of_splat_transform_in_its_own_axes(written_folder, node):
    glb = written_folder / "turned.glb"
    convert_files(node, [(written_folder / "3.ply", glb)])
    ours = cloud_from_splats(gltf.decode(glb.read_bytes(), glb.name))
    # Its own viewer has y up.
    half_turn = cloud_from_splats(sample_splats(3).rotated([[-1, 0, 0], [0, -1, 0], [0, 0, 1]]))
    assert compare_clouds(half_turn, ours).is_within(replace(SPLAT_FORMATS["glb"].precision, position=2e-6))
