"""Functions that run the command line as a user would."""

from __future__ import annotations

from click.testing import CliRunner, Result

from hyrfpack.cli import main
from hyrfpack.cli.wording import use_option_names


def hyrfpack(*arguments: object) -> Result:
    """Run `hyrfpack` with these arguments and return its exit code and output."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def succeeded(*arguments: object) -> Result:
    """Run a command and check that its exit code is 0."""
    result = hyrfpack(*arguments)
    assert result.exit_code == 0, result.output
    return result


def refused(*arguments: object) -> str:
    """Run a command that ends in a user error and return its error line.

    The exit code is 2, standard output is empty and there is no traceback.
    """
    result = hyrfpack(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    (sentence,) = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    assert use_option_names(sentence) == sentence, "an argument is named in place of its option"
    return sentence
