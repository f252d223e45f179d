"""Fixtures for programs that the decoder's tests need: node, npm and the TypeScript compiler."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

TYPESCRIPT_COMPILER = Path(__file__).parents[2] / "node" / "node_modules" / "typescript" / "bin" / "tsc"


@pytest.fixture(scope="session", autouse=True)
def node() -> str:
    """Return the path of node; skip the test without it."""
    if not (path := shutil.which("node")):
        pytest.skip("node is not here; install Node.js 20 or newer")
    return path


@pytest.fixture(scope="session")
def npm() -> str:
    """Return the path of npm; skip the test without it."""
    if not (path := shutil.which("npm")):
        pytest.skip("npm is not here; it comes with Node.js")
    return path


@pytest.fixture(scope="session")
def compiler() -> Path:
    """Return the path of the TypeScript compiler; skip the test without it."""
    if not TYPESCRIPT_COMPILER.exists():
        pytest.skip("TypeScript is not here; run `npm ci` in tests/node")
    return TYPESCRIPT_COMPILER
