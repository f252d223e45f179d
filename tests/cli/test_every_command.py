"""No command loses a user's files: every command is tried with its inputs as its output.

No command writes over its inputs. Without --overwrite, no command writes into a folder with photos or poses, or over
an existing file. Every command checks all its outputs before it works. The rules themselves are tested in
`tests/outputs`, and with every path of every set in `tests/test_protected_sets.py`.

`python tests/cli/test_every_command.py` runs all cases and prints the table for the documentation.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import pytest
from click.testing import Result
from commands import hyrfpack
from layers import only_in_acceptance
from photo_sets import READ_PATHS_BY_SET, write_photo_sets

pytestmark = pytest.mark.usefixtures("quick_calibration", "quick_scores")
OUTCOME_REFUSED = "refused"
OUTCOME_REPLACED = "replaced"
OUTCOME_WRITTEN = "written"
# The error raised in place of work that would take minutes.
WORK_BEGAN_PROBLEM = "the work begins"
WORK_BEGAN_FIX = "let it"

# -- inputs of commands ------------------------------------------------------------------------------------------------

OUTPUT_ENDINGS = (".ply", ".splat", ".spz", ".glb", ".sog", ".html", ".points.ply", ".points.glb", ".json")
USD_ENDINGS = (".usda", ".usdc", ".usdz")


@dataclass(frozen=True)
class Case:
    """A command line, with {} for the output, the output path, and the expected outcome.

    Attributes:
        command: the words after "hyrfpack".
        output: a path below the working folder.
        plain, overwriting: the expected outcome without and with --overwrite.
    """

    command: str
    output: str
    plain: str = OUTCOME_REFUSED
    overwriting: str = OUTCOME_REFUSED

    def __str__(self) -> str:
        return self.command.format(self.output)


ALL_CASES = [
    # An input as the output: of each command, each kind of input and each output at least once.
    Case("make hall -o {}", "hall/new.html"),
    Case("make photos -o {}", "photos/new.html"),
    Case("make ball.ply -o {}", "{world}/ball.ply"),
    Case("make packed.hyrf -o {}", "packed.hyrf"),
    Case("poses hall -o {}", "hall/images"),
    Case("poses blender -o {}", "blender"),
    Case("train link-to-set -o {} --steps 2", "hall/images"),
    Case("train hall -o {} --steps 2 --blocks 1x1", "hall/images"),
    Case("compress soft.hyrf -o {}", "hard.hyrf"),
    Case("compress first --profile paper -o {}", "first/model.hyrf"),
    Case("compress model.hyrf --data nerfstudio -o {}", "nerfstudio/images/new.hyrf"),
    Case("compress model.hyrf --data hall -o small.hyrf --report {}", "hall/sparse/0"),
    Case("decompress first -o {}", "first/model.hyrf"),
    Case("edit first --center -o {}", "first/model.hyrf"),
    Case("edit soft.hyrf --center -o {}", "hard.hyrf"),
    Case("edit model.hyrf --data blender --center -o new.hyrf --picture {}", "blender/train/r_0.png"),
    Case("merge first soft.hyrf -o {}", "first/model.hyrf"),
    Case("split first -o {} --levels 1", "first/model.hyrf"),
    Case("split model.hyrf --data hall -o {} --levels 1", "hall/sparse/0"),
    Case("render model.hyrf --data blender -o {}", "blender/train"),
    Case("render model.hyrf --cameras nerfstudio/transforms.json -o {}", "nerfstudio/transforms.json"),
    Case("evaluate model.hyrf --data blender --lpips-weights lpips.pth --pictures {}", "lpips.pth"),
    Case("evaluate model.hyrf --data nerfstudio --pictures {}", "nerfstudio/masks"),
    Case("export named.json -o {}", "named.json"),  # a model under another name
    Case("export model.hyrf --data hall -o {}", "hall/images/new.spz"),
    Case("export model.hyrf --data blender -o {}", "blender/test"),
    Case("import ball.hyrf.ply -o {}", "hard-ball.hyrf"),
    Case("import ball.ply --cameras poses.hyrf -o {}", "poses.hyrf"),
    Case("import loose/meta.json -o {}", "loose/means_l.webp"),
    Case("convert loose {}", "loose/new.ply"),
    Case("compare first second -o {}", "second/model.hyrf"),
    Case("bench model.hyrf --data hall -o {}", "hall/new.png"),
    Case("bench model.hyrf --data hall -o new.png --markdown {}", "hall/images/new.md"),
    # Files of other programs, which only --overwrite replaces, and sets of photos that the command does not read.
    Case("make packed.hyrf --work made -o {}", "old/a.html", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("train hall -o {} --steps 2 --max-gaussians 50", "run", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("compress packed.hyrf -o {} --profile paper", "soft-to-old.hyrf", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("decompress packed.hyrf -o {}", "nerfstudio/images/back.hyrf", OUTCOME_REFUSED, OUTCOME_WRITTEN),
    Case("edit packed.hyrf --center -o {}", "old/a.hyrf", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("edit packed.hyrf --center --plan --picture {}", "old/a.png", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("merge packed.hyrf soft.hyrf -o {}", "old/a.hyrf", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("split packed.hyrf -o {} --levels 1", "old/scene", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("render model.hyrf --orbit 1 -o {}", "hall/images", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("evaluate model.hyrf --data hall --pictures {}", "old/pictures", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("export model.hyrf --sh-degree 0 -o {}", "old/a.ply", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("export model.hyrf --colmap -o {}", "old/colmap", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("export scene --streamed-sog -o {}", "old/streamed", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("export scene --3d-tiles -o {}", "old/tiles", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("export model.hyrf named.json -o {}", "old/gallery", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("import ball.ply --size 16 -o {}", "old/a.hyrf", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("convert ball.ply {}", "old/a.ply", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("compare first second -o {}", "old/a.html", OUTCOME_REFUSED, OUTCOME_REPLACED),
    Case("bench model.hyrf -o {}", "old/a.png", OUTCOME_REFUSED, OUTCOME_WRITTEN),
    Case("bench model.hyrf -o new.png --markdown {}", "old/a.md"),  # the page has no placeholders for tables
    Case("demo --steps 1 -o {}", "old/demo", OUTCOME_REFUSED, OUTCOME_WRITTEN),
    # Outputs that are allowed: a new folder, even inside the set.
    Case("train hall -o {} --steps 2 --max-gaussians 50", "hall/run", OUTCOME_WRITTEN, OUTCOME_WRITTEN),
]
# Other cases have these commands or these kinds of output.
SLOW_CASES = [case for case in ALL_CASES if case.output in ("old/a.hyrf", "old/streamed", "old/tiles")]


# -- files that a command could lose -----------------------------------------------------------------------------------


def make_input_folder(folder: Path) -> Path:
    """Create a set of photos of each layout, models, splats and foreign files, all as small as possible."""
    from explicit_balls import ball_splats

    from hyrfpack.cameras.files import cameras_to_json
    from hyrfpack.splats.formats import ply, sog

    named = write_photo_sets(folder)
    nerfstudio = folder / "nerfstudio"
    _run_checked("train", nerfstudio, "-o", folder / "trained", "--steps", 3, "--max-gaussians", 40)
    shutil.copy(folder / "trained" / "model.hyrf", folder / "model.hyrf")
    (folder / "trained").rename(folder / "first")
    shutil.copytree(folder / "first", folder / "second")
    _run_checked("compress", folder / "model.hyrf", "-o", folder / "packed.hyrf", "--profile", "paper")
    _run_checked("split", folder / "packed.hyrf", "-o", folder / "scene", "--levels", 1)
    shutil.copy(folder / "model.hyrf", folder / "named.json")
    (folder / "cameras.json").write_text(cameras_to_json(named))
    shutil.copy(folder / "cameras.json", folder / "poses.hyrf")
    shutil.copytree(nerfstudio / "images", folder / "photos")
    (folder / "lpips.pth").write_bytes(b"weights")
    for name in ("ball.ply", "ball.hyrf.ply"):
        (folder / name).write_bytes(ply.encode(ball_splats(20)))
    (folder / "loose").mkdir()
    for name, data in sog.encode_files(ball_splats(20)).items():
        (folder / "loose" / name).write_bytes(data)
    _make_foreign(folder, named[0][0])
    (folder / "soft.hyrf").symlink_to("packed.hyrf")
    os.link(folder / "packed.hyrf", folder / "hard.hyrf")
    (folder / "soft-ball.hyrf").symlink_to("ball.hyrf.ply")
    os.link(folder / "ball.hyrf.ply", folder / "hard-ball.hyrf")
    (folder / "soft-to-old.hyrf").symlink_to("old/a.hyrf")
    return folder


def _make_foreign(folder: Path, photo: str) -> None:
    """Write files of other programs under the names that commands use."""
    from hyrfpack.demo.run import RESULT_FILES as DEMO
    from hyrfpack.report.compression_page import REPORT_FILES

    scored = f"{Path(photo).stem}.png"
    names = [f"a{ending}" for ending in (".hyrf", ".png", ".json", ".md", *OUTPUT_ENDINGS)]
    names += ["colmap/sparse/0/cameras.bin", "player/index.html", "gallery/index.html"]
    names += ["streamed/lod-meta.json", "tiles/tileset.json"]
    names += ["pictures/0000.png", f"pictures/{scored}", f"report/{REPORT_FILES[0]}", "scene/shared.hyrf"]
    for path in (*(f"old/{name}" for name in names), f"old/demo/{DEMO[0]}", "run/metrics.json"):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(b"of another program")


def _run_checked(*arguments: object) -> None:
    result = hyrfpack(*arguments)
    assert result.exit_code == 0, result.output


def describe_files(folder: Path) -> dict[str, str]:
    """Return by path the SHA-256 of each file, the target of each link and "" for each folder."""
    found, waiting = {}, [""]
    while waiting:
        below = waiting.pop()
        with os.scandir(folder / below) as entries:
            for entry in entries:
                name = below + entry.name
                if entry.is_symlink():
                    found[name] = f"-> {os.readlink(entry.path)}"
                elif entry.is_dir():
                    found[name] = ""
                    waiting.append(f"{name}/")
                else:
                    with open(entry.path, "rb", buffering=0) as file:
                        found[name] = hashlib.sha256(file.read()).hexdigest()
    return found


# -- running the cases -------------------------------------------------------------------------------------------------


def run_case(case: Case, world: Path, before: dict[str, str], overwrite: bool) -> tuple[str, Result]:
    """Run a case in the working folder `world`, whose files are `before`.

    Returns:
        The outcome: one of the constants above, or what went wrong; and the command's result.
    """
    output = case.output.format(world=world)
    result = hyrfpack(*case.command.format(output).split(), *(["--overwrite"] if overwrite else []))
    after = describe_files(world)

    changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
    errors = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    began = errors == [f"Error: {WORK_BEGAN_PROBLEM}; {WORK_BEGAN_FIX}"]
    if "Traceback" in result.output or (result.exit_code and not (result.exit_code == 2 and len(errors) == 1)):
        return f"exit code {result.exit_code}, {len(errors)} sentences", result
    if result.exit_code and not began:
        return (f"refused, but {changed[0]} changed" if changed else OUTCOME_REFUSED), result
    place = str(Path(os.path.realpath(output)).relative_to(os.path.realpath(world)))
    beyond = [path for path in changed if path != place and not path.startswith(f"{place}/")]
    beyond = [
        path for path in beyond if path not in ("old/new.hyrf", "new.png", "small.hyrf")
    ]  # these are further outputs of the command
    beyond = [path for path in beyond if path.split("/")[0] != "made"]
    if beyond:
        return f"wrote over {beyond[0]}", result
    lost = [path for path in changed if path in before and before[path]]
    return (OUTCOME_REPLACED if lost else OUTCOME_WRITTEN), result


def _replace_work(patch: pytest.MonkeyPatch) -> None:
    """Make work that would take minutes raise an error when it begins."""
    from hyrfpack.errors import HyrfError

    def begin(*arguments: object, **options: object) -> None:
        raise HyrfError(WORK_BEGAN_PROBLEM, fix=WORK_BEGAN_FIX)

    patch.setattr(import_module("hyrfpack.bench.suite"), "benchmark_model", begin)
    patch.setattr(import_module("hyrfpack.demo.run"), "run_demo", begin)


def _forbid_work(patch: pytest.MonkeyPatch) -> None:
    """Make drawing an error, because outputs must be rejected before anything is learned, measured, baked or scored."""
    for name in ("bench", "compress", "demo", "evaluate", "export", "imports", "render", "report", "train"):
        import_module(f"hyrfpack.{name}")
    rasterize = import_module("hyrfpack.ops.rasterize").rasterize

    def draw(*arguments: object, **options: object) -> None:
        raise AssertionError("a picture was drawn before the refusal")

    for name, module in list(sys.modules.items()):
        if name.startswith("hyrfpack.") and getattr(module, "rasterize", None) is rasterize:
            patch.setattr(module, "rasterize", draw)


class FolderCopies:
    """Copies of a folder: a new one for each case that changes it, and one for all cases that do not."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.template = folder, make_input_folder(folder / "template")
        self.files = describe_files(self.template)
        self._copies = 0
        self._kept: Path | None = None

    def new(self) -> Path:
        self._copies += 1
        return copy_with_hard_links(self.template, self.folder / str(self._copies))

    @contextmanager
    def kept(self) -> Iterator[Path]:
        """The unchanged copy. After an error it is not reused."""
        world, self._kept = self._kept or self.new(), None
        yield world
        self._kept = world


