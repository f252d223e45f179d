"""The page of the player without a scene: its parts, its content security policy, and the files hosted beside it."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from functools import cache

from hyrfpack.splats.names import SPLATS_SUFFIXES
from hyrfpack.version import __version__
from hyrfpack.web.assets import list_web_files, read_web_file
from hyrfpack.web.scripts import read_script, read_style

MODEL_SUFFIX = ".hyrf"
BACK_LINK = '<a id="back" href="{}" aria-label="All scenes" title="All scenes">&#8249;</a>\n'
EDITING_ELEMENTS = ("overlay", "panel", "button", "help")  # files in viewer/edit, which an editable page includes
SHADER_SUFFIXES = (".vert", ".frag", ".glsl")
_SHADER_COMMENT = re.compile(r"\s*//.*")
# The browser decodes one base64 block while it loads the next one. A multiple of 3 needs no padding.
PAYLOAD_BLOCK_BYTES = 3 << 20
STYLE_FILE_NAME, SCRIPT_FILE_NAME, WORKER_FILE_NAME = "player.css", "player.js", "player-worker.js"
GZIP_WINDOW_BITS = 31  # zlib's value for the largest window with a gzip header, which holds no time and no name
# Content security policy sources of a player whose address may name a file on any server.
ANY_SOURCE = "'self' https: http:"


def encode_player(
    title: str,
    *,
    content: str | None = None,
    poster: str | None = None,
    description: str = "A player of 3D scenes",
    fetches: str = ANY_SOURCE,
    views: Mapping[str, dict] | None = None,
    updates: str | None = None,
    gallery: str | None = None,
    in_folder: bool = False,
    credit: str = "",
    editable: bool = False,
    file: str | None = None,
) -> bytes:
    """Return a page that plays a hosted file, a file that its address names (`?content=URL`), or a dropped file.

    Args:
        title: title of the page.
        content: address, relative to the page, of the file that it plays if its own address names none; None for no
            such file.
        poster: address, relative to the page, of the picture that is shown while that file loads; None for none.
        description: description for those who share the page.
        fetches: sources that the page may fetch from, in the syntax of a content security policy.
        views: initial cameras for files, by the file's address relative to the page; see `html.encode_views`.
        updates: address of a JSON file that says which snapshot of a training `content` is: {"snapshot": number from 1,
            0 while there is none, "step", "steps", "kind" of the run (see `Trainer`)}. The page requests it repeatedly
            and shows newer snapshots from the viewer's current viewpoint; an `editable` page shows only the first one.
            None for a file that does not change.
        gallery: address, relative to the page, of the list of scenes that a button leads back to; None for no button.
        in_folder: use the scripts and the style of `encode_player_files`, which must be beside the page, so that the
            page runs on servers whose content security policy is `default-src 'self'`.
        credit: text below the title, such as the author and the licence.
        editable: include the panel that edits a scene; with `in_folder`, use `encode_player_files(editable=True)`.
        file: name or path of the file in the commands of that panel; None for that of `content`.

    Returns:
        The file, UTF-8. The same arguments give the same bytes.
    """
    settings: dict = {"content": content, "title": escape_surrogates(title), "views": views or {}}
    if file is not None:
        settings["file"] = file
    if updates is not None:
        settings["updates"] = updates
    texts = [json_element("content", settings)] if content is not None or views else []
    if poster is not None:
        texts.append(f'<img id="poster" alt="" src="{html.escape(poster)}">')
    assemble = _assemble_page_in_folder if in_folder else assemble_player_page
    return assemble(
        title,
        texts,
        description,
        image=poster,
        fetches=fetches,
        gallery=gallery,
        credit=credit,
        editable=editable,
    )


def encode_player_files(editable: bool = False) -> dict[str, bytes]:
    """Return, by name, the files beside a page of `encode_player` with `in_folder` and the same `editable`."""
    return {
        STYLE_FILE_NAME: read_style(editable).encode(),
        SCRIPT_FILE_NAME: _script_with_texts(_main_script(editable, is_hosted=True), embedded_texts()),
        WORKER_FILE_NAME: read_script("worker.js").encode(),
    }


def assemble_player_page(
    title: str,
    texts: list[str],
    description: str,
    *,
    payload: bytes = b"",
    image: str | None = None,
    fetches: str = "",
    readers: bool = True,
    gallery: str | None = None,
    credit: str = "",
    editable: bool = False,
) -> bytes:
    """Return the player's page around the elements of a scene, as UTF-8.

    Args:
        title: title of the page.
        texts: elements that the scripts find by their names, see `text_element` and `json_element`.
        description: description for those who share the page.
        payload: a file that the page holds, empty for none.
        image: address of a picture for those who share the page; None for none.
        fetches: sources that the page may fetch from, in the syntax of a content security policy.
        readers: include the readers of splats, which make the page a third larger; pages with `fetches` need them.
        gallery: address of the list of scenes that a button leads back to; None for no button.
        credit: text below the title.
        editable: include the panel that edits a scene.
    """
    style, script = read_style(editable), read_script("boot.js")
    is_hosted = bool(fetches)
    worker = "worker.js" if is_hosted else "worker_splats.js" if readers else "worker_model.js"
    main, packed = _pack_scripts(_main_script(editable, is_hosted), worker)
    view = memoryview(payload)
    blocks = (
        base64.b64encode(view[at : at + PAYLOAD_BLOCK_BYTES]).decode()
        for at in range(0, len(view), PAYLOAD_BLOCK_BYTES)
    )
    values = {
        "policy": content_security_policy(hash_source(style), [hash_source(text) for text in (script, main)], fetches),
        "style": f"<style>{style}</style>",
        "texts": "\n".join([*texts, text_element("player", packed)]),
        "script": f"<script>{script}</script>",
        "payload": "\n".join(f'<script type="text/plain" class="payload">{block}</script>' for block in blocks),
    }
    return _fill_page(title, description, image, gallery, credit, values, readers=readers, editable=editable)


def _assemble_page_in_folder(
    title: str,
    texts: list[str],
    description: str,
    *,
    image: str | None,
    fetches: str,
    gallery: str | None,
    credit: str,
    editable: bool,
) -> bytes:
    """Return the player's page around the files of `encode_player_files`; arguments as for `assemble_player_page`."""
    values = {
        "policy": content_security_policy("'self'", ["'self'"], fetches, workers="'self'"),
        "style": f'<link rel="stylesheet" href="{STYLE_FILE_NAME}">',
        "texts": "\n".join(texts),
        "script": f'<script src="{SCRIPT_FILE_NAME}"></script>',
        "payload": "",
    }
    return _fill_page(title, description, image, gallery, credit, values, editable=editable)


