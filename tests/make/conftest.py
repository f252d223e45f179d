from __future__ import annotations

import json
import shutil
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest

from hyrfpack.compress import sensitivity
from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.distill import DistillConfig
from hyrfpack.export.cameras import write_colmap
from hyrfpack.make import stages
from hyrfpack.make.plan import QUALITIES, Quality

QUICK_QUALITIES = {
    "draft": Quality(steps=6, gpu_steps=6, max_size=40, finetune_steps=0, import_steps=2),
    "normal": Quality(steps=9, gpu_steps=9, max_size=1600, finetune_steps=0, import_steps=3),
    "best": Quality(steps=9, gpu_steps=9, max_size=1600, finetune_steps=3, import_steps=4),
}


@pytest.fixture(scope="module", autouse=True)
def quick_settings():
    """Few steps and views are enough here. The patch ends with the module, so that it does not reach other tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch_quick_settings(patch)
        yield


def patch_quick_settings(patch: pytest.MonkeyPatch) -> None:
    for name, quality in QUICK_QUALITIES.items():
        patch.setitem(QUALITIES, name, quality)
    patch.setattr(stages, "DistillConfig", partial(DistillConfig, size=24, train_views=6, test_views=2))
    patch.setattr(sensitivity, "MAX_SENSITIVITY_VIEWS", 12)
    # Drawing the curve takes as long as all steps.
    patch.setattr("hyrfpack.train.results.draw_training_curve", lambda _, path, **options: path.touch())


@pytest.fixture(scope="session")
def posed(tmp_path_factory) -> Path:
    """Eighteen small photos with poses. Tests must not change them."""
    return write_demo_scene(tmp_path_factory.mktemp("posed") / "scene", views=18, size=32)


@pytest.fixture
def photos(posed, tmp_path) -> Path:
    """The same photos without poses."""
    shutil.copytree(posed / "images", tmp_path / "photos")
    return tmp_path / "photos"


@pytest.fixture
def poses(posed, monkeypatch) -> list[Path]:
    """A list of the arguments of each call of `estimate_poses`, which gives the known poses instead of estimating."""
    calls: list[Path] = []

    def estimate_poses(photos, out, *, matching="auto", masks=None, seed=0, overwrite=False, report=None):
        out = Path(out)
        calls.append(Path(photos))
        report("matching", 0.5)
        scene = load_scene(posed, test_every=0)
        shutil.copytree(posed / "images", out / "images", dirs_exist_ok=True)
        write_colmap([(view.name, view.camera) for view in scene.views], out, None)
        facts = {"scene": str(out), "photos": 19, "registered": 18, "sure": 17, "left_out": {"dark.jpg": "blurred"}}
        facts |= {"mapper": "global", "why": "it explains more", "notes": ["half of it is guessed"], "seconds": {}}
        (out / "poses.json").write_text(json.dumps(facts))

    module = ModuleType("hyrfpack.poses")
    module.estimate_poses = estimate_poses
    monkeypatch.setitem(sys.modules, "hyrfpack.poses", module)
    return calls
