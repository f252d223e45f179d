"""The player's page, empty: what it is made of, what it may do, and what lies beside it in a folder to be hosted."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files

from hyrfpack.version import __version__
from hyrfpack.web.bundle import bare_script, bundle, digest, part

SCRIPTS = ("boot.js", "element.js", "main.js", "worker.js", "worker_model.js")
MODEL, SPLATS = ".hyrf", (".ply", ".spz", ".splat", ".sog")  # endings of what it plays
SHADERS = (".vert", ".frag", ".glsl")
BLOCK = 3 << 20  # bytes of a block of base64, which is unpacked while the next one comes in; a multiple of 3
GZIP = 31  # zlib's number for a gzip header, without a time or a name, around the largest window
ANYWHERE = "'self' https: http:"  # what a player may fetch that others host: its address names it


def encode_player(
    title: str,
    *,
    content: str | None = None,
    poster: str | None = None,
    description: str = "A player of 3D scenes",
    fetches: str = ANYWHERE,
    stages: Mapping[str, dict] | None = None,
    updates: str | None = None,
) -> bytes:
    """The page that plays a file beside it or one that its address names, as `?content=URL`; or that is dropped on it.

    Args:
        title: of the page.
        content: address of the file that it plays when its own names none, relative to the page; None for none.
        poster: address of the picture that is shown while that file comes in, relative to the page; None for none.
        description: for those who share the page.
        fetches: what it may fetch, as a content security policy has it.
        stages: from where to look at `.hyrf` files beside the page, by their address relative to it; see `html.stage`.
        updates: address of a JSON file that says which snapshot of a training `content` is: {"snapshot": number from 1,
            0 while there is none, "step", "steps"}. The page asks for it again and again and shows newer snapshots from
            where the viewer stands. None for a file that stays.

    Returns:
        The file, UTF-8. The same arguments give the same bytes.
    """
    beside: dict = {"content": content, "title": title, "stages": stages or {}}
    if updates is not None:
        beside["updates"] = updates
    texts = [json_text("content", beside)] if content is not None or stages else []
    if poster is not None:
        texts.append(f'<img id="poster" alt="" src="{html.escape(poster)}">')
    return player_page(title, texts, description, image=poster, fetches=fetches)


def player_page(
    title: str,
    texts: list[str],
    description: str,
    *,
    payload: bytes = b"",
    image: str | None = None,
    fetches: str = "",
    readers: bool = True,
) -> bytes:
    """The player's page around a scene.

    Args:
        title: of the page.
        texts: elements that its scripts find by their names, see `text` and `json_text`.
        description: for those who share the page.
        payload: a file inside it, empty for none.
        image: address of a picture for those who share the page.
        fetches: what it may fetch, as a content security policy has it.
        readers: whether files of splats can be played, too: a third more to carry.
    """
    style, script = part("viewer/style.css"), script_of("boot.js")
    main, packed = _scripts("worker.js" if readers else "worker_model.js")
    view = memoryview(payload)
    blocks = (base64.b64encode(view[at : at + BLOCK]).decode() for at in range(0, len(view), BLOCK))
    values = {
        "policy": content_policy(style, [script, main], fetches),
        "version": __version__,
        "title": html.escape(title),
        "meta": meta_tags(title, description, image),
        "style": style,
        "accept": ",".join([MODEL, *SPLATS] if readers else [MODEL]),
        "texts": "\n".join([*texts, text("player", packed)]),
        "script": script,
        "payload": "\n".join(f'<script type="text/plain" class="payload">{block}</script>' for block in blocks),
    }
    return fill(part("viewer/page.html"), values).encode()


def content_policy(style: str, scripts: Sequence[str] = (), fetches: str = "") -> str:
    """A content security policy: of code, only what is in the page runs, and only what `fetches` allows is fetched.

    Args:
        style: the text in the page's style element.
        scripts: those of its script elements.
        fetches: sources of files and pictures besides the page itself.
    """
    allowed = {"default-src": "'none'", "style-src": _hash(style), "img-src": f"{fetches} data: blob:".strip()}
    if scripts:
        allowed |= {"script-src": " ".join(map(_hash, scripts)), "worker-src": "blob:"}
        allowed |= {"connect-src": fetches} if fetches else {}
    allowed |= {"base-uri": "'none'", "form-action": "'none'"}
    return "; ".join(f"{what} {where}" for what, where in allowed.items())


def meta_tags(title: str, description: str, image: str | None = None) -> str:
    """What those who share a page's address are shown of it.

    Args:
        title, description: plain text.
        image: address of a picture, relative to the page; None for none.
    """
    facts = {"og:type": "website", "og:title": title, "og:description": description, "og:image": image}
    tags = [f'<meta property="{name}" content="{html.escape(text)}">' for name, text in facts.items() if text]
    return "\n".join([*tags, f'<meta name="description" content="{html.escape(description)}">'])


def element_script() -> bytes:
    """The script that defines <hyrf-viewer> for other people's pages, whose names it leaves alone."""
    return f"(() => {{\n{script_of('element.js')}\n}})();\n".encode()


def encode_readme(title: str, entry: str, index: str, *, element: str | None = None) -> bytes:
    """What to do with a folder of static files.

    Args:
        title: of what is shown.
        entry: name of the page that plays.
        index: name of the page that is opened first.
        element: name of a file that <hyrf-viewer>, whose script lies there, too, may show; None without that script.
    """
    line = f'  <script src="hyrf-viewer.js"></script> <hyrf-viewer src="{element}"></hyrf-viewer>\n' if element else ""
    values = {"title": title, "version": __version__, "entry": entry, "index": index, "element": line}
    return fill(part("hosted/README.txt"), values).encode()


def fill(template: str, values: dict[str, str]) -> str:
    """A text with each {{name}} in it replaced."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)


@cache
def _scripts(worker: str) -> tuple[str, str]:
    """The player's script, and it with the worker and the shaders as `boot.js` unpacks them: base64 of gzipped JSON."""
    names = sorted(entry.name for entry in files("hyrfpack.web").joinpath("viewer").iterdir())
    texts = {name: bare_script(part(f"viewer/{name}")) for name in names if name.endswith(SHADERS)}
    texts |= {"worker.js": script_of(worker), "main.js": script_of("main.js")}
    packer = zlib.compressobj(9, zlib.DEFLATED, GZIP, 9)
    packed = packer.compress(json.dumps(texts).encode()) + packer.flush()
    return texts["main.js"], base64.b64encode(packed).decode()


def script_of(name: str) -> str:
    """One of SCRIPTS, with short names where `make player` has been run since it last changed."""
    script, short = bundle(f"viewer/{name}"), json.loads(part("shortened.json")).get(name, {})
    return short["script"] if short.get("of") == digest(script) else script


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def text(name: str, text: str) -> str:
    """A text that scripts find by its name; there is no "</script" in it."""
    return f'<script type="text/plain" id="{name}">{text}</script>'


def json_text(name: str, value: dict) -> str:
    """The same of what comes from files: no "<" is left in it."""
    return text(name, json.dumps(value).replace("<", "\\u003c"))
