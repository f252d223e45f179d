"""splat-transform (PlayCanvas; SPZ through Niantic's own library) reads our files, and we read its files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from independent.clouds import cloud_of_ours, cloud_of_ply, differences, made_up, ply_of
from independent.formats import COMPRESSED_PLY, FORMATS, SOG, SPZ
from independent.ply_files import read_ply, write_ply

from hyrfpack.splats.formats import gltf
from hyrfpack.splats.table import FORMATS as OURS

READ = ("ply", "splat", "spz3", "spz4", "sog")


def convert(node: Callable, conversions: list[tuple]) -> None:
    complaints = node("convert.mjs", json.dumps([[str(word) for word in conversion] for conversion in conversions]))
    assert complaints == [None] * len(conversions)


@pytest.mark.parametrize("kind", READ)
def test_splat_transform_reads_what_we_write(kind, node, tmp_path):
    form = FORMATS[kind]
    files = {degree: tmp_path / f"{degree}.{form.extension}" for degree in form.degrees}
    for degree, file in files.items():
        file.write_bytes(form.encode(made_up(degree)))
    convert(node, [(file, file.with_suffix(".read.ply")) for file in files.values()])
    for degree, file in files.items():
        theirs = cloud_of_ply(read_ply(file.with_suffix(".read.ply")))
        found = differences(cloud_of_ours(made_up(degree)), theirs)
        assert found.within(form.precision), degree


WRITTEN = {
    "plain.ply": (3, (), FORMATS["ply"].precision),
    "packed.compressed.ply": (3, (), COMPRESSED_PLY),
    "packed_0.compressed.ply": (0, (), COMPRESSED_PLY),
    "version_3.spz": (3, ("--spz-version", "3"), SPZ),
    "version_4.spz": (2, ("--spz-version", "4"), SPZ),
    "bundle.sog": (1, ("--iterations", "2"), SOG),
}


@pytest.fixture(scope="module")
def written(node, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files of WRITTEN, which splat-transform made of PLY files."""
    folder = tmp_path_factory.mktemp("splat_transform")
    for degree in range(4):
        write_ply(folder / f"{degree}.ply", ply_of(made_up(degree)))
    convert(node, [(folder / f"{d}.ply", folder / name, *options) for name, (d, options, _) in WRITTEN.items()])
    return folder


@pytest.mark.parametrize("name", WRITTEN)
def test_we_read_what_splat_transform_writes(name, written):
    degree, _, precision = WRITTEN[name]
    ours = OURS[Path(name).suffix].decode((written / name).read_bytes(), name)
    assert differences(cloud_of_ours(made_up(degree)), cloud_of_ours(ours)).within(precision)


def test_we_read_the_glb_of_splat_transform_in_its_own_axes(written, node):
    glb = written / "turned.glb"
    convert(node, [(written / "3.ply", glb)])
    ours = cloud_of_ours(gltf.decode(glb.read_bytes(), glb.name))
    half_turn = cloud_of_ours(made_up(3).rotated([[-1, 0, 0], [0, -1, 0], [0, 0, 1]]))  # y up, as its own viewer has it
    assert differences(half_turn, ours).within(replace(FORMATS["glb"].precision, position=2e-6))