def _fill_page(
    title: str,
    description: str,
    image: str | None,
    gallery: str | None,
    credit: str,
    values: dict[str, str],
    *,
    readers: bool = True,
    editable: bool,
) -> bytes:
    """Return the player's page from values of its template; other arguments as for `assemble_player_page`."""
    values = (
        values
        | {
            "version": __version__,
            "title": html.escape(title),
            "meta": meta_tags(title, description, image),
            "accept": ",".join([MODEL_SUFFIX, *SPLATS_SUFFIXES] if readers else [MODEL_SUFFIX]),
            "credit": html.escape(credit),
            "back": "" if gallery is None else BACK_LINK.format(html.escape(gallery)),
        }
        | {f"edit_{name}": read_web_file(f"viewer/edit/{name}.html") if editable else "" for name in EDITING_ELEMENTS}
    )
    return fill_template(read_web_file("viewer/page.html"), values)


def content_security_policy(
    style: str, scripts: Sequence[str] = (), fetches: str = "", *, workers: str = "blob:"
) -> str:
    """Return a content security policy that allows only the page's own scripts, and fetches only from `fetches`.

    Args:
        style: source of the page's style, such as `hash_source` of its style element.
        scripts: sources of its scripts.
        fetches: further sources of files and pictures, in addition to the page itself.
        workers: sources of workers.
    """
    allowed = {"default-src": "'none'", "style-src": style, "img-src": f"{fetches} data: blob:".strip()}
    if scripts:
        allowed |= {"script-src": " ".join(scripts), "worker-src": workers}
        allowed |= {"connect-src": fetches} if fetches else {}
    allowed |= {"base-uri": "'none'", "form-action": "'none'"}
    return "; ".join(f"{directive} {sources}" for directive, sources in allowed.items())


def meta_tags(title: str, description: str, image: str | None = None) -> str:
    """Return the meta elements of a page, from which programs make a preview of its address.

    Args:
        title, description: plain text.
        image: address of a picture, relative to the page; None for none.
    """
    facts = {"og:type": "website", "og:title": title, "og:description": description, "og:image": image}
    tags = [f'<meta property="{name}" content="{html.escape(text)}">' for name, text in facts.items() if text]
    return "\n".join([*tags, f'<meta name="description" content="{html.escape(description)}">'])


