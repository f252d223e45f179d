"""Pages use the minified player while it was made from the current sources, and otherwise the plain modules."""

from __future__ import annotations

import logging
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from web.pages import (
    Browser,
    make_camera,
    make_splats_page,
    open_page,
    psnr,
    random_splats,
    rasterize_reference,
    render_in_page,
)

from hyrfpack.web import modules, player, scripts
from hyrfpack.web.assets import list_web_files, read_web_file
from hyrfpack.web.html import decode_splats_page
from hyrfpack.web.player import encode_player
from hyrfpack.web.scripts import DIGEST_NAME, SCRIPT_NAMES, is_minified_current, read_script, source_digest
from tools.browser.build_player import build_player
from tools.browser.node_programs import PROGRAMS_FOLDER

CACHED_FUNCTIONS = (scripts.read_script, scripts.read_style, scripts.is_minified_current, player._pack_scripts)
MAX_LINE_LENGTH = 120


@pytest.fixture
def replaced_files(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str | None]]:
    """Replace web files by texts that the test sets, by path; None is for a file that is missing."""
    replaced: dict[str, str | None] = {}

    def read(path: str) -> str:
        text = replaced[path] if path in replaced else read_web_file(path)
        if text is None:
            raise FileNotFoundError(path)
        return text

    for module in (scripts, modules):
        monkeypatch.setattr(module, "read_web_file", read)
    for function in CACHED_FUNCTIONS:
        function.cache_clear()
    yield replaced
    for function in CACHED_FUNCTIONS:
        function.cache_clear()


@pytest.mark.unit
def test_the_minified_player_was_made_from_the_current_sources():
    assert is_minified_current(), "a script or the style has changed: run 'make player'"
    assert all(read_script(name) == read_web_file(f"minified/{name}") for name in SCRIPT_NAMES)


@pytest.mark.acceptance
def test_make_player_gives_the_same_bytes_again():
    if not (PROGRAMS_FOLDER / "esbuild").exists():
        pytest.skip("esbuild is not here; run `npm ci` in tests/node")
    files = {
        name: read_web_file(f"minified/{name}").encode()
        for name in (*SCRIPT_NAMES, "style.css", "edit.css", DIGEST_NAME)
    }
    assert build_player() == files


@pytest.mark.unit
@pytest.mark.parametrize("path", ["viewer/player.js", "viewer/formats/zip.js", "hyrf/rans.js", "viewer/style.css"])
def test_the_digest_of_the_sources_depends_on_every_script_and_the_style(path, replaced_files):
    before = source_digest()
    replaced_files[path] = read_web_file(path) + "\n"
    assert source_digest() != before


@pytest.mark.unit
@pytest.mark.parametrize(
    ("digest", "reason"), [("0" * 64, "was made from other sources"), (None, "there is no minified one")]
)
def test_a_stale_or_missing_minified_player_is_not_used_and_reported_once(digest, reason, replaced_files, caplog):
    replaced_files[f"minified/{DIGEST_NAME}"] = digest
    page = encode_player("a")
    assert page == encode_player("a") and len(page) > 100_000
    assert "function handle" in read_script("main.js") or "class Player" in read_script("main.js")
    (message,) = [record.getMessage() for record in caplog.records if record.levelno >= logging.INFO]
    assert reason in message and "make player" in message


@pytest.mark.unit
@pytest.mark.parametrize("digest", [None, "current"])
@pytest.mark.parametrize("name", SCRIPT_NAMES)
def test_scripts_are_strict_and_add_no_global_names(name, digest, replaced_files):
    if digest is None:
        replaced_files[f"minified/{DIGEST_NAME}"] = None
    assert re.match(r'"use strict";\s*\(\(\) ?=> ?\{', read_script(name))
    assert read_script(name).rstrip().rstrip(";").endswith("})()")


@pytest.mark.unit
@pytest.mark.parametrize("end", ["</script>", "</SCRIPT >", "<!--"])
def test_text_that_would_end_the_script_element_is_refused(end, replaced_files):
    replaced_files["minified/main.js"] = f'const a = "{end}";\n'
    with pytest.raises(ValueError, match="would end the page's script element"):
        read_script("main.js")


@pytest.mark.parametrize("name", SCRIPT_NAMES)
def test_plain_scripts_of_the_player_are_valid(name, replaced_files, tmp_path):
    if shutil.which("node") is None:
        pytest.skip("there is no node here")
    replaced_files[f"minified/{DIGEST_NAME}"] = None
    script = tmp_path / "script.cjs"
    script.write_text(read_script(name))
    checked = subprocess.run(["node", "--check", script], capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0, checked.stderr


def test_a_page_of_plain_modules_opened_from_disk_draws_the_same_picture(
    browser: Browser, tmp_path: Path, replaced_files
):
    replaced_files[f"minified/{DIGEST_NAME}"] = None
    page = make_splats_page(random_splats())
    open_page(browser, tmp_path, page)
    picture = render_in_page(browser, make_camera())
    assert psnr(picture, rasterize_reference(decode_splats_page(page, "page")[0], make_camera())) > 45
    assert browser.list_errors() == []


def test_a_running_page_has_one_global_name(browser: Browser, tmp_path: Path):
    names = "Object.getOwnPropertyNames(window).filter((name) => !/^\\d+$/.test(name)).sort()"
    (tmp_path / "plain.html").write_text("<!DOCTYPE html>")
    browser.open((tmp_path / "plain.html").as_uri())
    plain = set(browser.evaluate(names))
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    browser.drag((120, 90), (140, 95))
    assert set(browser.evaluate(names)) - plain == {"hyrfpack"}


@pytest.mark.unit
def test_no_line_of_the_sources_is_longer_than_120_columns():
    long = [
        f"{path}:{number}"
        for path in list_web_files("viewer", ".js", ".css") + list_web_files("hyrf", ".js")
        for number, line in enumerate(read_web_file(path).splitlines(), 1)
        if len(line) > MAX_LINE_LENGTH
    ]
    assert long == []
