"""The gallery page, which lists several scenes, each with a picture and a link to the player."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote, urlencode

from hyrfpack.counts import format_count
from hyrfpack.version import __version__
from hyrfpack.web.assets import read_web_file
from hyrfpack.web.player import content_security_policy, fill_template, meta_tags

STYLE_FILE_NAME = "gallery.css"


@dataclass(frozen=True)
class Card:
    """The entry of a scene in a gallery.

    Attributes:
        title: name of the scene.
        content, poster: addresses of its file and its picture, relative to the gallery; `poster` may be None.
        count: number of Gaussians in the file.
        length: size of the file in bytes.
        quality: quality of the scene in words; empty if unknown.
    """

    title: str
    content: str
    poster: str | None
    count: int
    length: int
    quality: str = ""


def encode_gallery(title: str, cards: Sequence[Card], player: str) -> bytes:
    """Return a page of cards without scripts; all texts are escaped, so that none is read as HTML.

    Its style is the file STYLE_FILE_NAME beside it, see `encode_gallery_style`.

    Args:
        title: title of the page.
        cards: the entries, one for each scene.
        player: address of the page that plays the scenes, relative to this one.

    Returns:
        The file, UTF-8. The same arguments give the same bytes.
    """
    posters = [quote(card.poster) for card in cards if card.poster]
    tags = meta_tags(title, f"{format_count(len(cards), 'scene')} in 3D", posters[0] if posters else None)
    values = {
        "policy": content_security_policy("'self'", fetches="'self'"),
        "version": __version__,
        "title": html.escape(title),
        "meta": tags,
        "style": STYLE_FILE_NAME,
        "cards": "\n".join(_card(card, player) for card in cards),
    }
    return fill_template(read_web_file("hosted/gallery.html"), values)


def encode_gallery_style() -> bytes:
    """Return the style sheet of a gallery."""
    return read_web_file("hosted/gallery.css").encode()


def _card(card: Card, player: str) -> str:
    """Return the HTML of a card."""
    named = {"content": card.content, **({"poster": card.poster} if card.poster else {})}
    address = f"{player}?{urlencode(named, quote_via=quote)}"
    picture = '<div class="picture"></div>'
    if card.poster:
        picture = f'<img class="picture" src="{html.escape(quote(card.poster))}" alt="" loading="lazy">'
    facts = [format_count(card.count, "Gaussian"), format_bytes(card.length), *([card.quality] if card.quality else [])]
    return (
        f'<li>{picture}<h2><a href="{html.escape(address)}">{html.escape(card.title)}</a></h2>'
        f"<p>{html.escape(' · '.join(facts))}</p></li>"
    )


def format_bytes(length: int) -> str:
    """Return a number of bytes in kB or MB: "86 kB", "1.5 MB"."""
    return f"{length / 1e6:,.1f} MB" if length >= 999_500 else f"{max(1, round(length / 1e3))} kB"
