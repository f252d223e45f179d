"""Compare the splats that the player's readers return with those of Python's readers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from web.scripts import run_script

from hyrfpack.ops.harmonics import num_sh_bases
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.splats.splats import Splats

DECODE_SCRIPT = Path(__file__).parent / "decode.mjs"


@dataclass(frozen=True)
class PageSplats:
    """Splats as the page stores them: the `facts` that the script prints and the arrays that it writes."""

    facts: dict
    data: bytes

    def assert_equal(self, expected: Splats) -> None:
        """Assert that the page's splats equal those read by Python, up to float32, and to a byte for harmonics."""
        facts, count, terms = self.facts, len(expected), num_sh_bases(expected.degree)
        assert (facts["count"], facts["degree"]) == (count, expected.degree)
        assert facts["antialiased"] is expected.antialiased
        numbers = np.frombuffer(self.data, "<f4", 14 * count)
        packed = np.frombuffer(self.data, np.uint8, offset=56 * count).reshape(count, terms - 1, 3)
        positions, scales, quats, opacities, colors = np.split(numbers, np.cumsum([3, 3, 4, 1]) * count)
        unit, center = facts["unit"], np.array(facts["center"])
        wanted = (expected.positions - center) / unit
        np.testing.assert_allclose(positions.reshape(count, 3), wanted, rtol=2e-7, atol=1e-12)
        np.testing.assert_allclose(scales.reshape(count, 3) * np.float64(unit), expected.scales, rtol=1e-6)
        np.testing.assert_allclose(quats.reshape(count, 4), expected.quats, atol=1e-6)
        np.testing.assert_allclose(opacities, expected.opacities, rtol=1e-6, atol=1e-7)
        base = 0.5 + SH_C0 * expected.harmonics[:, 0].astype(np.float64)
        np.testing.assert_allclose(colors.reshape(count, 3), base, rtol=1e-6, atol=1e-6)
        most = facts["range"]
        found, inside = (packed.astype(np.float64) - 128) / 128 * most, np.clip(expected.harmonics[:, 1:], -most, most)
        np.testing.assert_allclose(found, inside, atol=most / 127)
        assert np.mean(np.abs(expected.harmonics[:, 1:]) > most * (1 + 1e-6)) <= 1e-3 if terms > 1 and count else True
        if count > 20:  # most splats lie within one unit of the centre
            assert np.quantile(np.abs(wanted).max(1), 0.8) <= 1


def read_in_node(folder: Path, files: Sequence[tuple[str, bytes]]) -> tuple[list[PageSplats | str], int]:
    """Read files (name, content) with the player's readers in node.

    Returns:
        The splats or the error message of each file, and the memory used in kilobytes.
    """
    paths = []
    for number, (name, data) in enumerate(files):
        (folder / "in" / str(number)).mkdir(parents=True)
        paths.append(folder / "in" / str(number) / name)
        paths[-1].write_bytes(data)
    (folder / "out").mkdir()
    answer = run_script(DECODE_SCRIPT, folder / "out", *paths)
    results: list[PageSplats | str] = []
    for number, facts in enumerate(answer["answers"]):
        if "error" in facts:
            assert facts["kind"] == "HyrfFormatError", facts["error"]
            assert "\n" not in facts["error"] and facts["error"].startswith("The file cannot be shown: ")
            results.append(facts["error"])
        else:
            results.append(PageSplats(facts, (folder / "out" / str(number)).read_bytes()))
    return results, answer["kilobytes"]