@pytest.fixture(scope="module")
def folder_copies(tmp_path_factory: pytest.TempPathFactory) -> FolderCopies:
    return FolderCopies(tmp_path_factory.mktemp("worlds"))


def copy_with_hard_links(template: Path, folder: Path) -> Path:
    """Copy a folder with its hard links."""
    shutil.copytree(template, folder, symlinks=True)
    for link, name in (("hard.hyrf", "packed.hyrf"), ("hard-ball.hyrf", "ball.hyrf.ply")):
        (folder / link).unlink()
        os.link(folder / name, folder / link)
    return folder


@pytest.mark.usefixtures("quick_import")
@pytest.mark.parametrize("overwrite", [False, True], ids=["plain", "overwrite"])
@pytest.mark.parametrize("case", only_in_acceptance(ALL_CASES, SLOW_CASES), ids=str)
def test_no_command_loses_a_users_files(case, overwrite, folder_copies, monkeypatch):
    expected = case.overwriting if overwrite else case.plain
    _replace_work(monkeypatch)
    if expected == OUTCOME_REFUSED:
        _forbid_work(monkeypatch)

    with folder_copies.kept() if expected == OUTCOME_REFUSED else nullcontext(folder_copies.new()) as world:
        monkeypatch.chdir(world)
        outcome, result = run_case(case, world, folder_copies.files, overwrite)
        assert outcome == expected, result.output


