"""The command `hyrfpack view`."""

from __future__ import annotations

from pathlib import Path

import click

from hyrfpack.cli.common import PATH, json_option, note, print_json


@click.command(short_help="Look at a model in a browser.")
@click.argument("model", type=PATH)
@click.option("--port", type=click.IntRange(0, 65535), default=0, show_default="a free one", help="Port to serve at.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to serve at; 0.0.0.0 lets others look.")
@click.option("--no-browser", is_flag=True, help="Only print the address.")
@json_option
def view(model: Path, port: int, host: str, no_browser: bool, as_json: bool) -> None:
    """Look at MODEL in a browser, until Ctrl-C: a .hyrf file, the folder of a run, or splats (.ply .spz .splat .sog).

    The file is served as it is, beside the player that 'hyrfpack export' writes into a folder; of a large one, the
    first layer is seen while the rest comes in.

    \b
    Examples:
      hyrfpack view bonsai.hyrf
      hyrfpack view bonsai.hyrf --port 8000 --no-browser
    """
    from hyrfpack.web.view import view as serve_view

    def say(address: str) -> None:
        note("press Ctrl-C to end")
        if as_json:
            print_json({"address": address})
        else:
            click.echo(address)

    serve_view(model, host=host, port=port, open_browser=not no_browser, say=say)