def encode_element_script() -> bytes:
    """Return the script that defines <hyrf-viewer> for pages of other authors and adds no global names to them."""
    return _script_with_texts("element_script.js", embedded_texts("worker.js"))


def _script_with_texts(name: str, texts: dict[str, str]) -> bytes:
    """Return one of the scripts, with the texts that it reads by their names in front."""
    constant = f"const EMBEDDED_TEXTS={json.dumps(texts, ensure_ascii=False)};"
    return f'(() => {{"use strict";{constant}\n{read_script(name)}}})();\n'.encode()


def encode_readme(title: str, entry: str, index: str, *, element: str | None = None) -> bytes:
    """Return the README of a folder of static files, which says how to host and embed them.

    Args:
        title: title of the scene or the gallery.
        entry: name of the player's page.
        index: name of the page that is opened first.
        element: name of a file that <hyrf-viewer> can show; None if its script is not in the folder.
    """
    lines = ""
    if element:
        lines = (
            f'  <script src="hyrf-viewer.js"></script> <hyrf-viewer src="{element}"></hyrf-viewer>\n'
            "  (keep hyrf-viewer.js and player-worker.js together)\n"
        )
    values = {"title": title, "version": __version__, "entry": entry, "index": index, "element": lines}
    return fill_template(read_web_file("hosted/README.txt"), values)


def fill_template(template: str, values: dict[str, str]) -> bytes:
    """Return a template with each {{name}} replaced by its value, as UTF-8 without surrogates."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template).encode("utf-8", "backslashreplace")


def escape_surrogates(text: str) -> str:
    """Replace surrogates, which stand for bytes of a file name that are not valid UTF-8, by escapes ("\\udcff")."""
    return text.encode("utf-8", "backslashreplace").decode()


def _main_script(editable: bool, is_hosted: bool) -> str:
    """Return the name of the page's main script. Those of pages that fetch files also play scene folders."""
    return "main_editable.js" if editable else "main_hosted.js" if is_hosted else "main.js"


@cache
def _pack_scripts(main: str, worker: str) -> tuple[str, str]:
    """Return the player's script, and all scripts and shaders in the form that `boot.js` unpacks.

    That form is base64 of gzipped JSON.

    Args:
        main: name of the player's script.
        worker: name of the script of the worker.
    """
    texts = embedded_texts(worker) | {"main.js": read_script(main)}
    packer = zlib.compressobj(9, zlib.DEFLATED, GZIP_WINDOW_BITS, 9)
    packed = packer.compress(json.dumps(texts).encode()) + packer.flush()
    return texts["main.js"], base64.b64encode(packed).decode()


def embedded_texts(worker: str | None = None) -> dict[str, str]:
    """Return the texts that the player's scripts read by their names: the shaders, and the worker's script "worker.js".

    Args:
        worker: name of the script of the worker; None to leave it out.
    """
    paths = list_web_files("viewer", *SHADER_SUFFIXES)
    shaders = {path.removeprefix("viewer/"): strip_shader_comments(read_web_file(path)) for path in paths}
    return shaders | ({} if worker is None else {"worker.js": read_script(worker)})


def webgpu_texts() -> dict[str, str]:
    """Return the shaders of the renderer for WebGPU by their names."""
    paths = list_web_files("viewer/webgpu", ".wgsl")
    return {path.rpartition("/")[2]: strip_shader_comments(read_web_file(path)) for path in paths}


def strip_shader_comments(text: str) -> str:
    """Return GLSL or WGSL without indentation, empty lines and comments, all of which begin with "//"."""
    lines = (_SHADER_COMMENT.sub("", line.strip()) for line in text.splitlines())
    return "\n".join(line for line in lines if line)


def hash_source(text: str) -> str:
    """Return the hash source by which a content security policy allows an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def text_element(name: str, text: str) -> str:
    """Return an element with a text that scripts find by its name; the text must not contain "</script"."""
    return f'<script type="text/plain" id="{name}">{text}</script>'


def json_element(name: str, value: dict) -> str:
    """Return an element with JSON that scripts find by its name; each "<" is escaped, since it may come from files."""
    return text_element(name, json.dumps(value).replace("<", "\\u003c"))
