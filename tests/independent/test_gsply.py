"""gsply reads the files that we write, and we read the files that gsply writes."""

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
    HALF_TURN_ABOUT_X,
    Cloud,
    cloud_from_ply,
    cloud_from_splats,
    compare_clouds,
    ply_from_splats,
    sample_splats,
    undo_rotation,
)
from independent.formats import COMPRESSED_PLY_PRECISION, SPLAT_FORMATS, SPZ_PRECISION
from independent.ply_files import StoredSplats
from PIL import Image

from hyrfpack.splats.table import FORMATS as FORMATS_BY_SUFFIX

if TYPE_CHECKING:
    from gsply import GSData


@pytest.fixture(scope="module")
def gsply() -> Iterator[ModuleType]:
    """Import gsply without Numba's compilation, which would take longer than all these tests."""
    with patch.object(numba.config, "DISABLE_JIT", True):
        gsply = pytest.importorskip("gsply", reason="gsply is not installed")
        sog_reader = importlib.import_module("gsply.sog_reader")

    def pixels(data: bytes) -> np.ndarray:
        # Compiled code would use 64-bit integers.
        return np.array(Image.open(io.BytesIO(data)).convert("RGBA"), np.int64)

    # gsply decodes WebP with imagecodecs; Pillow takes its place here.
    with patch.object(sog_reader, "imagecodecs", SimpleNamespace(webp_decode=pixels)):
        yield gsply


def cloud_from_gsply(data: GSData) -> Cloud:
    harmonics = data.sh0[:, None]
    if data.shN is not None:
        harmonics = np.concatenate((harmonics, data.shN), axis=1)
    return cloud_from_ply(StoredSplats(data.means, data.scales, data.quats, data.opacities, harmonics))


@pytest.mark.parametrize("kind", ["ply", "spz3", "spz4", "sog"])
def test_gsply_reads_what_we_write(kind, gsply, tmp_path):
    form = SPLAT_FORMATS[kind]
    read = {"ply": gsply.plyread, "spz": gsply.read_spz, "sog": gsply.sogread}[form.extension]
    for degree in form.degrees:
        file = tmp_path / f"{degree}.{form.extension}"
        file.write_bytes(form.encode(sample_splats(degree)))
        theirs = cloud_from_gsply(read(file))
        if form.extension == "spz":  # gsply keeps SPZ's axes
            theirs = undo_rotation(theirs, HALF_TURN_ABOUT_X)
        assert compare_clouds(cloud_from_splats(sample_splats(degree)), theirs).is_within(form.precision), degree


@pytest.mark.parametrize("degree", range(4))
def test_we_read_what_gsply_writes(degree, gsply, tmp_path):
    stored = ply_from_splats(sample_splats(degree))
    data = gsply.GSData(
        *(stored.positions, stored.log_scales, stored.quats, stored.opacity_logits),
        *(stored.harmonics[:, 0], stored.harmonics[:, 1:]),
    )
    gsply.writer.write_uncompressed(tmp_path / "plain.ply", data)  # `plywrite` would import most of torch
    (tmp_path / "packed.compressed.ply").write_bytes(gsply.compress_to_bytes(data))
    gsply.write_spz(tmp_path / "3.spz", data, version=3)
    gsply.write_spz(tmp_path / "4.spz", data, version=4)
    precisions = {"plain.ply": SPLAT_FORMATS["ply"].precision, "packed.compressed.ply": COMPRESSED_PLY_PRECISION}
    for name, precision in (precisions | {"3.spz": SPZ_PRECISION, "4.spz": SPZ_PRECISION}).items():
        ours = cloud_from_splats(FORMATS_BY_SUFFIX[Path(name).suffix].decode((tmp_path / name).read_bytes(), name))
        if name.endswith(".spz"):  # gsply writes the numbers of a PLY without converting the axes
            ours = undo_rotation(ours, HALF_TURN_ABOUT_X)
        assert compare_clouds(cloud_from_splats(sample_splats(degree)), ours).is_within(precision), name
