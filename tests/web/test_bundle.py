"""The bundler joins modules to one script in the order of their imports and refuses unsupported syntax."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from importlib.resources import files

import pytest

from hyrfpack.web import bundle as bundling
from hyrfpack.web.bundle import bundle, strip_comments


@pytest.fixture
def module_sources(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Replace the web files by sources that the test sets, by path."""
    sources: dict[str, str] = {}
    monkeypatch.setattr(bundling, "read_web_file", sources.__getitem__)
    bundle.cache_clear()
    yield sources
    bundle.cache_clear()


def run_in_node(script: str) -> str:
    """Run a script in node and return what it prints."""
    if shutil.which("node") is None:
        pytest.skip("there is no node here")
    return subprocess.run(["node", "-"], input=script, capture_output=True, text=True, check=True, timeout=60).stdout


def test_each_module_appears_once_after_its_imports(module_sources):
    module_sources["viewer/main.js"] = (
        'import { two } from "./two.js";\nimport { one } from "../hyrf/one.js";\nconsole.log(two(), one);\n'
    )
    module_sources["viewer/two.js"] = 'import { one } from "../hyrf/one.js";\nexport const two = () => one + 1;\n'
    module_sources["hyrf/one.js"] = "const one = 1;\nexport { one };\n"
    script = bundle("viewer/main.js")
    assert script.splitlines() == [
        '"use strict";',
        "const one = 1;",
        "const two = () => one + 1;",
        "console.log(two(), one);",
    ]
    assert run_in_node(script) == "2 1\n"


@pytest.mark.parametrize(
    "declaration", ["export function f(){}", "export async function f(){}", "export class F{}", "export let f=1;"]
)
def test_export_keywords_are_removed_from_declarations(declaration, module_sources):
    module_sources["a.js"] = declaration
    assert bundle("a.js").splitlines()[1] == declaration.removeprefix("export ")


@pytest.mark.parametrize(
    "line",
    [
        'import one from "./b.js";',
        'import * as b from "./b.js";',
        'import { one as other } from "./b.js";',
        'import { one } from "three";',
        'import "./b.js";',
        "import { one,",
        "export default 1;",
        'export * from "./b.js";',
        'export { one } from "./b.js";',
    ],
)
def test_unsupported_syntax_is_refused_and_quoted(line, module_sources):
    module_sources.update({"a.js": f"{line}\n", "b.js": "export const one = 1;\n"})
    with pytest.raises(ValueError, match=r"^a\.js: '.*' is not understood$"):
        bundle("a.js")


def test_circular_imports_are_refused(module_sources):
    module_sources["a.js"] = 'import { b } from "./b.js";\nexport const a = 1;\n'
    module_sources["b.js"] = 'import { a } from "./a.js";\nexport const b = 1;\n'
    with pytest.raises(ValueError, match=r"^a\.js is imported in a circle$"):
        bundle("a.js")


@pytest.mark.parametrize(
    "second", ["function same() {}", "export async function* same() {}", "class same {}", "export let same = 2;"]
)
def test_a_top_level_name_in_two_modules_is_refused(second, module_sources):
    module_sources["a.js"] = f'import {{ b }} from "./b.js";\n{second}\n'
    module_sources["b.js"] = "export const b = 1;\nconst same = 1;\n"
    with pytest.raises(ValueError, match=r"^'same' is defined in a\.js and in b\.js"):
        bundle("a.js")


def test_equal_names_inside_functions_are_allowed(module_sources):
    module_sources["a.js"] = 'import { b } from "./b.js";\nfunction f() {\n  const same = 1;\n}\n'
    module_sources["b.js"] = "export const b = 1;\nconst same = 1;\n"
    assert bundle("a.js").count("const same = 1;") == 2


@pytest.mark.parametrize("end", ["</script>", "</SCRIPT >", "<!--"])
def test_text_that_would_end_the_script_element_is_refused(end, module_sources):
    module_sources["a.js"] = f'const a = "{end}";\n'
    with pytest.raises(ValueError, match="would end the page's script element"):
        bundle("a.js")


def test_a_bundled_script_prints_the_same_as_its_modules(module_sources):
    module_sources["a.js"] = """\
const text = "a  b" + 'c  d', raw = String.raw`e  ${ text } f`;
const found = "x  y / z".match(/[/"'] {2}|x  (y) /)[1], half = 9 / 3 / 1;
let n = 1;
const sum = n + +n - -n + ++n, less = n - --n;
const f = (a) => {
  return typeof a in { number: 1 } ? - a : a
};
class A {
  static b = 1;
  get c() { return this.constructor.b }
}
if (n) n = f(n)
else n = 0;
console.log(text, raw, found, half, sum, less, n, new A().c);
"""
    script = bundle("a.js")
    assert run_in_node(script) == run_in_node(module_sources["a.js"]) == "a  bc  d e  a  bc  d f y 3 5 1 -1 1\n"


def test_comments_and_indentation_are_removed_and_code_stays():
    text = """\
// first
/** A block
 * of lines. */
/** @type {number} */ const a = 1; /* b */
  const c = "// no comment"; // one
const d = `
  x`; // with a "quote" stays
/* last */
"""
    expected = [
        "/** @type {number} */ const a = 1; /* b */",
        'const c = "// no comment";',
        "const d = `",
        'x`; // with a "quote" stays',
    ]
    assert strip_comments(text).splitlines() == expected


@pytest.mark.parametrize("entry", ["viewer/main.js", "viewer/worker.js", "viewer/element.js"])
def test_the_bundled_scripts_of_the_player_are_valid_scripts(entry, tmp_path):
    if not files("hyrfpack.web").joinpath(entry).is_file():
        pytest.skip(f"there is no {entry}")
    if shutil.which("node") is None:
        pytest.skip("there is no node here")
    script = tmp_path / "script.cjs"
    script.write_text(bundle(entry))
    checked = subprocess.run(["node", "--check", script], capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0, checked.stderr
