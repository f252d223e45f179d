"""Linking of JavaScript modules into one script without node, for source trees whose minified player is not current."""

from __future__ import annotations

import posixpath
import re

from hyrfpack.web.assets import read_web_file

_NAME_LIST = r"\{ ([\w$]+(?:, [\w$]+)*) \}"
_IMPORT_LINE = re.compile(rf'^import {_NAME_LIST} from "(\.{{1,2}}/[\w./-]+\.js)";$', re.MULTILINE)
_EXPORT_LIST_LINE = re.compile(rf"^export {_NAME_LIST};$", re.MULTILINE)
_EXPORT_KEYWORD = re.compile(r"^export (?=(?:async )?function|class|const|let)", re.MULTILINE)
_OTHER_LINE = re.compile(r"^(?:import|export)\b.*", re.MULTILINE)


def link_modules(entry: str) -> str:
    """Return a module below `hyrfpack/web` and all that it imports as one classic script.

    Each module becomes a function of its own, called once after the modules that it imports, which returns what others
    import from it. Modules may use only these forms: `import { a, b } from "./x.js";` on one line, and `export` before
    a declaration or as `export { a, b };` on one line. Exported variables must not change after their module has run.

    Args:
        entry: path of the module, relative to `hyrfpack/web`.

    Raises:
        ValueError: a module uses another form, or imports are circular.
    """
    bodies: dict[str, str | None] = {}  # by path in the order of execution; None while a module's imports are placed
    imported: dict[str, set[str]] = {entry: set()}  # names that other modules import, by path

    def place(path: str) -> None:
        """Place a module after those that it imports."""
        if path in bodies:
            if bodies[path] is None:
                raise ValueError(f"{path} is imported in a circle")
            return
        bodies[path] = None

        def link_import(match: re.Match[str]) -> str:
            other = posixpath.normpath(posixpath.join(posixpath.dirname(path), match[2]))
            imported.setdefault(other, set()).update(match[1].split(", "))
            place(other)
            return f'const {{ {match[1]} }} = modules["{other}"];'

        body = _IMPORT_LINE.sub(link_import, read_web_file(path))
        body = _EXPORT_KEYWORD.sub("", _EXPORT_LIST_LINE.sub("", body))
        if match := _OTHER_LINE.search(body):
            raise ValueError(f"{path}: '{match[0]}' is not understood")
        del bodies[path]  # so that the next line inserts it after the modules that it needs
        bodies[path] = body

    place(entry)
    functions = [
        f'modules["{path}"] = (() => {{\n{body}\nreturn {{ {", ".join(sorted(imported[path]))} }};\n}})();'
        for path, body in bodies.items()
    ]
    return "\n".join(['"use strict";', "(() => {", "const modules = {};", *functions, "})();"])
