"""Each row of the table of formats describes its format correctly."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up_splats import random_splats

from hyrfpack.errors import HyrfDataError
from hyrfpack.ops.harmonics import MAX_DEGREE
from hyrfpack.splats.formats.hints import NO_HINTS
from hyrfpack.splats.table import FORMATS, SplatFormat

# By format: the largest errors of positions, logarithms of scales, quaternion components, opacities and harmonics.
MAX_BYTE_ERROR = 0.5 / 255 * 1.01
FLOAT32_ERRORS = (1e-6, 1e-6, 1e-6, 1e-6, 1e-6)
MAX_ERRORS_BY_SUFFIX = dict.fromkeys((".ply", ".glb", ".usda", ".usdc", ".usdz"), FLOAT32_ERRORS) | {
    ".splat": (1e-6, 1e-6, 1 / 128, MAX_BYTE_ERROR, MAX_BYTE_ERROR / 0.282),
    ".spz": (1e-6, 1 / 32 * 1.01, 1 / 300, MAX_BYTE_ERROR, 1 / 32),
    ".sog": (1e-3, 0.02, 1 / 128, MAX_BYTE_ERROR, 0.02),
}


def encode_with(row: SplatFormat, splats) -> bytes:
    if row.module:
        pytest.importorskip(row.module)
    return row.encode(splats, NO_HINTS)


@pytest.mark.parametrize("degree", range(MAX_DEGREE + 1))
@pytest.mark.parametrize("ending", FORMATS)
def test_every_format_round_trips_within_its_precision(ending, degree):
    row, splats = FORMATS[ending], random_splats(degree=degree)
    # The range of SPZ, the narrowest of all formats.
    splats = replace(splats, harmonics=np.clip(splats.harmonics, -0.95, 0.95))
    back = row.decode(encode_with(row, splats), "it")
    assert len(back) == len(splats) and back.degree == min(degree, row.max_degree)
    splats = splats.with_degree(back.degree)
    apart = np.linalg.norm(back.positions[:, None] - splats.positions, axis=-1)
    back = back[apart.argmin(0)]  # formats may reorder Gaussians
    signs = np.sign((back.quats * splats.quats).sum(1, keepdims=True))
    found = (
        back.positions - splats.positions,
        np.log(back.scales / splats.scales),
        signs * back.quats - splats.quats,
        back.opacities - splats.opacities,
        back.harmonics - splats.harmonics,
    )
    for error, most in zip(found, MAX_ERRORS_BY_SUFFIX[ending], strict=True):
        assert np.abs(error).max() <= most


@pytest.mark.parametrize("ending", FORMATS)
def test_stores_antialiased_matches_the_format(ending):
    row = FORMATS[ending]
    for antialiased in (False, True):
        assert row.decode(encode_with(row, replace(random_splats(), antialiased=antialiased)), "it").antialiased == (
            antialiased and row.stores_antialiased
        )


@pytest.mark.parametrize("ending", FORMATS)
def test_max_coordinate_and_max_scale_match_the_format(ending):
    row, splats = FORMATS[ending], random_splats()
    reach = min(row.max_coordinate, 1e30)
    far = replace(splats, positions=np.where(np.arange(len(splats))[:, None] == 0, reach, splats.positions))
    assert row.decode(encode_with(row, far), "it").positions.max() == pytest.approx(reach)
    if np.isfinite(row.max_coordinate):
        with pytest.raises(HyrfDataError, match="units from the origin"):
            encode_with(row, replace(far, positions=far.positions * 1.01))
    large = replace(splats, scales=splats.scales * np.float32(1e6))
    largest = min(row.max_scale, large.scales.max())
    assert row.decode(encode_with(row, large), "it").scales.max() == pytest.approx(largest, rel=1e-5)


def test_every_suffix_has_one_row_and_none_ends_with_another():
    assert [row.ending for row in FORMATS.values()] == list(FORMATS)
    for ending in FORMATS:
        assert [other for other in FORMATS if f"scene{ending}".endswith(other)] == [ending]


def suffixes_in_docs(page: str, start: str, stop: str) -> set[str]:
    """Return the suffixes in the first column of a table in the docs."""
    text = (Path(__file__).parents[2] / "docs" / "how-to" / page).read_text(encoding="utf-8")
    rows = text[text.index(start) :].partition(stop)[0]
    return {ending for line in rows.splitlines() for ending in re.findall(r"`(\.[\w.]+)`", line.split("|")[1])}


def test_the_docs_list_the_suffixes_of_the_table():
    from hyrfpack.export.kinds import EXPORT_ENDINGS

    assert suffixes_in_docs("export.md", "| ending |", "\n\n") == set(EXPORT_ENDINGS) > set(FORMATS)
    assert suffixes_in_docs("import.md", "| readable format |", "\n\n") == {
        row.ending for row in FORMATS.values() if row.is_readable
    }


@pytest.mark.acceptance
def test_the_table_imports_no_optional_packages():
    code = "import sys, hyrfpack.splats.table; print(*sorted({'pxr', 'trimesh', 'pycolmap'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
