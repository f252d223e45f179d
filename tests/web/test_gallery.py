"""The gallery of scenes is plain HTML without scripts, and it escapes all texts that it is given."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest
from web.pages import Browser, wait_for_message, wait_for_path, wait_until
from web.site import Site, serve_player

from hyrfpack.web.gallery import Card, encode_gallery, encode_gallery_style, format_bytes
from hyrfpack.web.player import encode_player

BACK_VISIBLE_JS = "document.getElementById('back').checkVisibility()"
HOSTILE_TEXT = "\"><script>alert(1)</script>'&{{style}}"


class ParsedPage(HTMLParser):
    """The tags of a page with their attributes, and its text."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.found: list[tuple[str, dict]] = []
        self.text = ""
        self.feed(page.decode())

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data

    def of(self, tag: str) -> list[dict]:
        return [attributes for name, attributes in self.found if name == tag]


def test_each_scene_is_a_card_with_a_link():
    cards = [
        Card("room", "room.hyrf", "room.jpg", 12_345, 86_000, "25.07 dB on 12 held-out photos"),
        Card("hall", "hall.spz", None, 1, 1_500_000),
    ]
    page = ParsedPage(encode_gallery("scenes", cards, "player.html"))
    assert [link["href"] for link in page.of("a")] == [
        "player.html?content=room.hyrf&poster=room.jpg",
        "player.html?content=hall.spz",
    ]
    assert [image["src"] for image in page.of("img")] == ["room.jpg"] and page.of("img")[0]["alt"] == ""
    assert "12,345 Gaussians · 86 kB · 25.07 dB on 12 held-out photos" in page.text
    assert "1 Gaussian · 1.5 MB" in page.text
    assert len(page.of("h1")) == 1 and len(page.of("h2")) == len(page.of("li")) == 2


def test_a_gallery_contains_no_script_and_escapes_all_texts():
    data = encode_gallery(
        HOSTILE_TEXT, [Card(HOSTILE_TEXT, HOSTILE_TEXT, HOSTILE_TEXT, 1, 1, HOSTILE_TEXT)], "player.html"
    )
    page = ParsedPage(data)
    assert not page.of("script") and b"{{style}}" in data
    (policy,) = (meta["content"] for meta in page.of("meta") if meta.get("http-equiv"))
    assert "default-src 'none'" in policy and "script-src" not in policy and "unsafe" not in policy
    assert {tag for tag, _ in page.found} <= {
        *("html", "head", "meta", "title", "link", "style", "body", "main", "h1", "ul", "li", "img", "h2", "a", "p"),
    }


def test_a_gallery_has_a_preview_picture_and_light_and_dark_colors():
    cards = [Card("a", "a.hyrf", None, 1, 1), Card("b", "b.hyrf", "b.jpg", 1, 1)]
    data = encode_gallery("scenes", cards, "player.html").decode()
    assert '<meta property="og:image" content="b.jpg">' in data and "2 scenes" in data
    assert "prefers-color-scheme: dark" in encode_gallery_style().decode()


def luminance(color: str) -> float:
    """Return the relative luminance (WCAG 2) of #rgb or #rrggbb."""
    digits = color[1:] if len(color) == 7 else "".join(2 * digit for digit in color[1:])
    parts = [int(digits[at : at + 2], 16) / 255 for at in (0, 2, 4)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def test_text_has_enough_contrast_in_light_and_dark():
    data = encode_gallery_style().decode()
    schemes = re.findall(r":root \{([^}]*)\}", data)
    assert len(schemes) == 2
    for scheme in schemes:
        colors = dict(re.findall(r"--(\w+): (#\w+);", scheme))
        for ink in ("ink", "dim"):
            for ground in ("page", "card"):
                light, dark = sorted((luminance(colors[ink]), luminance(colors[ground])), reverse=True)
                assert (light + 0.05) / (dark + 0.05) >= 4.5, (ink, ground)


@pytest.mark.parametrize(
    ("length", "text"),
    [(1, "1 kB"), (85_952, "86 kB"), (999_400, "999 kB"), (999_500, "1.0 MB"), (2**30, "1,073.7 MB")],
)
def test_file_sizes_have_readable_units(length, text):
    assert format_bytes(length) == text


@pytest.mark.in_turn
def test_the_player_of_a_gallery_leads_back_to_it(browser: Browser):
    with serve_player() as host:
        check_way_back(browser, host)
    browser.resize(240, 180)


def check_way_back(browser: Browser, host: Site) -> None:
    host.files["/player.html"] = encode_player("scenes", gallery="index.html")
    host.files["/index.html"] = b"<!DOCTYPE html><title>scenes</title>"
    for size in [(1280, 800), (390, 844)]:
        browser.resize(*size)
        browser.open(f"{host.address}/player.html?content=cloud.spz")
        browser.evaluate("hyrfpack.ready")
        wait_until(browser, "document.body.classList.contains('there')")
        boxes = browser.evaluate(
            "['back', 'title', 'toolbar', 'strip'].map((name) => document.getElementById(name))"
            ".map((part) => (part.hidden = false, part.getBoundingClientRect()))"
            ".map(({ left, top, right, bottom }) => [left, top, right, bottom])"
        )
        back, *others = boxes
        assert back[0] >= 0 and back[2] <= size[0]
        assert all(back[2] <= b[0] or b[2] <= back[0] or back[3] <= b[1] or b[3] <= back[1] for b in others), boxes
    browser.evaluate("(document.getElementById('back').click(), 0)")
    wait_for_path(browser, "/index.html")
    browser.open(f"{host.address}/player.html?content=gone.hyrf")
    wait_for_message(browser)
    assert browser.evaluate(BACK_VISIBLE_JS), "a scene that fails has no way back"
    browser.open(f"{host.address}/player.html?content=cloud.spz&noui")
    browser.evaluate("hyrfpack.ready")
    assert not browser.evaluate(BACK_VISIBLE_JS)
