"""The stages: what each is made from, how it is done, and what it leaves in the work folder."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from hyrfpack.atomic import replacing
from hyrfpack.cameras.capture import has_mean_exposure
from hyrfpack.compress import compress
from hyrfpack.data import PictureCache
from hyrfpack.device import describe_device
from hyrfpack.distill import DistillConfig, distill
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate
from hyrfpack.evaluate.metrics import decibels
from hyrfpack.export import export
from hyrfpack.format import describe, load
from hyrfpack.format.run_folder import CHECKPOINT, METRICS, MODEL
from hyrfpack.make.plan import Plan
from hyrfpack.make.progress import Reporter
from hyrfpack.make.state import digest, digest_all
from hyrfpack.make.work import PRODUCTS, Work
from hyrfpack.scene import Scene
from hyrfpack.train import train
from hyrfpack.train.progress import SMOOTHING

SCENE, RUN, PACKED, EXPORTED = (PRODUCTS[stage] for stage in ("poses", "training", "compression", "export"))
POSES = "poses.json"  # the report of `hyrfpack.estimate_poses`, in the scene's folder


# -- poses ---------------------------------------------------------------------------------------------------------


def is_posed(scene: Path) -> bool:
    """Whether `hyrfpack.estimate_poses` has finished a scene: the model is put beside the report at last."""
    return (scene / POSES).is_file() and (scene / "sparse" / "0").is_dir()


def pose(work: Work, photos: Path, files: Sequence[Path], matching: str, seed: int) -> dict[str, Any]:
    """Estimate poses into `scene/`; returns what `hyrfpack.estimate_poses` reports."""

    def act(going_on: bool) -> tuple[dict, list[str]]:
        from hyrfpack.poses import estimate_poses

        def tell(doing: str, share: float) -> None:
            work.reporter.update(share, doing)

        scene = work.folder / SCENE
        if not (going_on and is_posed(scene)):
            estimate_poses(photos, scene, matching=matching, seed=seed, report=tell, say=work.say)
        shutil.rmtree(scene / ".poses", ignore_errors=True)  # products in progress, where it was killed at the end
        files = sorted(path for path in scene.rglob("*") if path.is_file())
        report = json.loads((scene / POSES).read_bytes())
        return report, [path.relative_to(work.folder).as_posix() for path in files]

    inputs = {"photos": digest_all(files, photos), "matching": matching, "seed": seed}
    return work.stage("poses", inputs, act)


# -- training ------------------------------------------------------------------------------------------------------


def fit(
    work: Work, scene: Scene, data: str, plan: Plan, seed: int, device: torch.device, cache: PictureCache
) -> dict[str, Any]:
    """Train into `run/`; returns steps, Gaussians and the choices made."""
    config = plan.config(seed)
    run = work.folder / RUN

    def act(going_on: bool) -> tuple[dict, list[str]]:
        if not (going_on and _is_finished(run)):
            work.say(
                f"training: {plan.steps:,} steps on {len(scene.train)} photos, {len(scene.test)} held out; "
                f"on {describe_device(device)}"
            )
            resume = going_on and (run / CHECKPOINT).is_file()
            report = _training_report(work.reporter, plan.steps)
            try:
                trained = train(
                    scene, run, config, resume=resume, overwrite=True, cache=cache, device=device, quiet=True,
                    report=report,
                )  # fmt: skip
            except HyrfError as error:  # what it says of going on is about the command `train`
                raise error.__cause__ if isinstance(error.__cause__, HyrfError) else error from None
            if not trained.complete:
                raise KeyboardInterrupt
        metrics = json.loads((run / METRICS).read_bytes())
        facts = {key: metrics[key] for key in ("gaussians", "bytes", "choices", "device")}
        return {"steps": plan.steps, **facts}, [f"{RUN}/{name}" for name in (MODEL, METRICS)]

    inputs = {"photos and poses": data, "settings": config.to_dict(), **_split(scene)}
    return work.stage("training", inputs, act)


def _is_finished(run: Path) -> bool:
    """Whether a run came to its end, of which the record did not hear: the checkpoint goes last."""
    return (run / METRICS).is_file() and (run / MODEL).is_file() and not (run / CHECKPOINT).exists()


def _split(scene: Scene) -> dict[str, Any]:
    """Which photos are held out, and how large all are."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in scene.views})
    return {"held-out photos": [view.name for view in scene.test], "size of photos": sizes}


