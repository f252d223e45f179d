"""gsply reads our files, and we read its files."""

from __future__ import annotations

import importlib
import io
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING
from unittest.mock import patch

import numba
import numpy as np
import pytest
from independent.clouds import (
    TURN_ABOUT_X,
    Cloud,
    cloud_of_ours,
    cloud_of_ply,
    differences,
    made_up,
    ply_of,
    turned_back,
)
from independent.formats import COMPRESSED_PLY, FORMATS, SPZ
from independent.ply_files import Stored
from PIL import Image

from hyrfpack.splats.table import FORMATS as OURS

if TYPE_CHECKING:
    from gsply import GSData


@pytest.fixture(scope="module")
def gsply() -> Iterator[ModuleType]:
    """The package, interpreted: to compile it would take longer than all these tests."""
    with patch.object(numba.config, "DISABLE_JIT", True):
        gsply = pytest.importorskip("gsply", reason="gsply is not installed")
        sog_reader = importlib.import_module("gsply.sog_reader")

    def pixels(data: bytes) -> np.ndarray:
        return np.array(Image.open(io.BytesIO(data)).convert("RGBA"), np.int64)  # as wide as compiled integers are

    # In place of imagecodecs, which it asks for to unpack WebP.
    with patch.object(sog_reader, "imagecodecs", SimpleNamespace(webp_decode=pixels)):
        yield gsply


def cloud_of_gsply(data: GSData) -> Cloud:
    harmonics = data.sh0[:, None]
    if data.shN is not None:
        harmonics = np.concatenate((harmonics, data.shN), axis=1)
    return cloud_of_ply(Stored(data.means, data.scales, data.quats, data.opacities, harmonics))


@pytest.mark.parametrize("kind", ["ply", "spz3", "spz4", "sog"])
def test_gsply_reads_what_we_write(kind, gsply, tmp_path):
    form = FORMATS[kind]
    read = {"ply": gsply.plyread, "spz": gsply.read_spz, "sog": gsply.sogread}[form.extension]
    for degree in form.degrees:
        file = tmp_path / f"{degree}.{form.extension}"
        file.write_bytes(form.encode(made_up(degree)))
        theirs = cloud_of_gsply(read(file))
        if form.extension == "spz":  # whose axes it keeps
            theirs = turned_back(theirs, TURN_ABOUT_X)
        assert differences(cloud_of_ours(made_up(degree)), theirs).within(form.precision), degree


@pytest.mark.parametrize("degree", range(4))
def test_we_read_what_gsply_writes(degree, gsply, tmp_path):
    made = ply_of(made_up(degree))
    data = gsply.GSData(
        *(made.positions, made.log_scales, made.quats, made.opacity_logits),
        *(made.harmonics[:, 0], made.harmonics[:, 1:]),
    )
    gsply.writer.write_uncompressed(tmp_path / "plain.ply", data)  # `plywrite` would first import most of torch
    (tmp_path / "packed.compressed.ply").write_bytes(gsply.compress_to_bytes(data))
    gsply.write_spz(tmp_path / "3.spz", data, version=3)
    gsply.write_spz(tmp_path / "4.spz", data, version=4)
    precisions = {"plain.ply": FORMATS["ply"].precision, "packed.compressed.ply": COMPRESSED_PLY}
    for name, precision in (precisions | {"3.spz": SPZ, "4.spz": SPZ}).items():
        ours = cloud_of_ours(OURS[Path(name).suffix].decode((tmp_path / name).read_bytes(), name))
        if name.endswith(".spz"):  # it wrote a PLY's numbers as they were
            ours = turned_back(ours, TURN_ABOUT_X)
        assert differences(cloud_of_ours(made_up(degree)), ours).within(precision), name
