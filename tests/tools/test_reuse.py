"""Studies use a stored result again only for the version, the settings and the data with which it was made."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.train import TrainConfig, TrainResult
from tools.studies import magnification, precision, processes, reuse, train_sets
from tools.studies.reuse import check_origin, describe_origin, describe_version, remove_outdated, write_origin


@pytest.fixture
def set_version(monkeypatch):
    """A function that gives this version another name."""

    def set_name(name: str) -> None:
        monkeypatch.setattr(reuse, "describe_own_version", lambda: name)

    set_name("first")
    return set_name


def run_git(folder: Path, *words: str) -> None:
    author = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *author, *words], cwd=folder, check=True, capture_output=True)


def test_a_version_is_a_commit_with_its_changes(tmp_path: Path):
    run_git(tmp_path, "init")
    source, names = tmp_path / "hyrfpack" / "old.py", []
    source.parent.mkdir()
    for text in ("first", "second", "third"):
        source.write_text(text)
        names += [describe_version(tmp_path)] if names else []
        run_git(tmp_path, "add", ".")
        run_git(tmp_path, "commit", "-m", text)
        names.append(describe_version(tmp_path))
    source.write_text("fourth")
    names.append(describe_version(tmp_path))
    source.write_text("fifth")
    names.append(describe_version(tmp_path))
    (tmp_path / "hyrfpack" / "new.py").write_text("untracked")
    names.append(describe_version(tmp_path))
    (tmp_path / "hyrfpack" / "new.py").write_text("untracked, too")
    names.append(describe_version(tmp_path))
    assert len(set(names)) == len(names) == 9
    assert [("-dirty" in name) for name in names] == [False, True, False, True, False, True, True, True, True]


def test_files_that_are_no_sources_do_not_change_the_version(tmp_path: Path):
    run_git(tmp_path, "init")
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools" / "a.py").touch()
    run_git(tmp_path, "add", ".")
    run_git(tmp_path, "commit", "-m", "sources")
    name = describe_version(tmp_path)
    (tmp_path / "results").touch()
    assert describe_version(tmp_path) == name
    run_git(tmp_path, "add", ".")
    run_git(tmp_path, "commit", "-m", "results")
    (tmp_path / "results").write_text("others")
    assert describe_version(tmp_path) == name


def test_a_folder_that_is_no_work_tree_has_no_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    with pytest.raises(HyrfError, match="git cannot tell the version"):
        describe_version(tmp_path)


def test_without_git_a_version_is_a_digest_of_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    monkeypatch.setattr(reuse, "REPOSITORY_ROOT", tmp_path)
    names = []
    for folder, text in (("hyrfpack", "a = 1"), ("hyrfpack", "a = 2"), ("tools", "a = 1"), ("tools", "a = 2")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "code.py").write_text(text)
        reuse.describe_own_version.cache_clear()
        names.append(reuse.describe_own_version())
    reuse.describe_own_version.cache_clear()
    assert len(set(names)) == 4 and all(name.startswith("sources-") for name in names)


@pytest.mark.parametrize(
    ("data", "version", "settings", "difference"),
    [
        ("a", "first", {"steps": 5}, None),
        ("b", "first", {"steps": 5}, "data was .*a, now .*b"),
        ("a", "second", {"steps": 5}, "version was first, now second"),
        ("a", "first", {"steps": 6}, "steps was 5, now 6"),
        ("a", "first", {"steps": 5, "seed": 1}, "seed was None, now 1"),
        ("a", "first", {}, "steps was 5, now None"),
    ],
)
def test_a_result_of_another_origin_is_refused_or_removed(data, version, settings, difference, tmp_path):
    folder = tmp_path / "run"
    write_origin(folder, describe_origin(Path("a"), "first", steps=5))
    (folder / "model.hyrf").touch()
    origin = describe_origin(Path(data), version, **settings)
    if difference:
        with pytest.raises(HyrfError, match=f"{folder}: .*{difference}"):
            check_origin(folder, origin)
    else:
        check_origin(folder, origin)
    remove_outdated(folder, origin)
    assert (folder / "model.hyrf").exists() == (difference is None)
    check_origin(folder, origin)


def test_files_without_an_origin_are_never_removed(tmp_path):
    (tmp_path / "photo.jpg").touch()
    with pytest.raises(HyrfError, match="it has files but no origin.json"):
        remove_outdated(tmp_path, describe_origin(tmp_path, "first"))
    assert [path.name for path in tmp_path.iterdir()] == ["photo.jpg"]


def test_a_result_without_an_origin_is_refused(tmp_path):
    with pytest.raises(HyrfError, match="no origin.json"):
        check_origin(tmp_path, describe_origin(tmp_path, "first"))


@pytest.fixture
def fake_training(monkeypatch):
    """The folders that a study trains into; no run is made, and all files have the same scores."""
    trained = []
    files = ("model.hyrf", "metrics.json", "paper.hyrf", "compact.hyrf")
    metrics = (
        '{"evaluation": {"psnr": 1, "ssim": 1}, "gaussians": 1, "steps_per_second": 1, "seconds": 1, '
        '"stage_seconds": {}, "choices": {"preset": "room: why"}}'
    )

    def train(scene, out, *arguments, **options):
        trained.append(out)
        out.mkdir(parents=True, exist_ok=True)
        for name in files:
            (out / name).write_text(metrics)
        return TrainResult(True, 5, out / "model.hyrf", {})

    model = SimpleNamespace(gaussians=SimpleNamespace())
    scene = SimpleNamespace(views=[SimpleNamespace(camera=SimpleNamespace(width=8, height=8))], test=[])
    scores = SimpleNamespace(psnr=20.0, ssim=0.5, seconds_per_frame=1.0)
    monkeypatch.setattr(hyrfpack, "train_model", train)
    monkeypatch.setattr(hyrfpack, "compress_model", lambda *arguments, **options: None)
    monkeypatch.setattr(hyrfpack, "load_model", lambda path: model)
    monkeypatch.setattr(hyrfpack, "load_scene", lambda path, **options: scene)
    monkeypatch.setattr(hyrfpack, "evaluate_model", lambda model, views: scores)
    monkeypatch.setattr(train_sets, "load_variant", lambda data, name: scene)

    def run(command, **options):
        train(None, Path(command[command.index("-o") + 1]))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(processes.subprocess, "run", run)
    return trained


def test_an_interrupted_run_is_not_measured_as_one_of_this_version(fake_training, set_version, tmp_path, monkeypatch):
    """Its folder still has the metrics of the run that it would have replaced."""

    def measure(*, reuse: bool) -> None:
        train_sets.measure(tmp_path / "data", "demo", tmp_path / "out", TrainConfig(), reuse=reuse)

    measure(reuse=False)
    set_version("second")
    monkeypatch.setattr(hyrfpack, "train_model", lambda *arguments, **options: TrainResult(False, 1, None, {}))
    with pytest.raises(SystemExit, match="the training was stopped, so it is not measured"):
        measure(reuse=False)
    with pytest.raises(HyrfError, match="not one of the same version"):
        measure(reuse=True)


def test_a_reused_run_of_a_data_set_is_refused_for_another_version_or_other_settings(
    fake_training, set_version, tmp_path
):
    def measure(steps: int = 20_000, seed: int = 0, data: str = "data") -> None:
        config = TrainConfig(steps=steps, seed=seed)
        train_sets.measure(tmp_path / data, "demo", tmp_path / "out", config, reuse=True)

    measure()
    measure()
    assert len(fake_training) == 1
    # Pilot runs may have cut the run to fewer than 1,000 steps; it is one of 20,000 all the same.
    for change in ({"steps": 1000}, {"seed": 1}, {"data": "other"}):
        with pytest.raises(HyrfError, match="not one of the same version"):
            measure(**change)
    set_version("second")
    with pytest.raises(HyrfError, match="version was first, now second"):
        measure()
    assert len(fake_training) == 1


def test_magnification_and_processes_train_again_for_another_version_or_data_set(fake_training, set_version, tmp_path):
    def run_studies(data: str) -> int:
        fake_training.clear()
        magnification.measure(tmp_path / data, 5, 0, tmp_path / "magnification")
        processes.train(tmp_path / data, tmp_path / "processes", 2, ["--steps", "5"])
        return len(fake_training)

    assert [run_studies("a"), run_studies("a"), run_studies("b")] == [2, 0, 2]
    set_version("second")
    assert run_studies("b") == 2


def test_precision_trains_again_for_another_version_and_has_the_row_that_others_are_compared_with(
    set_version, tmp_path, monkeypatch, capsys
):
    rows = []
    monkeypatch.setattr(precision, "train_row", lambda scene, config, row: (rows.append(row) or [1], 1.0))
    monkeypatch.setattr(precision, "evaluate_model", lambda *_: SimpleNamespace(psnr=20.0, ssim=0.5))
    monkeypatch.setattr(hyrfpack, "load_scene", lambda path: SimpleNamespace(test=[]))
    monkeypatch.setattr("sys.argv", ["precision", "--only", "nudged 1", "--sets", "a", "--out", str(tmp_path)])
    precision.main()
    precision.main()
    assert rows == ["float32", "nudged 1"] and "nan" not in capsys.readouterr().out
    set_version("second")
    precision.main()
    assert rows == ["float32", "nudged 1"] * 2


def test_parallel_efficiency_refers_to_the_number_of_processes_of_the_first_row():
    def metrics(seconds: float) -> dict:
        return {
            "gaussians": 1,
            "evaluation": {"psnr": 20.0, "ssim": 0.5},
            "stage_seconds": {},
            "seconds": seconds,
        }

    # Twice as many processes take half the time: the efficiency is that of the first row.
    rows = [processes.format_row("a", count, metrics(100 / count), 2, metrics(50)) for count in (2, 4)]
    assert [row[-1] for row in rows] == ["1.00", "1.00"]
