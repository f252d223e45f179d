"""Console behaviour of every command: --quiet, --verbose, closed streams, wide characters and completion."""

from __future__ import annotations

import errno
import io
import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from threading import Event

import click
import pytest
from click.testing import CliRunner
from commands import hyrfpack, refused, succeeded
from rich.cells import cell_len
from scenes import small_model

from hyrfpack.cli import main
from hyrfpack.cli.common import format_table, note
from hyrfpack.cli.compress import _command_as_typed
from hyrfpack.cli.console import notes_only_of
from hyrfpack.cli.progress import show_item_progress
from hyrfpack.format import describe_file, save_model

REPOSITORY_ROOT = Path(__file__).parents[2]
TINY_TRAINING_OPTIONS = ("--steps", 3, "--max-gaussians", 50)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("models") / "model.hyrf"
    save_model(small_model([[0.0, 0, 0]]), path, profile="raw")
    return path


def shell(redirections: str, *command: object) -> subprocess.CompletedProcess:
    """Run a command with redirections in shell syntax, in an environment where Python finds this package."""
    words = ["sh", "-c", f'exec "$@" {redirections}', "sh", *map(str, command)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(REPOSITORY_ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    return subprocess.run(words, capture_output=True, text=True, check=False, env=environment)


def run_program(redirections: str, *arguments: object) -> subprocess.CompletedProcess:
    """Run the command line in another process."""
    return shell(redirections, sys.executable, "-m", "hyrfpack", *arguments)


# -- quiet and verbose -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", main.commands)
def test_every_command_has_quiet_and_verbose(command):
    printed = succeeded(command, "--help").stdout
    assert "--quiet" in printed and "--verbose" in printed


@pytest.mark.parametrize("before", [True, False], ids=["before the command", "after it"])
def test_quiet_training_and_rendering_print_only_their_results(before, data, tmp_path):
    for command, *arguments in (
        ("train", data, "-o", tmp_path / "run", *TINY_TRAINING_OPTIONS),
        ("render", tmp_path / "run" / "model.hyrf", "-o", tmp_path / "out", "--orbit", 2),
    ):
        result = succeeded(*(("--quiet", command) if before else (command, "--quiet")), *arguments)
        assert result.stderr == "" and str(tmp_path) in result.stdout
    assert succeeded(command, *arguments, "--overwrite").stderr != ""


def test_quiet_silences_all_output_only_while_the_command_runs(model, monkeypatch):
    def describe_loudly(path):
        note("a note")
        print("a library", file=sys.stderr)
        with click.progressbar(range(3), label="a bar", file=sys.stderr) as numbers:
            list(numbers)
        return describe_file(path)

    monkeypatch.setattr("hyrfpack.format.describe_file", describe_loudly)
    before = sys.stderr
    assert succeeded("info", model, "--quiet").stderr == ""
    assert sys.stderr is before
    loud = succeeded("info", model).stderr
    assert all(words in loud for words in ("a note", "a library", "a bar"))


@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "--quiet", "none.hyrf"),
        ("--quiet", "info", "none.hyrf"),
        ("info", "--quiet", "a", "b"),
        ("info", "--quiet", "a", "--nothing"),
        ("--quiet", "nothing"),
    ],
)
def test_quiet_still_prints_errors(arguments):
    assert refused(*arguments)


def test_verbose_prints_versions_device_and_times(data, tmp_path):
    result = succeeded("train", data, "-o", tmp_path, *TINY_TRAINING_OPTIONS, "--verbose", "--device", "cpu")
    first, *others = result.stderr.splitlines()
    assert all(f"{name} " in first for name in ("hyrfpack", "Python", "torch", "numpy"))
    assert any(line.endswith("device: cpu") for line in others)
    assert any("seconds: " in line and "backward" in line for line in others)
    assert "done (CPU time " in others[-1]
    assert result.stdout.startswith(str(tmp_path))


@pytest.mark.parametrize("arguments", [("info", "none.hyrf", "--verbose"), ("--verbose", "info", "none.hyrf")])
def test_verbose_prints_the_traceback_of_an_error_and_then_its_message(arguments):
    result = hyrfpack(*arguments)
    assert result.exit_code == 2 and result.stdout == ""
    assert "Traceback" in result.stderr and "in describe" in result.stderr
    assert result.stderr.splitlines()[-1].startswith("Error: none.hyrf")


