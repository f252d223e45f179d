"""The Python of the documentation runs as written; `tools/safety/run_docs.py` does it with all training steps."""

from __future__ import annotations

import pytest

from tools.safety.run_docs import PAGES, python_of, run


def test_the_python_of_a_page_is_its_blocks_each_line_where_it_stands():
    fenced = "Words\n\n```python\nimport hyrfpack\n\nx = 1\n```\n"
    indented = "\n    hyrfpack train a -o b\n\nMore words:\n\n    import hyrfpack\n    y = 2\n\nEnd\n"
    lines = python_of(fenced + indented).split("\n")
    assert {number: line for number, line in enumerate(lines, start=1) if line} == {
        4: "import hyrfpack",
        6: "x = 1",
        13: "import hyrfpack",
        14: "y = 2",
    }


@pytest.mark.slow
def test_every_page_runs_as_written(tmp_path, data, capfd):
    assert all(run(page, data, 2) for page in PAGES), capfd.readouterr().err


def test_a_page_that_breaks_is_noticed(tmp_path, data):
    page = tmp_path / "page.md"
    page.write_text("```python\nimport hyrfpack\nhyrfpack.load('missing.hyrf')\n```\n")
    assert not run(page, data, None)
    page.write_text("No Python.\n")
    assert not run(page, data, None)
