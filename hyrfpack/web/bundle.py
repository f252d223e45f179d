"""Bundling of JavaScript modules into one script, for pages that are a single file."""

from __future__ import annotations

import hashlib
import posixpath
import re
from functools import cache
from importlib.resources import files

_NAME_LIST = r"\{ [\w$]+(?:, [\w$]+)* \}"
_IMPORT_LINE = re.compile(rf'^import {_NAME_LIST} from "(\.{{1,2}}/[\w./-]+\.js)";$')
_EXPORT_LIST_LINE = re.compile(rf"^export {_NAME_LIST};$")
_EXPORT_KEYWORD = re.compile(r"^export (?=(?:async )?function|class|const|let)")
_TOP_LEVEL_NAME = re.compile(r"^(?:export )?(?:async )?(?:function\*?|class|const|let) ([\w$]+)", re.MULTILINE)
_BLOCK_COMMENT = re.compile(r"^[ \t]*/\*(?:(?!\*/).)*\*/[ \t]*$", re.DOTALL | re.MULTILINE)
_TRAILING_COMMENT = re.compile(r"\s+// [^\"'`]*$")
_SCRIPT_ELEMENT_END = re.compile(r"</script|<!--", re.IGNORECASE)  # "<!--" changes where the element ends


@cache
def bundle(entry: str) -> str:
    """Return a module below `hyrfpack/web` and all that it imports as one classic script, in order of dependency.

    Modules may use only these forms: `import { a, b } from "./x.js";` on one line, and `export` before a declaration or
    as `export { a, b };` on one line. No two modules may define the same top-level name. Comments and indentation are
    removed.

    Args:
        entry: path of the module, relative to `hyrfpack/web`.

    Raises:
        ValueError: a module uses another form, imports are circular, two modules define the same name, or the script
            holds text that would end its script element.
    """
    placed: dict[str, str | None] = {}  # stripped text by module path, None while the module's imports are placed
    owners: dict[str, str] = {}

    def place(path: str) -> None:
        """Place a module after those that it imports."""
        if path in placed:
            if placed[path] is None:
                raise ValueError(f"{path} is imported in a circle")
            return
        placed[path] = None
        text = read_web_file(path)
        for name in _TOP_LEVEL_NAME.findall(text):
            if name in owners:
                raise ValueError(f"'{name}' is defined in {owners[name]} and in {path}; give one another name")
            owners[name] = path
        needed, lines = [], []
        for line in strip_comments(text).splitlines():
            if match := _IMPORT_LINE.match(line):
                needed.append(posixpath.normpath(posixpath.join(posixpath.dirname(path), match[1])))
            elif _EXPORT_LIST_LINE.match(line):
                continue
            elif line.startswith(("import ", "import{", "export {", "export *", "export default")):
                raise ValueError(f"{path}: '{line}' is not understood")
            else:
                lines.append(_EXPORT_KEYWORD.sub("", line))
        for other in needed:
            place(other)
        del placed[path]  # so that the next line inserts it after the modules that it needs
        placed[path] = "\n".join(lines)

    place(entry)
    script = '"use strict";\n' + "\n".join(text for text in placed.values() if text)
    if match := _SCRIPT_ELEMENT_END.search(script):
        raise ValueError(f"{entry}: '{match[0]}' in a script would end the page's script element; write it otherwise")
    return script


def strip_comments(text: str) -> str:
    """Return JavaScript or GLSL without indentation, empty lines, and comments at the start or end of a line."""
    lines = (_TRAILING_COMMENT.sub("", line.strip()) for line in _BLOCK_COMMENT.sub("", text).splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//"))


def read_web_file(path: str) -> str:
    """Return the text of a file below `hyrfpack/web`."""
    return files("hyrfpack.web").joinpath(*path.split("/")).read_text("utf-8")


def script_digest(script: str) -> str:
    """Return the SHA-256 of a script in hexadecimal."""
    return hashlib.sha256(script.encode()).hexdigest()