def _training_report(reporter: Reporter, steps: int) -> Callable[[int, float, float, int], None]:
    seen, measuring = math.nan, False

    def report(step: int, loss: float, mse: float, gaussians: int) -> None:
        nonlocal seen, measuring
        if step == 0:
            measuring = True
            reporter.update(0.0, "short runs tell how many Gaussians the scene is worth")
            return
        if measuring:  # the pace of what follows is another
            measuring = False
            reporter.begin("training")
        if not math.isnan(mse):
            seen = mse if math.isnan(seen) else SMOOTHING * mse + (1 - SMOOTHING) * seen
        quality = () if math.isnan(seen) else (f"PSNR {decibels(seen):.2f}",)
        reporter.update(step / steps, f"{step:,}/{steps:,}", *quality, f"{gaussians:,} Gaussians")

    return report


# -- packing -------------------------------------------------------------------------------------------------------


def pack(work: Work, scene: Scene, plan: Plan, device: torch.device) -> dict[str, Any]:
    """Compress into `model.hyrf`; returns bytes and Gaussians."""

    def act(going_on: bool) -> tuple[dict, list[str]]:
        def say(sentence: str) -> None:
            work.reporter.update(0.0, sentence)

        source, target = work.folder / RUN / MODEL, work.folder / PACKED
        report = compress(
            source, target, data=scene, finetune_steps=plan.finetune_steps, target_bytes=plan.target_bytes,
            device=device, say=say,
        )  # fmt: skip
        return {"bytes": report.bytes_after, "gaussians": report.gaussians, "found": report.found}, [PACKED]

    cameras = "photos" if plan.finetune_steps else "cameras"  # fine-tuning looks at all, the rest at where they are
    inputs = {
        "model": digest(work.folder / RUN / MODEL),
        cameras: work.state.inputs("training")["photos and poses"],
        "finetune": plan.finetune_steps,
        "target size": plan.target_bytes,
    }
    return work.stage("compression", inputs, act)


def import_splats(work: Work, source: Path, steps: int, seed: int) -> dict[str, Any]:
    """Learn from splats of another program into `model.hyrf`; returns the report of `hyrfpack.distill`."""
    files = sorted(p for p in source.parent.iterdir() if p.is_file()) if source.name == "meta.json" else [source]
    if source.is_dir():
        files = sorted(p for p in source.iterdir() if p.is_file())
    config = DistillConfig(steps=steps, seed=seed)

    def act(going_on: bool) -> tuple[dict, list[str]]:
        def say(sentence: str) -> None:
            work.reporter.update(0.0, sentence)

        report = distill(source, work.folder / PACKED, config, say=say)
        return report.to_dict(), [PACKED]

    inputs = {"splats": digest_all(files, source.parent), "settings": asdict(config)}
    return work.stage("import", inputs, act)


# -- writing and scoring -------------------------------------------------------------------------------------------


def write(work: Work, model: Path, name: str, scene: Scene | None) -> tuple[dict[str, Any], Path]:
    """Export a model as `export/NAME`; returns the export's report and the path."""
    target = work.folder / EXPORTED / name

    def act(going_on: bool) -> tuple[dict, list[str]]:
        def say(sentence: str) -> None:
            work.reporter.update(0.0, sentence)

        if name.lower().endswith(".hyrf"):
            copy(model, target)
            report: dict[str, Any] = {"bytes": target.stat().st_size}
        else:
            made = export(model, target, data=scene, say=say)
            report = {**asdict(made), "file": name, "chosen_by": {}}
        files = sorted(target.rglob("*")) if target.is_dir() else [target]
        return report, [path.relative_to(work.folder).as_posix() for path in files if path.is_file()]

    inputs: dict[str, Any] = {"model": digest(model), "name": name}
    if scene is not None:
        inputs |= {"photos and poses": work.state.inputs("training")["photos and poses"], **_split(scene)}
    return work.stage("export", inputs, act), target


def score(work: Work, scene: Scene, device: torch.device) -> dict[str, Any]:
    """Score `model.hyrf` on held-out photos; returns means, and how many photos it was."""
    model = work.folder / PACKED

    def act(going_on: bool) -> tuple[dict, list[str]]:
        if not scene.test:
            return {"views": 0}, []
        training = scene.train if has_mean_exposure(describe(model)["provenance"]) else ()
        scores = evaluate(load(model, device), scene.test, training=training)
        means = {name: getattr(scores, name) for name in ("psnr", "psnr_predicted", "ssim")}
        return {"views": len(scores.views), **means}, []

    inputs = {"model": digest(model), "photos": work.state.inputs("training")["photos and poses"], **_split(scene)}
    return work.stage("scoring", inputs, act)


def deliver(product: Path, output: Path) -> None:
    """Copy what was made, a file or the files of a folder, to where it is wanted."""
    if not product.is_dir():
        copy(product, output)
        return
    for path in sorted(product.rglob("*")):
        if path.is_file():
            copy(path, output / path.relative_to(product))


def copy(source: Path, target: Path) -> None:
    """Copy a file; it is there whole or not at all."""
    if digest(source) != digest(target):
        with replacing(target, source.stat().st_size) as temporary:
            shutil.copyfile(source, temporary)