@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "--quiet", "--verbose", "x"),
        ("--quiet", "info", "--verbose", "x"),
        ("--verbose", "info", "x", "--quiet"),
        ("--quiet", "--verbose", "info", "x"),
    ],
)
def test_quiet_and_verbose_exclude_each_other(arguments):
    result = hyrfpack(*arguments)
    assert result.exit_code == 2 and "--quiet and --verbose contradict each other" in result.stderr


def test_reports_show_the_command_without_quiet_and_verbose(model):
    command = main.commands["compress"]
    with command.make_context("compress", [str(model), "-o", "b.hyrf", "--verbose", "--no-prune"]) as context:
        assert _command_as_typed(context) == f"hyrfpack compress {model} --output b.hyrf --no-prune"


# -- messages of the library -----------------------------------------------------------------------------------------


@pytest.fixture
def describe_with_messages(monkeypatch) -> None:
    """Let `hyrfpack info` log messages; its description of a file that does not exist fails after them."""

    def describe(path):
        logging.getLogger("hyrfpack.made_up").warning("100 % of it is lost; use `max_size=0`")
        with notes_only_of("hyrfpack.train", "hyrfpack.make", silent=("hyrfpack.imports",)):
            logging.getLogger("hyrfpack.export.pipeline").info("a detail of a stage")
            logging.getLogger("hyrfpack.imports.run").warning("use `psnr`, which this command lacks")
            logging.getLogger("hyrfpack.export.pipeline").warning("a warning of a stage")
            logging.getLogger("hyrfpack.make.run").info("a sentence of the command")
        logging.getLogger("hyrfpack.made_up").debug("a detail for developers")
        return describe_file(path)

    monkeypatch.setattr("hyrfpack.format.describe_file", describe)


@pytest.mark.usefixtures("describe_with_messages")
def test_messages_of_the_library_are_notes_that_name_options(model):
    printed = ["100 % of it is lost; use --max-size 0", "a warning of a stage", "a sentence of the command"]
    assert succeeded("info", model).stderr.splitlines() == printed
    json.loads(succeeded("info", model, "--json").stdout)
    assert succeeded("info", model, "--json").stderr.splitlines() == printed
    assert succeeded("info", model, "--quiet").stderr == ""
    verbose = succeeded("info", model, "--verbose").stderr
    assert all(f" s] {sentence}\n" in verbose for sentence in printed)


def test_notes_show_control_characters_of_file_names_as_escapes(model, monkeypatch):
    monkeypatch.setattr("hyrfpack.format.describe_file", lambda path: note("x\x1b]0;title\x07\nError: forged") or {})
    assert hyrfpack("info", model).stderr.splitlines()[0] == r"x\x1b]0;title\x07\nError: forged"


@pytest.mark.usefixtures("describe_with_messages")
@pytest.mark.parametrize("exists", [True, False])
def test_a_command_leaves_the_loggers_as_they_were(exists, model, tmp_path, capsys):
    logger, printed = logging.getLogger("hyrfpack"), logging.StreamHandler()
    before = [*logger.handlers], logger.level, logger.propagate
    logging.getLogger().addHandler(printed)  # as other libraries do; it must not print a message again
    try:
        assert (hyrfpack("info", model if exists else tmp_path / "none.hyrf").exit_code == 0) == exists
    finally:
        logging.getLogger().removeHandler(printed)
    assert (logger.handlers, logger.level, logger.propagate) == before
    assert capsys.readouterr().err == ""


# -- missing streams -------------------------------------------------------------------------------------------------

# The command line, with an `info` that also prints a note.
LOUD_INFO_SCRIPT = """
from hyrfpack import format
from hyrfpack.cli import main
from hyrfpack.cli.common import note

describe_file = format.describe_file

def describe_loudly(path):
    note("a note")
    return describe_file(path)

format.describe_file = describe_loudly
main()
"""


