"""A missing package that only one task needs is a clear error."""

from __future__ import annotations

import sys

import pytest
from scenes import small_model

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError, needs_package
from hyrfpack.evaluate.figures import draw_training_curve
from hyrfpack.format import save


@pytest.fixture
def hide_package(monkeypatch):
    """A function that makes a package impossible to import."""

    def hide(package: str) -> None:
        for name in [name for name in sys.modules if name.split(".")[0] == package]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, package, None)

    return hide


def test_a_missing_package_is_named_with_its_task_and_how_to_install_it():
    with pytest.raises(HyrfError, match="^flying needs nowhere-at-all; run 'pip install nowhere-at-all'$"):
        with needs_package("nowhere-at-all", "flying"):
            import nowhere_at_all  # noqa: F401


def test_profile_paper_without_dahuffman_writes_nothing(hide_package, tmp_path):
    hide_package("dahuffman")

    with pytest.raises(HyrfError, match="profile 'paper' needs dahuffman; run 'pip install dahuffman'"):
        save(small_model([(0, 0, 0)]), tmp_path / "model.hyrf", "paper")

    assert not list(tmp_path.iterdir())


def test_a_colmap_model_without_pycolmap_is_a_clear_error_that_names_the_folder(hide_package, tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "sparse").mkdir()
    for table in ("cameras", "images", "points3D"):
        (tmp_path / "sparse" / f"{table}.txt").touch()
    hide_package("pycolmap")

    with pytest.raises(HyrfError, match="sparse: reading COLMAP models needs pycolmap"):
        load_scene(tmp_path)


def test_figures_without_matplotlib_are_a_clear_error(hide_package, tmp_path):
    hide_package("matplotlib")

    with pytest.raises(HyrfError, match="drawing figures needs matplotlib"):
        draw_training_curve([{"step": 1, "psnr": 20.0, "loss": 0.1, "gaussians": 1}], tmp_path / "curve.png")
