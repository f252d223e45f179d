"""The documentation builds as a site without broken links, and every page is in its navigation."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY_ROOT = Path(__file__).parents[1]
pytest.importorskip("mkdocs", reason="mkdocs is not installed")
pytest.importorskip("mkdocstrings", reason="mkdocstrings is not installed")


def build(folder: Path, config: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(config), "-d", str(folder)]
    return subprocess.run(command, cwd=REPOSITORY_ROOT, capture_output=True, text=True)


@pytest.mark.acceptance
def test_the_site_builds_with_every_public_name(tmp_path):
    import hyrfpack

    done = build(tmp_path, REPOSITORY_ROOT / "mkdocs.yml")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "reference" / "api" / "index.html").read_text()
    missing = [name for name in hyrfpack.__all__ if name != "__version__" and f'.{name}"' not in page]
    assert missing == []
