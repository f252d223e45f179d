"""What other tests rely on when they say that a page has nothing to complain of."""

from __future__ import annotations

from pathlib import Path

from web.pages import Browser

PAGE = """<!doctype html><link rel="icon" href="data:,"><script>
console.error("an error of the page"); setTimeout(() => { throw new Error("thrown"); });
</script>"""


def test_errors_of_a_page_are_told(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(PAGE)
    browser.open((tmp_path / "page.html").as_uri())
    said = " ".join(browser.list_errors())
    assert "an error of the page" in said and "thrown" in said
