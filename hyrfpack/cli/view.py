"""The command `hyrfpack view`."""

from __future__ import annotations

from pathlib import Path

import click

from hyrfpack.cli.common import json_option, note, print_json
from hyrfpack.cli.types import INPUT_PATH


@click.command(short_help="Show a model in a browser.")
@click.argument("model", type=INPUT_PATH)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    metavar="PORT",
    default=0,
    show_default="a free port",
    help="Port of the server.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address of the server; with 0.0.0.0, other machines can open the page.",
)
@click.option("--no-browser", is_flag=True, help="Print the address, but open no browser.")
@json_option
def view(model: Path, port: int, host: str, no_browser: bool, as_json: bool) -> None:
    """Show MODEL in a browser until Ctrl-C: a .hyrf file, the folder of a run, or splats (.ply .spz .splat .sog).

    The file is served unchanged, with the same player that 'hyrfpack export' writes to a folder. Of a large file, the
    first layer appears while the others load. A scene folder of 'hyrfpack split', or a .zip of it, is streamed: coarse
    levels first, then what the view needs.

    \b
    Examples:
      hyrfpack view bonsai.hyrf
      hyrfpack view bonsai.hyrf --port 8000 --no-browser
    """
    from hyrfpack.web.view import view as serve_view

    def print_address(address: str) -> None:
        note("press Ctrl-C to end")
        if as_json:
            print_json({"address": address})
        else:
            click.echo(address)

    serve_view(model, host=host, port=port, open_browser=not no_browser, on_ready=print_address)