class FullDisk(io.StringIO):
    """A stream that raises an error when it is written to."""

    def __init__(self) -> None:
        super().__init__()
        self.tried = Event()

    def write(self, text: str) -> int:
        self.tried.set()
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.acceptance
@pytest.mark.skipif(os.name == "nt", reason="a shell of Unix closes them")
def test_training_completes_with_standard_error_closed(data, tmp_path):
    done = run_program("2>&-", "train", data, "-o", tmp_path, *TINY_TRAINING_OPTIONS)
    assert done.returncode == 0 and describe_file(tmp_path / "model.hyrf")["gaussians"] > 0
    assert done.stdout.startswith(str(tmp_path / "model.hyrf")) and "step 3/3" not in done.stdout


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
@pytest.mark.parametrize("redirection", ["2>/dev/full", "2>&-", "2</dev/null"])
def test_unprintable_notes_do_not_end_the_command(redirection, model):
    done = shell(redirection, sys.executable, "-c", LOUD_INFO_SCRIPT, "info", model)
    assert done.returncode == 0 and done.stdout.startswith(str(model))


def test_progress_that_cannot_be_printed_does_not_end_the_work(monkeypatch):
    disk, failures = FullDisk(), []
    monkeypatch.setattr(sys, "stderr", disk)
    monkeypatch.setattr("threading.excepthook", failures.append)
    monkeypatch.setattr("hyrfpack.progress.lines.LOG_INTERVAL_SECONDS", 0.01)
    shown = [number for number in show_item_progress(range(2), 2, "render", "picture") if disk.tried.wait(10)]
    assert shown == [0, 1] and not failures


@pytest.mark.skipif(os.name == "nt", reason="a shell of Unix closes them")
def test_no_file_gets_the_descriptor_of_a_closed_stream():
    """Otherwise anything that a library prints would go into that file."""
    code = (
        "import os; from hyrfpack.cli import main; main(['--version'], standalone_mode=False); "
        "os._exit(0 if os.open(os.devnull, os.O_RDONLY) > 2 else 3)"
    )
    assert shell("<&- 2>&-", sys.executable, "-c", code).returncode == 0


@pytest.mark.skipif(os.name == "nt", reason="a shell of Unix closes them")
@pytest.mark.parametrize("redirections", [">&-", "<&- >&- 2</dev/null"])
def test_a_command_completes_without_standard_output(redirections, model):
    done = run_program(redirections, "info", model)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux")
def test_characters_outside_the_encoding_are_printed_as_escapes(model, tmp_path):
    for name in (b"\xe9.hyrf", "模型.hyrf".encode()):
        path = os.fsdecode(os.path.join(os.fsencode(tmp_path), name))
        shutil.copy(model, path)
        done = run_program("", "info", path)
        assert done.returncode == 0 and done.stdout.startswith(str(tmp_path)), done.stderr


# -- columns, completion ---------------------------------------------------------------------------------------------


def test_table_columns_are_aligned_with_wide_characters():
    text = format_table(
        ["文件", "dB", "名"], [["写真.png", "1.00", "ü"], ["a.png", "-", "日本"], ["e\u0301.png", "12", ""]]
    )
    lines = text.splitlines()
    assert cell_len(lines[1]) == max(map(cell_len, lines))
    assert [cell_len(line[: line.index(word)]) for line, word in zip(lines[2:4], ("1.00", "-"), strict=True)] == [
        10,
        13,
    ]
    assert cell_len(lines[0]) == cell_len(lines[3]) == 10 + 4 + 2 + 4
    assert lines[2].endswith("   ü")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script_for_the_shell(shell):
    if shell == "bash" and not shutil.which("bash"):
        pytest.skip("there is no bash here")
    result = CliRunner().invoke(main, prog_name="hyrfpack", env={"_HYRFPACK_COMPLETE": f"{shell}_source"})
    assert result.exit_code == 0 and "hyrfpack" in result.stdout and f"{shell}_complete" in result.stdout


def test_completion_offers_commands_and_options():
    words = {"COMP_WORDS": "hyrfpack tr", "COMP_CWORD": "1", "_HYRFPACK_COMPLETE": "bash_complete"}
    assert CliRunner().invoke(main, prog_name="hyrfpack", env=words).stdout.split() == ["plain,train"]
    words |= {"COMP_WORDS": "hyrfpack --quiet train --max-g", "COMP_CWORD": "3"}
    assert CliRunner().invoke(main, prog_name="hyrfpack", env=words).stdout.split() == ["plain,--max-gaussians"]