def test_the_cases_cover_every_command_that_writes():
    from hyrfpack.cli import main

    writes = {name for name, command in main.commands.items() if any("--overwrite" in p.opts for p in command.params)}
    assert {case.command.split()[0] for case in ALL_CASES} == writes


@pytest.mark.usefixtures("quick_import")
def test_commands_accept_the_inputs_of_the_cases(folder_copies, monkeypatch):
    """Otherwise commands would fail for another reason."""
    monkeypatch.chdir(folder_copies.new())
    for name in READ_PATHS_BY_SET:
        _run_checked("evaluate", "model.hyrf", "--data", name, "--pictures", f"pictures-{name}")
    for source in ("ball.ply", "loose"):
        _run_checked("import", source, "-o", f"{source}-new.hyrf", "--size", 16)
    _run_checked("render", "model.hyrf", "--cameras", "cameras.json", "-o", "renders")


# -- the table ---------------------------------------------------------------------------------------------------------


def markdown_table() -> str:
    """Run all cases and return their outcomes as a Markdown table; an unexpected outcome is in capitals."""
    from tempfile import TemporaryDirectory

    lines = ["| command | input as output | without --overwrite | with --overwrite |", "|---|---|---|---|"]
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        folder_copies = FolderCopies(Path(folder))
        _replace_work(patch)
        for case in ALL_CASES:
            cells = []
            for overwrite, expected in ((False, case.plain), (True, case.overwriting)):
                world = folder_copies.new()
                patch.chdir(world)
                outcome, _ = run_case(case, world, folder_copies.files, overwrite)
                cells.append(outcome if outcome == expected else outcome.upper())
                patch.chdir(folder)
                shutil.rmtree(world)
            command = case.command.format("OUTPUT")
            output = case.output.format(world="/absolute/path")
            lines.append(f"| `hyrfpack {command}` | `{output}` | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(markdown_table())
