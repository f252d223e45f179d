"""Measures that compare the quality of versions."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hyrfpack.errors import HyrfError
from tools.studies import compare_versions, reuse
from tools.studies.compare_versions import bytes_change_at_equal_psnr, score_gain_at_equal_bytes

FILE_SIZES = np.array([1e5, 2e5, 4e5, 8e5])


def make_curve(sizes: np.ndarray, shift: float = 0.0) -> np.ndarray:
    """Return a curve of 1 dB for each doubling of the size."""
    return np.stack((sizes, 20 + np.log2(sizes / 1e5) + shift), 1)


@pytest.mark.parametrize("share", [0.5, 0.9, 1.0, 3.0])
def test_a_constant_ratio_of_bytes_at_equal_psnr_is_found(share):
    assert bytes_change_at_equal_psnr(make_curve(FILE_SIZES, -np.log2(share)), make_curve(FILE_SIZES)) == pytest.approx(
        share - 1
    )


def test_file_sizes_may_differ_and_be_unordered():
    assert bytes_change_at_equal_psnr(make_curve(1.7 * FILE_SIZES[::-1], 1.0), make_curve(FILE_SIZES)) == pytest.approx(
        -0.5
    )


def test_curves_that_share_no_psnr_are_not_compared():
    assert bytes_change_at_equal_psnr(make_curve(FILE_SIZES, 9.0), make_curve(FILE_SIZES)) is None


def test_a_larger_file_of_lower_quality_is_ignored():
    worse = np.array([[1.6e6, 18.0]])
    both = bytes_change_at_equal_psnr(
        np.concatenate((make_curve(FILE_SIZES, 1.0), worse)), np.concatenate((make_curve(FILE_SIZES), worse))
    )
    assert both == pytest.approx(-0.5)


def test_bytes_are_compared_only_at_psnr_that_useful_files_of_both_reach():
    """The useful files of `ours` have 30 and 33 dB: log2(kB / 100) is 1 in the mean, and 1.625 for `theirs`."""
    ours = np.array([[100.0, 30.0], [200.0, 25.0], [400.0, 33.0]])
    theirs = np.array([[100.0, 25.0], [200.0, 29.0], [400.0, 33.0]])
    assert bytes_change_at_equal_psnr(ours, theirs) == pytest.approx(2 ** (1 - 1.625) - 1)
    theirs[1, 1] = 31.0  # now from less than 200 kB to 400 kB, and ours from 100 to 400 kB
    assert -0.5 < bytes_change_at_equal_psnr(ours, theirs) < 0


def test_scores_are_compared_at_the_most_bytes_that_both_have():
    assert score_gain_at_equal_bytes(make_curve(FILE_SIZES, 0.7), make_curve(2 * FILE_SIZES)) == pytest.approx(0.7)
    assert score_gain_at_equal_bytes(make_curve(4 * FILE_SIZES, -0.2), make_curve(FILE_SIZES)) == pytest.approx(-0.2)


def test_scores_of_files_of_other_sizes_are_not_compared():
    smaller, larger = np.array([[8e4, 30.0], [9e4, 31.0]]), np.array([[1e5, 30.4]])
    assert score_gain_at_equal_bytes(smaller, larger) is score_gain_at_equal_bytes(larger, smaller) is None


@pytest.fixture
def scored_commands(monkeypatch, tmp_path):
    """The commands that `train_and_score` runs, of which none is executed."""
    commands = []

    def run(version, command, *arguments):
        commands.append((version, command, arguments))
        out = Path(arguments[arguments.index("-o") + 1])
        if command == "train":
            out.mkdir(parents=True, exist_ok=True)
            (out / "metrics.json").write_text('{"gaussians": 9}')
        (out / "compact.hyrf" if command == "train" else out).touch()

    monkeypatch.setattr(compare_versions, "_run_command", run)
    monkeypatch.setattr(compare_versions, "describe_version", lambda folder: folder.name)
    monkeypatch.setattr(compare_versions.hyrfpack, "load_model", lambda path: None)
    monkeypatch.setattr(
        compare_versions.hyrfpack, "evaluate_model", lambda model, views: SimpleNamespace(psnr=20.0, ssim=0.5)
    )
    compare_versions.compile_kernels.cache_clear()
    return commands


def test_scores_are_reused_only_for_the_same_data_set_and_version(scored_commands, tmp_path, monkeypatch):
    def trained(data: str, version: str = "a") -> bool:
        scored_commands.clear()
        scene = SimpleNamespace(path=data, test=[])
        compare_versions.train_and_score(Path(version), scene, 100, None, 0, tmp_path / "out")
        return any(command == "train" for _, command, _ in scored_commands)

    assert [trained("x/demo"), trained("x/demo"), trained("y/demo"), trained("y/demo", "b")] == [
        True,
        False,
        True,
        True,
    ]
    monkeypatch.setattr(reuse, "describe_own_version", lambda: "later")
    scored_commands.clear()
    assert not trained("y/demo", "b") and [command for _, command, _ in scored_commands] == ["compress"]


def test_kernels_are_compiled_before_the_first_timed_run_of_a_version(scored_commands, tmp_path):
    scene = SimpleNamespace(path="demo", test=[])
    for version in ("a", "b"):
        for seed in (0, 1):
            out = tmp_path / f"{version}{seed}"
            compare_versions.train_and_score(Path(version), scene, 100, None, seed, out, ["--no-exposure"])
    trainings = [(version.name, words) for version, command, words in scored_commands if command == "train"]
    assert [name for name, _ in trainings] == ["a", "a", "a", "b", "b", "b"]
    for _, words in (trainings[0], trainings[3]):
        assert words[-4:] == ("--steps", "20", "--max-gaussians", "500") and "--no-exposure" in words


def test_options_of_the_other_version_may_be_several_and_have_values(monkeypatch):
    parser = compare_versions.make_parser()
    args = parser.parse_args(["--against", "../before", "--against-options=--no-exposure --sh-degree 2"])
    assert args.against_options == ["--no-exposure", "--sh-degree", "2"]


def test_a_command_that_is_killed_without_output_is_reported_with_its_exit_code(tmp_path):
    (tmp_path / "hyrfpack").mkdir()
    (tmp_path / "hyrfpack" / "__init__.py").touch()
    (tmp_path / "hyrfpack" / "__main__.py").write_text("import os; os.kill(os.getpid(), 9)")
    with pytest.raises(HyrfError, match="`hyrfpack train` ended with exit code -9: no output"):
        compare_versions._run_command(tmp_path, "train")


def test_a_missing_folder_of_the_other_version_is_an_error_of_one_line(tmp_path):
    with pytest.raises(HyrfError, match="none: there is no such folder"):
        reuse.describe_version(tmp_path / "none")
