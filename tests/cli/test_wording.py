"""Library messages name Python arguments; the command line replaces them by its options."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from commands import hyrfpack, refused

from hyrfpack import __file__ as PACKAGE_FILE
from hyrfpack.cli import main
from hyrfpack.cli.wording import use_option_names
from hyrfpack.errors import HyrfError
from hyrfpack.outputs import Outputs

LIBRARY_FOLDER = Path(PACKAGE_FILE).parent


def message_strings(module: Path) -> Iterator[str]:
    """Yield the strings of a module that are not docstrings, and each constant part of f-strings."""
    nodes = list(ast.walk(ast.parse(module.read_text(encoding="utf-8"))))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


@cache
def library_strings() -> list[tuple[str, str]]:
    modules = [(path.relative_to(LIBRARY_FOLDER).as_posix(), path) for path in sorted(LIBRARY_FOLDER.rglob("*.py"))]
    return [(name, text) for name, path in modules if not name.startswith("cli/") for text in message_strings(path)]


def test_no_library_message_names_an_option_of_the_command_line():
    assert [(module, text) for module, text in library_strings() if re.search(r"(?<![\w-])--[a-z]", text)] == []


def test_every_argument_in_a_library_message_is_an_option_of_some_command():
    arguments = [
        (module, found) for module, text in library_strings() for found in re.findall(r"`[a-z_0-9]+(?:=[^`]+)?`", text)
    ]
    options = {
        name
        for command in main.commands.values()
        for option in command.params
        for name in (*option.opts, *option.secondary_opts)
    }

    assert len(arguments) > 40
    assert [(module, found) for module, found in arguments if use_option_names(found).split()[0] not in options] == []


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("replace it with `overwrite=True`", "replace it with --overwrite"),
        ("name photos with `data`", "name photos with --data"),
        ("use `device='cpu'`", "use --device cpu"),
        ("`test_every=0` trains on all", "--test-every 0 trains on all"),
        ("try `background=False`", "try --no-background"),
        ("lower `degree`, or raise `target_bytes`", "lower --sh-degree, or raise --target-size"),
        ("see `hyrfpack render --help`", "see `hyrfpack render --help`"),
    ],
)
def test_arguments_become_options(message, expected):
    assert use_option_names(message) == expected


def test_text_quoted_in_a_problem_is_never_read_as_a_setting(tmp_path):
    name = "`overwrite=True` {data} {0} %s.hyrf"

    assert hyrfpack("info", tmp_path / name).stderr.startswith(f"Error: {tmp_path / name}: ")


def test_the_same_error_names_an_argument_in_python_and_an_option_on_the_command_line(tmp_path):
    (tmp_path / "there.hyrf").write_bytes(b"kept")

    with pytest.raises(HyrfError, match="replace it with `overwrite=True`$"):
        Outputs().file(tmp_path / "there.hyrf")

    sentence = refused("decompress", tmp_path / "model.hyrf", "-o", tmp_path / "there.hyrf")
    assert sentence.endswith("replace it with --overwrite")
