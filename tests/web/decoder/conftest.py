"""What the decoder's tests need beside Python: node, and for some npm and TypeScript."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

COMPILER = Path(__file__).parents[2] / "node" / "node_modules" / "typescript" / "bin" / "tsc"


@pytest.fixture(scope="session", autouse=True)
def node() -> str:
    """The path of node."""
    if not (path := shutil.which("node")):
        pytest.skip("node is not here; install Node.js 20 or newer")
    return path


@pytest.fixture(scope="session")
def npm() -> str:
    """The path of npm."""
    if not (path := shutil.which("npm")):
        pytest.skip("npm is not here; it comes with Node.js")
    return path


@pytest.fixture(scope="session")
def compiler() -> Path:
    """The path of TypeScript's compiler."""
    if not COMPILER.exists():
        pytest.skip("TypeScript is not here; run `npm ci` in tests/node")
    return COMPILER
