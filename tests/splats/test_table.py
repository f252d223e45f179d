"""The table of formats: what a row says of a format is so."""

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
from hyrfpack.splats.formats.hints import NO_HINTS
from hyrfpack.splats.harmonics import MAX_DEGREE
from hyrfpack.splats.table import FORMATS, SplatFormat

# The largest error of positions, logarithms of scales, components of quaternions, opacities and harmonics.
BYTE = 0.5 / 255 * 1.01
FLOAT = (1e-6, 1e-6, 1e-6, 1e-6, 1e-6)
PRECISION = dict.fromkeys((".ply", ".glb", ".usda", ".usdc", ".usdz"), FLOAT) | {
    ".splat": (1e-6, 1e-6, 1 / 128, BYTE, BYTE / 0.282),
    ".spz": (1e-6, 1 / 32 * 1.01, 1 / 300, BYTE, 1 / 32),
    ".sog": (1e-3, 0.02, 1 / 128, BYTE, 0.02),
}


def encoded(row: SplatFormat, splats) -> bytes:
    if row.package:
        pytest.importorskip(row.package[0])
    return row.encode(splats, NO_HINTS)


@pytest.mark.parametrize("degree", range(MAX_DEGREE + 1))
@pytest.mark.parametrize("ending", FORMATS)
def test_what_is_encoded_decodes_to_the_same_within_the_formats_precision(ending, degree):
    row, splats = FORMATS[ending], random_splats(degree=degree)
    splats = replace(splats, harmonics=np.clip(splats.harmonics, -0.95, 0.95))  # the narrowest range, that of SPZ
    back = row.decode(encoded(row, splats), "it")
    assert len(back) == len(splats) and back.degree == min(degree, row.max_degree)
    splats = splats.with_degree(back.degree)
    apart = np.linalg.norm(back.positions[:, None] - splats.positions, axis=-1)
    back = back[apart.argmin(0)]  # formats may change the order
    signs = np.sign((back.quats * splats.quats).sum(1, keepdims=True))
    found = (
        back.positions - splats.positions,
        np.log(back.scales / splats.scales),
        signs * back.quats - splats.quats,
        back.opacities - splats.opacities,
        back.harmonics - splats.harmonics,
    )
    for error, most in zip(found, PRECISION[ending], strict=True):
        assert np.abs(error).max() <= most


@pytest.mark.parametrize("ending", FORMATS)
def test_a_row_says_whether_files_say_antialiased(ending):
    row = FORMATS[ending]
    for said in (False, True):
        assert row.decode(encoded(row, replace(random_splats(), antialiased=said)), "it").antialiased == (
            said and row.stores_antialiased
        )


@pytest.mark.parametrize("ending", FORMATS)
def test_a_row_says_how_far_positions_and_scales_reach(ending):
    row, splats = FORMATS[ending], random_splats()
    reach = min(row.max_coordinate, 1e30)
    far = replace(splats, positions=np.where(np.arange(len(splats))[:, None] == 0, reach, splats.positions))
    assert row.decode(encoded(row, far), "it").positions.max() == pytest.approx(reach)
    if np.isfinite(row.max_coordinate):
        with pytest.raises(HyrfDataError, match="units from the origin"):
            encoded(row, replace(far, positions=far.positions * 1.01))
    large = replace(splats, scales=splats.scales * np.float32(1e6))
    largest = min(row.max_scale, large.scales.max())
    assert row.decode(encoded(row, large), "it").scales.max() == pytest.approx(largest, rel=1e-5)


def test_every_ending_has_one_row_and_no_name_could_be_two():
    assert [row.ending for row in FORMATS.values()] == list(FORMATS)
    for ending in FORMATS:
        assert [other for other in FORMATS if f"scene{ending}".endswith(other)] == [ending]


def endings_in(page: str, start: str, stop: str) -> set[str]:
    """Endings that the first cells of a table of docs name."""
    text = (Path(__file__).parents[2] / "docs" / "how-to" / page).read_text(encoding="utf-8")
    rows = text[text.index(start) :].partition(stop)[0]
    return {ending for line in rows.splitlines() for ending in re.findall(r"`(\.[\w.]+)`", line.split("|")[1])}


def test_the_docs_list_what_is_in_the_table():
    from hyrfpack.export.kinds import ENDINGS

    assert endings_in("export.md", "| ending |", "\n\n") == set(ENDINGS) > set(FORMATS)
    assert endings_in("import.md", "| read |", "\n\n") == {row.ending for row in FORMATS.values() if row.is_readable}


def test_the_table_imports_no_package_that_only_a_format_wants():
    code = "import sys, hyrfpack.splats.table; print(*sorted({'pxr', 'trimesh', 'pycolmap'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
