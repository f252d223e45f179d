"""The frame of report pages: its content security policy allows the page's own style and script, and no others."""

from __future__ import annotations

import base64
import hashlib
import re

from hyrfpack.report.page import encode_page


def test_the_policy_allows_the_own_style_and_script_of_a_page():
    page = encode_page("Heading", ["<p>content</p>"], script="document.title = 'it ran';").decode()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    for directive, element in (("style-src", "style"), ("script-src", "script")):
        text = re.search(rf"<{element}>(.*?)</{element}>", page, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{directive} 'sha256-{digest}'" in policy


def test_a_page_without_a_script_allows_none():
    page = encode_page("Heading", ["<p>content</p>"]).decode()
    assert "script-src" not in page
    assert "default-src 'none'" in page
