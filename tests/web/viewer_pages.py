"""Pages of other authors that use the viewer's modules, as served to a browser."""

from __future__ import annotations

import json

from web.site import Site

from hyrfpack.web.assets import list_web_files, read_web_file
from hyrfpack.web.player import embedded_texts, webgpu_texts

VIEWER_PAGE = """<!DOCTYPE html>
<link rel="icon" href="data:,"><style>body {{ margin: 0; }} .box {{ width: 240px; height: 180px; }}</style>
{body}
<script type="module">
import {{ createViewer }} from "/viewer/viewer.js";
import {{ setTextSource }} from "/viewer/texts.js";
const texts = await (await fetch("/texts.json")).json();
setTextSource((name) => texts[name]);
window.createViewer = createViewer;
window.waitFor = (viewer, event) => new Promise((resolve) => viewer.on(event, resolve));
{script}
window.isPageReady = true;
</script>
"""


def serve_modules(site: Site) -> None:
    """Add the viewer's modules and texts to a site."""
    for path in list_web_files("viewer", ".js") + list_web_files("hyrf", ".js"):
        site.files[f"/{path}"] = read_web_file(path).encode()
    site.files["/texts.json"] = json.dumps(embedded_texts("worker.js") | webgpu_texts()).encode()


def viewer_page(script: str = "", body: str = '<div id="box" class="box"></div>') -> bytes:
    """Return a page that runs a script with `createViewer` and `waitFor(viewer, event)`."""
    return VIEWER_PAGE.format(body=body, script=script).encode()
