"""What all report pages share: the page around their content, sections, tables and figures. All texts are escaped."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING

from hyrfpack.errors import printable
from hyrfpack.evaluate.figures import figure_to_svg
from hyrfpack.version import __version__
from hyrfpack.web.player import content_security_policy, fill_template, hash_source

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The values of --dim in style.css for light and for dark backgrounds.
LIGHT_TEXT_COLOR = "#5a6068"
DARK_TEXT_COLOR = "#a6acb3"


def encode_page(
    heading: str, content: Iterable[str], *, title: str = "", script: str = "", data: str = "", pictures: str = ""
) -> bytes:
    """Encode a report page. It fetches nothing but pictures, and its style has light and dark colours.

    Args:
        heading: plain text.
        content: HTML of the parts of the page, such as `section` returns.
        title: plain text; the heading if empty.
        script: the page's script, empty for none.
        data: element with the data of the script.
        pictures: source of pictures, in the syntax of a content security policy; empty if all are in the page.

    Returns:
        The HTML file, UTF-8. The same arguments give the same bytes.
    """
    style = read_asset("style.css")
    values = {
        "policy": content_security_policy(hash_source(style), [hash_source(script)] if script else [], pictures),
        "version": __version__,
        "title": escape(title or heading),
        "style": style,
        "heading": escape(heading),
        "content": "\n".join(content),
        "scripts": f"{data}\n<script>{script}</script>" if script else "",
    }
    return fill_template(read_asset("page.html"), values)


def section(name: str, heading: str, *content: str) -> str:
    """Return a section of a page as HTML.

    Args:
        name: id of the section.
        heading: plain text.
        content: HTML of the section's parts.
    """
    title = f'<h2 id="{name}-heading">{escape(heading)}</h2>'
    return "\n".join([f'<section id="{name}" aria-labelledby="{name}-heading">', title, *content, "</section>"])


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph of plain text as HTML; `kind` is a class of style.css."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def table(header: Sequence[str], rows: Sequence[str], caption: str = "") -> str:
    """Return a table as HTML.

    Args:
        header: HTML of the heads of the columns; that of the row names may be empty.
        rows: results of `table_row`.
        caption: plain text.
    """
    heads = "".join(f'<th scope="col">{head}</th>' if head else "<td></td>" for head in header)
    return "\n".join([
        '<div class="wide"><table>',
        *([f"<caption>{escape(caption)}</caption>"] if caption else []),
        f"<thead><tr>{heads}</tr></thead>",
        "<tbody>",
        *rows,
        "</tbody></table></div>",
    ])  # fmt: skip


def table_row(name: str, cells: Sequence[str], best: str | None = None, *, chosen: bool = False) -> str:
    """Return a row of a table as HTML; cells equal to `best`, or all if it is the chosen row, are emphasised."""
    tags = ('<td class="best">' if cell == best else "<td>" for cell in cells)
    formatted = "".join(f"{tag}{escape(cell)}</td>" for tag, cell in zip(tags, cells, strict=True))
    opened = '<tr class="chosen">' if chosen else "<tr>"
    return f'{opened}<th scope="row">{escape(name)}</th>{formatted}</tr>'


def style_axes(axes: Axes) -> None:
    """Give a plot the style of the pages: a transparent background, and text in LIGHT_TEXT_COLOR."""
    axes.figure.patch.set_alpha(0)
    axes.patch.set_alpha(0)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(LIGHT_TEXT_COLOR)
    axes.tick_params(colors=LIGHT_TEXT_COLOR)
    axes.xaxis.label.set_color(LIGHT_TEXT_COLOR)
    axes.yaxis.label.set_color(LIGHT_TEXT_COLOR)


def embed_figure(figure: Figure, description: str) -> str:
    """Return a figure of `style_axes` as HTML, with one SVG for light and one for dark backgrounds."""
    svg = figure_to_svg(figure)
    light, dark = (_svg_data_uri(svg.replace(LIGHT_TEXT_COLOR, ink)) for ink in (LIGHT_TEXT_COLOR, DARK_TEXT_COLOR))
    return (
        f'<div class="wide"><picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img class="figure" src="{light}" alt="{escape(description)}"></picture></div>'
    )


def read_asset(name: str) -> str:
    """Return the text of a file of this package."""
    return files("hyrfpack.report").joinpath(name).read_text("utf-8")


def escape(text: str) -> str:
    """Escape a text for HTML, and bytes of it that are not valid Unicode."""
    return html.escape(printable(text))


def _svg_data_uri(svg: str) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
