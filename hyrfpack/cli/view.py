"""`hyrfpack view`."""

from __future__ import annotations

from pathlib import Path

import click

from hyrfpack.cli.common import PATH, note
from hyrfpack.cli.export import degree_option


@click.command(short_help="Look at a model in a browser.")
@click.argument("model", type=PATH)
@degree_option
@click.option("--port", type=click.IntRange(0, 65535), default=0, show_default="a free one", help="Port to serve at.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to serve at; 0.0.0.0 lets others look.")
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def view(model: Path, degree: int, port: int, host: str, no_browser: bool) -> None:
    """Look at MODEL, a .hyrf file, in a browser: what 'hyrfpack export' writes as .html, served until Ctrl-C.

    \b
    Examples:
      hyrfpack view bonsai.hyrf
      hyrfpack view bonsai.hyrf --port 8000 --no-browser
    """
    from hyrfpack.export.pipeline import page_of
    from hyrfpack.web.serve import serve

    note("making the page; press Ctrl-C to end")
    serve(lambda: page_of(model, degree), host=host, port=port, open_browser=not no_browser, say=click.echo)
