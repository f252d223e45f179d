"""The package hyrf-viewer works in bundlers, in React, in plain modules and in strict TypeScript, without settings."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from web.pages import Browser, wait_until
from web.site import GOLDEN_FILE_DATA, Site

from hyrfpack.web.assets import read_web_file
from hyrfpack.web.scripts import is_minified_current
from tools.browser.build_package import PACKAGE_FOLDER, build_package
from tools.browser.node_programs import PROGRAMS_FOLDER

pytestmark = pytest.mark.acceptance
TESTS_FOLDER = Path(__file__).parents[1]
EXAMPLE_FOLDER = TESTS_FOLDER.parent / "examples" / "viewer"
BUNDLERS_FOLDER = TESTS_FOLDER / "bundlers" / "node_modules"
STATUS_JS = "document.getElementById('status')?.textContent.endsWith(' Gaussians')"
ESBUILD_OPTIONS = ("--bundle", "--jsx=automatic", "--format=esm", "--outfile=dist/main.js")
WEBGPU_PAGE = """<!DOCTYPE html><link rel="icon" href="data:,"><div id="scene" style="height: 90px"></div>
<script type="module">
import { createViewer } from "./hyrf-viewer/index.js";
import { webgpu } from "./hyrf-viewer/webgpu.js";
window.viewer = createViewer({ container: "#scene", src: "scene.hyrf", renderer: webgpu });
</script>
"""
BUNDLE_COMMANDS = {
    "vite": [["vite", "build", "--logLevel", "error"]],
    "webpack": [["webpack", "--output-path", "dist"]],
    "esbuild": [["esbuild", "main.jsx", *ESBUILD_OPTIONS]],
}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not (PROGRAMS_FOLDER / "esbuild").exists():
        pytest.skip("esbuild is not here; run `npm ci` in tests/node")
    assert is_minified_current(), "a script or the style has changed: run 'make player'"
    folder = tmp_path_factory.mktemp("package") / "hyrf-viewer"
    build_package(folder)
    return folder


@pytest.fixture
def project(package: Path, tmp_path: Path) -> Path:
    """Return a copy of the example with the packages that it needs."""
    if not BUNDLERS_FOLDER.exists():
        pytest.skip("the bundlers are not here; run `npm ci` in tests/bundlers")
    folder = shutil.copytree(EXAMPLE_FOLDER, tmp_path / "project")
    modules = folder / "node_modules"
    modules.mkdir()
    for path in BUNDLERS_FOLDER.iterdir():
        (modules / path.name).symlink_to(path)
    shutil.copytree(package, modules / "hyrf-viewer")
    return folder


def run_program(project: Path, name: str, *arguments: str) -> None:
    program = project / "node_modules" / ".bin" / name
    done = subprocess.run([program, *arguments], cwd=project, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("bundler", BUNDLE_COMMANDS)
def test_a_react_component_is_bundled_and_draws(one_browser: Browser, host: Site, project: Path, bundler: str):
    for command in BUNDLE_COMMANDS[bundler]:
        run_program(project, *command)
    host.files = {f"/{path.relative_to(project / 'dist')}": path.read_bytes() for path in project.glob("dist/**/*.*")}
    if bundler != "vite":  # which writes the page, too
        page = (project / "index.html").read_text()
        host.files["/index.html"] = page.replace("./main.jsx", "/main.js").encode()
    host.files["/scene.hyrf"] = GOLDEN_FILE_DATA
    one_browser.open(f"{host.address}/index.html")
    wait_until(one_browser, STATUS_JS, 30)
    assert one_browser.evaluate("document.querySelectorAll('canvas').length") == 1, "StrictMode left a viewer behind"
    one_browser.evaluate("document.querySelector('button').click()")
    wait_until(one_browser, "!document.querySelector('canvas')")
    one_browser.evaluate("document.querySelector('button').click()")
    wait_until(one_browser, "Boolean(document.querySelector('canvas'))")
    assert one_browser.list_errors() == []


@pytest.mark.in_turn
def test_a_plain_page_shows_two_viewers(browser: Browser, host: Site, package: Path):
    host.files = {f"/node_modules/hyrf-viewer/{path.name}": path.read_bytes() for path in package.iterdir()}
    host.files["/page.html"] = (EXAMPLE_FOLDER / "two-viewers.html").read_bytes()
    host.files["/scene.hyrf"] = GOLDEN_FILE_DATA
    browser.open(f"{host.address}/page.html")
    wait_until(browser, STATUS_JS, 30)
    assert browser.evaluate("document.getElementById('second').viewer") is None, "the second one is lazy"
    browser.evaluate("document.getElementById('next').click()")
    browser.evaluate("document.getElementById('second').scrollIntoView()")
    wait_until(browser, "document.getElementById('second').viewer?.isReady", 30)
    assert browser.list_errors() == []


def test_a_page_that_asks_for_webgpu_draws_where_there_is_none(one_browser: Browser, host: Site, package: Path):
    host.files = {f"/hyrf-viewer/{path.name}": path.read_bytes() for path in package.iterdir()}
    host.files["/page.html"] = WEBGPU_PAGE.encode()
    host.files["/scene.hyrf"] = GOLDEN_FILE_DATA
    one_browser.open(f"{host.address}/page.html")
    wait_until(one_browser, "window.viewer?.isReady", 30)
    assert one_browser.evaluate("viewer.player.renderer.isOnDevice") is False
    assert one_browser.list_errors() == []


def test_strict_typescript_compiles_against_the_types(project: Path):
    flags = "--noEmit --strict --exactOptionalPropertyTypes --noUncheckedIndexedAccess --module nodenext".split()
    run_program(project, "tsc", *flags, "--lib", "es2022,dom", "--types", "", "--ignoreConfig", "typed.ts")


@pytest.mark.parametrize("mistake", ["viewer.camera = true;", "viewer.on('redy', () => {});", "createViewer({});"])
def test_mistakes_are_type_errors(project: Path, mistake: str):
    (project / "wrong.ts").write_text(f"{(project / 'typed.ts').read_text()}\n{mistake}\n")
    with pytest.raises(AssertionError, match=r"wrong\.ts\(\d+"):
        run_program(
            project, "tsc", *"--noEmit --strict --module nodenext --lib es2022,dom --ignoreConfig wrong.ts".split()
        )


def test_the_package_is_imported_by_a_server_without_a_browser(package: Path):
    script = (
        f"await import('{package}/index.js'); await import('{package}/element.js'); await import('{package}/webgpu.js')"
    )
    done = subprocess.run(["node", "--input-type=module", "-e", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_the_package_has_every_file_that_it_names(package: Path):
    packed = subprocess.run(
        ["npm", "pack", "--dry-run", "--json"], cwd=package, capture_output=True, text=True, timeout=60
    )
    assert packed.returncode == 0, packed.stderr
    modules = ["index.js", "element.js", "webgpu.js", "worker.js"]
    for name in [*modules, "index.d.ts", "element.d.ts", "webgpu.d.ts", "LICENSE", "README.md"]:
        assert f'"{name}"' in packed.stdout
    assert (package / "worker.js").read_text() == read_web_file("minified/worker.js")
    assert "EMBEDDED_TEXTS=" not in (package / "index.js").read_text()
    assert (PACKAGE_FOLDER / "package.json").read_text() == (package / "package.json").read_text()
