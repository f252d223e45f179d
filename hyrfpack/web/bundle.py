"""Modules of JavaScript as one script, for pages that are a single file."""

from __future__ import annotations

import hashlib
import posixpath
import re
from functools import cache
from importlib.resources import files

_NAMES = r"\{ [\w$]+(?:, [\w$]+)* \}"
_IMPORT = re.compile(rf'^import {_NAMES} from "(\.{{1,2}}/[\w./-]+\.js)";$')
_AGAIN = re.compile(rf"^export {_NAMES};$")
_EXPORT = re.compile(r"^export (?=(?:async )?function|class|const|let)")
_NAME = re.compile(r"^(?:export )?(?:async )?(?:function\*?|class|const|let) ([\w$]+)", re.MULTILINE)
_BLOCK = re.compile(r"^[ \t]*/\*(?:(?!\*/).)*\*/[ \t]*$", re.DOTALL | re.MULTILINE)
_TRAILING = re.compile(r"\s+// [^\"'`]*$")
_OUT = re.compile(r"</script|<!--", re.IGNORECASE)  # what ends a script element, or changes where it ends


@cache
def bundle(entry: str) -> str:
    """A module below `hyrfpack/web` and all that it imports as one classic script, those first that others need.

    Modules must keep to what this understands: `import { a, b } from "./x.js";` on a line, `export` before a
    declaration or as `export { a, b };` on a line, and names at the top level that no other module has. Comments and
    indentation are left out.

    Raises:
        ValueError: a module does not keep to it, modules import each other in a circle, or two have the same name, or
            what would end the script element that the script is put into.
    """
    placed: dict[str, str | None] = {}
    owners: dict[str, str] = {}

    def place(path: str) -> None:
        if path in placed:
            if placed[path] is None:
                raise ValueError(f"{path} is imported in a circle")
            return
        placed[path] = None
        text = part(path)
        for name in _NAME.findall(text):
            if name in owners:
                raise ValueError(f"'{name}' is defined in {owners[name]} and in {path}; give one another name")
            owners[name] = path
        needed, lines = [], []
        for line in bare_script(text).splitlines():
            if match := _IMPORT.match(line):
                needed.append(posixpath.normpath(posixpath.join(posixpath.dirname(path), match[1])))
            elif _AGAIN.match(line):
                continue
            elif line.startswith(("import ", "import{", "export {", "export *", "export default")):
                raise ValueError(f"{path}: '{line}' is not understood")
            else:
                lines.append(_EXPORT.sub("", line))
        for other in needed:
            place(other)
        del placed[path]  # to the end: after what it needs
        placed[path] = "\n".join(lines)

    place(entry)
    script = '"use strict";\n' + "\n".join(text for text in placed.values() if text)
    if match := _OUT.search(script):
        raise ValueError(f"{entry}: '{match[0]}' in a script would end the page's script element; write it otherwise")
    return script


def bare_script(text: str) -> str:
    """JavaScript or GLSL without comments that begin a line, those that end one, and indentation."""
    lines = (_TRAILING.sub("", line.strip()) for line in _BLOCK.sub("", text).splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//"))


def part(path: str) -> str:
    """The text of a file below `hyrfpack/web`."""
    return files("hyrfpack.web").joinpath(*path.split("/")).read_text("utf-8")


def digest(script: str) -> str:
    """What tells a script from every other one: SHA-256 in hexadecimal."""
    return hashlib.sha256(script.encode()).hexdigest()
