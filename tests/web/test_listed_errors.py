"""`Browser.list_errors`, on which other tests rely, returns the errors of a page."""

from __future__ import annotations

from pathlib import Path

from web.pages import Browser

PAGE_WITH_ERRORS = """<!doctype html><link rel="icon" href="data:,"><script>
console.error("an error of the page"); setTimeout(() => { throw new Error("thrown"); });
</script>"""


def test_listed_errors_contain_console_and_thrown_errors(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(PAGE_WITH_ERRORS)
    browser.open((tmp_path / "page.html").as_uri())
    errors = " ".join(browser.list_errors())
    assert "an error of the page" in errors and "thrown" in errors
