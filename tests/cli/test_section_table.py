from __future__ import annotations

from hyrfpack.cli.section_table import format_section_table
from hyrfpack.format.info import SectionSize

LOSS_SHARES = {"POSI": 0.25, "pruned": 0.75}


def test_the_loss_is_listed_by_section_and_for_gaussians_left_out() -> None:
    table = format_section_table([SectionSize("POSI", "positions", 120, 60)], 100, 10, LOSS_SHARES)
    assert "of the loss" in table and "25.0%" in table
    assert "Gaussians left out" in table and "75.0%" in table


def test_parts_of_a_merged_file_have_no_share_of_the_loss() -> None:
    table = format_section_table([SectionSize("PT00", "part 1", 60, 60)], 100, 10, LOSS_SHARES)
    assert "of the loss" not in table and "Gaussians left out" not in table
