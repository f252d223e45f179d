"""Measures that compare the quality of versions."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from hyrfpack.errors import HyrfError
from tools.studies.compare_versions import (
    bytes_change_at_equal_psnr,
    describe_version,
    remove_outdated,
    score_gain_at_equal_bytes,
)

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


def run_git(folder: Path, *words: str) -> None:
    author = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *author, *words], cwd=folder, check=True, capture_output=True)


def test_a_version_is_a_commit_with_its_changes(tmp_path: Path):
    run_git(tmp_path, "init")
    names = []
    for text in ("first", "second", "third"):
        (tmp_path / "file").write_text(text)
        names += [describe_version(tmp_path)] if names else []
        run_git(tmp_path, "add", "file")
        run_git(tmp_path, "commit", "-m", text)
        names.append(describe_version(tmp_path))
    (tmp_path / "file").write_text("fourth")
    names.append(describe_version(tmp_path))
    (tmp_path / "file").write_text("fifth")
    names.append(describe_version(tmp_path))
    assert len(set(names)) == len(names) == 7
    assert [("-dirty" in name) for name in names] == [False, True, False, True, False, True, True]


def test_a_folder_that_is_no_work_tree_has_no_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    with pytest.raises(HyrfError, match="git cannot tell the version"):
        describe_version(tmp_path)


def test_a_run_is_kept_only_for_the_same_versions_and_options(tmp_path: Path):
    out, training = tmp_path / "run", {"version": "a", "options": ["--no-exposure"], "gaussians": None}

    def fill() -> None:
        for name in ("model.hyrf", "scores.json", "scores-0.5.json"):
            (out / name).touch()

    def left() -> set[str]:
        return {path.name for path in out.iterdir()} - {"versions.json"}

    remove_outdated(out, training, "now")
    fill()
    remove_outdated(out, training, "now")
    assert left() == {"model.hyrf", "scores.json", "scores-0.5.json"}
    remove_outdated(out, training, "later")
    assert left() == {"model.hyrf"}
    for changed in ({"version": "b"}, {"options": []}, {"gaussians": 100}):
        fill()
        remove_outdated(out, training | changed, "later")
        assert left() == set()
        remove_outdated(out, training, "later")
