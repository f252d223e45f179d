from __future__ import annotations

import hashlib
import json
import shutil
import sys
from functools import cache, partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from scenes import ball_points, small_model

from hyrfpack import save_model
from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.capture import scene_provenance
from hyrfpack.compress import CompressionReport, sensitivity
from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.errors import HyrfError
from hyrfpack.export.cameras import write_colmap
from hyrfpack.format.codec import encode_model
from hyrfpack.imports import ImportConfig
from hyrfpack.make import make_scene, minutes, stages
from hyrfpack.make.minutes import SceneCost
from hyrfpack.make.plan import QUALITIES, Quality
from hyrfpack.model import HybridModel
from hyrfpack.progress import StepEvent, TaskEvent
from hyrfpack.train import TrainResult
from hyrfpack.train.results import RECORD_FILE, TrainingRecord, read_record

QUICK_QUALITIES = {
    "draft": Quality(steps=6, large_photo_steps=6, gpu_steps=6, max_size=40, finetune_steps=0, import_psnr=20.0),
    "normal": Quality(steps=9, large_photo_steps=9, gpu_steps=9, max_size=1600, finetune_steps=0, import_psnr=20.0),
    "best": Quality(steps=9, large_photo_steps=9, gpu_steps=9, max_size=1600, finetune_steps=3, import_psnr=20.0),
}


@pytest.fixture(scope="module", autouse=True)
def quick_settings():
    """Few steps and views are enough here. The patch ends with the module, so that it does not reach other tests."""
    with pytest.MonkeyPatch.context() as patch:
        for name, quality in QUICK_QUALITIES.items():
            patch.setitem(QUALITIES, name, quality)
        patch.setattr(stages, "ImportConfig", partial(ImportConfig, size=24, views=6, test_views=2))
        patch.setattr(sensitivity, "MAX_SENSITIVITY_VIEWS", 12)
        yield


@pytest.fixture
def fake_stages(monkeypatch) -> None:
    """Training, compression, scoring and timing that do no work but read and write the same files as the real ones."""
    monkeypatch.setattr(stages, "train_model", fake_train_model)
    monkeypatch.setattr(stages, "compress_model", fake_compress_model)
    monkeypatch.setattr(stages, "evaluate_model", fake_evaluate_model)
    monkeypatch.setattr(
        minutes, "measure_scene_cost", lambda _, requested, *__: SceneCost(1e-3, 0.0, 0.0, 0.0, 100, requested)
    )


@pytest.fixture
def finished_work(fake_stages, posed, tmp_path_factory) -> Path:
    """The work folder of a scene that was made with fake stages. Tests may change it."""
    return make_scene(posed, tmp_path_factory.mktemp("made") / "scene.hyrf").work


@cache
def tiny_model(gaussians: int) -> HybridModel:
    return small_model(ball_points(gaussians)[0])


def fake_train_model(scene, run, config, *, resume, context, **options) -> TrainResult:
    """Write a checkpoint before each report and then the results, in the order of the real training.

    The model's file depends on the scene and on all settings.
    """
    run.mkdir(exist_ok=True)
    checkpoint, record_file = run / "checkpoint.pt", run / RECORD_FILE
    if not (resume and read_record(run)):
        done = int(checkpoint.read_text()) if resume else 0
        for step in range(done + 1, config.steps + 1):
            write_atomic(checkpoint, str(step).encode())
            context.progress(StepEvent(step, config.steps, 0.1, 0.01, 400))
        provenance = {"steps": config.steps, "settings": config.to_dict(), **scene_provenance(scene), "psnr": 25.0}
        data = encode_model(tiny_model(400), "raw", provenance)
        choices = {name: f"{getattr(config, name)}: as asked for" for name in ("max_gaussians", "preset")}
        metrics = {"curve": [], "gaussians": 400, "bytes": len(data), "choices": choices, "device": "none"}
        record = TrainingRecord("model.hyrf", hashlib.sha256(data).hexdigest(), config.steps, {}, metrics)
        write_atomic(record_file, record.encode())
        write_atomic(run / "model.hyrf", data)
        checkpoint.unlink()
    context.progress(TaskEvent("scoring held-out photos", done=1, total=2))
    metrics, missing = read_record(run).metrics, ""
    try:
        write_atomic(run / "metrics.json", json.dumps(metrics).encode())
        record_file.unlink()
    except HyrfError as error:
        missing = error.problem
    return TrainResult(True, config.steps, run / "model.hyrf", metrics, missing)


def fake_compress_model(source, target, config, *, context, **options):
    """Write a model whose file depends on that of the trained one and on the settings; a target size makes it small."""
    context.progress(TaskEvent("compressing", 0.5))
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    model = tiny_model(20 if config.target_bytes else 400)
    settings = [config.finetune_steps, config.target_bytes]
    written = save_model(model, target, provenance={"of": digest, "settings": settings})
    return CompressionReport(**vars(written))


def fake_evaluate_model(model, views, *, progress):
    """Return the same scores for any model."""
    progress(TaskEvent("scoring", 0.5))
    return SimpleNamespace(views=views, psnr=25.0, psnr_consistent=None, ssim=0.9)


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

    def estimate_poses(photos, out, config=None, *, masks=None, overwrite=False, context):
        out = Path(out)
        calls.append(Path(photos))
        with context.open_progress() as progress:
            progress(TaskEvent("matching", 0.5))
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
