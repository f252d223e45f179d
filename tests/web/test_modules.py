"""Linked modules run as one script in the order of their imports, and unsupported syntax is refused."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest

from hyrfpack.web import modules
from hyrfpack.web.assets import list_web_files, read_web_file
from hyrfpack.web.modules import link_modules


@pytest.fixture
def module_sources(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Replace the web files by sources that the test sets, by path."""
    sources: dict[str, str] = {}
    monkeypatch.setattr(modules, "read_web_file", sources.__getitem__)
    return sources


def run_in_node(script: str) -> str:
    """Run a script in node and return what it prints."""
    if shutil.which("node") is None:
        pytest.skip("there is no node here")
    return subprocess.run(["node", "-"], input=script, capture_output=True, text=True, check=True, timeout=60).stdout


def test_each_module_runs_once_after_its_imports(module_sources):
    module_sources["viewer/main.js"] = (
        'import { two } from "./two.js";\nimport { one } from "../hyrf/one.js";\nconsole.log("main", two(), one);\n'
    )
    module_sources["viewer/two.js"] = (
        'import { one } from "../hyrf/one.js";\nexport const two = () => one + 1;\nconsole.log("two");\n'
    )
    module_sources["hyrf/one.js"] = 'const one = 1;\nexport { one };\nconsole.log("one");\n'
    assert run_in_node(link_modules("viewer/main.js")) == "one\ntwo\nmain 2 1\n"


@pytest.mark.parametrize(
    "declaration",
    ["export function f(){}", "export async function f(){}", "export class f{}", "export let f=1, g;"],
)
def test_every_declaration_can_be_exported(declaration, module_sources):
    module_sources["a.js"] = 'import { f } from "./b.js";\nconsole.log(f !== undefined);\n'
    module_sources["b.js"] = f"{declaration}\n"
    assert run_in_node(link_modules("a.js")) == "true\n"


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
        link_modules("a.js")


def test_circular_imports_are_refused(module_sources):
    module_sources["a.js"] = 'import { b } from "./b.js";\nexport const a = 1;\n'
    module_sources["b.js"] = 'import { a } from "./a.js";\nexport const b = 1;\n'
    with pytest.raises(ValueError, match=r"^a\.js is imported in a circle$"):
        link_modules("a.js")


@pytest.mark.parametrize(
    "second", ["function same() {}", "export async function* same() {}", "class same {}", "export let same = 2;"]
)
def test_two_modules_may_define_the_same_name(second, module_sources):
    module_sources["a.js"] = f'import {{ b }} from "./b.js";\n{second}\nconsole.log(b, typeof same);\n'
    module_sources["b.js"] = 'const same = "of b";\nexport const b = same;\n'
    assert run_in_node(link_modules("a.js")).startswith("of b ")


def test_a_linked_script_prints_the_same_as_its_module(module_sources):
    module_sources["a.js"] = """\
// a comment, "quoted"
const text = "a  b" + 'c  d', raw = String.raw`e  ${ text }
  // f`; /* a block */
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
    expected = "a  bc  d e  a  bc  d\n  // f y 3 5 1 -1 1\n"
    assert run_in_node(link_modules("a.js")) == run_in_node(module_sources["a.js"]) == expected


ARITHMETIC_PATTERN_BY_OWNER = {
    "hyrf/vectors.js": r"\[1\] \* \w+\[2\]",  # a cross product
    "hyrf/plain.js": r"2 \*\* -24|0x7c00",  # the smallest half, or the exponent's bits
    "hyrf/basis.js": r"1\.09254843|0\.54627421|0\.28209479",
    "hyrf/rotation.js": r"1 - 2 \* \(y \* y \+ z \* z\)",
}


@pytest.mark.unit
@pytest.mark.parametrize("owner", ARITHMETIC_PATTERN_BY_OWNER)
def test_vectors_halves_harmonics_and_rotations_are_calculated_in_one_module_each(owner):
    paths = list_web_files("viewer", ".js") + list_web_files("hyrf", ".js")
    owners = [path for path in paths if re.search(ARITHMETIC_PATTERN_BY_OWNER[owner], read_web_file(path))]
    assert owners == [owner]
