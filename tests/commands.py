"""The command line, called as a person would; see also `scenes`."""

from __future__ import annotations

from click.testing import CliRunner, Result

from hyrfpack.cli import main


def hyrfpack(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def succeeded(*arguments: object) -> Result:
    result = hyrfpack(*arguments)
    assert result.exit_code == 0, result.output
    return result


def refused(*arguments: object) -> str:
    """Run a command that the user got wrong; returns its one sentence."""
    result = hyrfpack(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    (sentence,) = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    return sentence
