"""The scripts and the style sheet of the player: minified, or linked from the sources where those are newer."""

from __future__ import annotations

import hashlib
import logging
import re
from functools import cache

from hyrfpack.web.assets import list_web_files, read_web_file
from hyrfpack.web.modules import link_modules

_LOG = logging.getLogger(__name__)

SCRIPT_NAMES = (
    "boot.js",
    "element_script.js",
    "main.js",
    "main_editable.js",
    "main_hosted.js",
    "worker.js",
    "worker_model.js",
    "worker_splats.js",
)
STYLE_NAME, EDITING_STYLE_NAME = "style.css", "edit.css"
MINIFIED_FOLDER = "minified"
DIGEST_NAME = "sources.sha256"
SOURCE_FOLDERS = ("hyrf", "viewer")
_SCRIPT_ELEMENT_END = re.compile(r"</script|<!--", re.IGNORECASE)  # "<!--" changes where the element ends


@cache
def read_script(name: str) -> str:
    """Return one of SCRIPT_NAMES as a classic script that adds no global names.

    Raises:
        ValueError: the script holds text that would end its script element.
    """
    script = read_web_file(f"{MINIFIED_FOLDER}/{name}") if is_minified_current() else link_modules(f"viewer/{name}")
    if match := _SCRIPT_ELEMENT_END.search(script):
        raise ValueError(f"{name}: '{match[0]}' in a script would end the page's script element; write it otherwise")
    return script


@cache
def read_style(editable: bool = False) -> str:
    """Return the style sheet of the player's page, with that of its editing panel if it is `editable`."""
    folder = MINIFIED_FOLDER if is_minified_current() else "viewer"
    return "".join(read_web_file(f"{folder}/{name}") for name in (STYLE_NAME, EDITING_STYLE_NAME)[: 1 + editable])


@cache
def is_minified_current() -> bool:
    """Return whether the minified player was made from the current sources, and log once which of them pages use."""
    try:
        digest = read_web_file(f"{MINIFIED_FOLDER}/{DIGEST_NAME}").strip()
    except FileNotFoundError:
        digest = None
    if digest == source_digest():
        _LOG.debug("pages use the minified player, which was made from the current sources")
        return True
    reason = "there is no minified one" if digest is None else "the minified one was made from other sources"
    _LOG.info("pages use the player's plain modules and are larger, because %s; run 'make player'", reason)
    return False


def source_digest() -> str:
    """Return the SHA-256, in hexadecimal, of the paths and texts of the player's scripts and style sheet."""
    paths = [path for folder in SOURCE_FOLDERS for path in list_web_files(folder, ".js", ".css")]
    texts = (f"{path}\0{read_web_file(path)}\0" for path in paths)
    return hashlib.sha256("".join(texts).encode()).hexdigest()
