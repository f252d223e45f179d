"""The stages: what each is made from, how it is done, and what it leaves in the work folder."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from hyrfpack.atomic import pending_file
from hyrfpack.compress import compress
from hyrfpack.data import PictureCache
from hyrfpack.device import describe_device
from hyrfpack.distill import DistillConfig, distill
from hyrfpack.errors import HyrfError, HyrfSizeError
from hyrfpack.evaluate import evaluate
from hyrfpack.evaluate.metrics import psnr_from_mse
from hyrfpack.export import export
from hyrfpack.format import describe, load
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.make.plan import Plan
from hyrfpack.make.progress import Reporter
from hyrfpack.make.state import digest, digest_all
from hyrfpack.make.work import PRODUCTS, Work
from hyrfpack.outputs import Outputs
from hyrfpack.scene import Scene
from hyrfpack.train import Trainer, train
from hyrfpack.train.decisions import max_pilot_steps
from hyrfpack.train.progress import RUNNING_MEAN_WEIGHT
from hyrfpack.train.run import is_begun

SCENE, RUN, PACKED, EXPORTED = (PRODUCTS[stage] for stage in ("poses", "training", "compression", "export"))
FIXED_SETTINGS = ("target_bytes", "budget_factor", "exposure")  # of a training, from when it was begun on
POSES = "poses.json"  # the report of `hyrfpack.estimate_poses`, in the scene's folder


# -- poses ---------------------------------------------------------------------------------------------------------


def is_posed(scene: Path) -> bool:
    """Whether `hyrfpack.estimate_poses` has finished a scene: the model is put beside the report at last."""
    return (scene / POSES).is_file() and (scene / "sparse" / "0").is_dir()


def pose(work: Work, photos: Path, files: Sequence[Path], matching: str, seed: int) -> dict[str, Any]:
    """Estimate poses into `scene/`; returns what `hyrfpack.estimate_poses` reports."""

    def act(going_on: bool) -> tuple[dict, list[str]]:
        from hyrfpack.poses import estimate_poses

        scene = work.folder / SCENE
        if not (going_on and is_posed(scene)):
            estimate_poses(photos, scene, matching=matching, seed=seed, report=work.reporter.tell, say=work.say)
        shutil.rmtree(scene / ".poses", ignore_errors=True)  # products in progress, where it was killed at the end
        files = sorted(path for path in scene.rglob("*") if path.is_file())
        report = json.loads((scene / POSES).read_bytes())
        return report, [path.relative_to(work.folder).as_posix() for path in files]

    inputs = {"photos": digest_all(files, photos), "matching": matching, "seed": seed}
    return work.stage("poses", inputs, act)


# -- training ------------------------------------------------------------------------------------------------------


def fit(
    work: Work,
    scene: Scene,
    data: str,
    plan: Plan,
    seed: int,
    device: torch.device,
    cache: PictureCache,
    observer: Callable[[Trainer], None] | None,
) -> dict[str, Any]:
    """Train into `run/`; returns steps, Gaussians and the choices made.

    What follows from the target size stays as it was when the training was begun: another size does not train anew.
    """
    config = plan.config(seed)
    run = work.folder / RUN
    settings = {name: value for name, value in config.to_dict().items() if name not in FIXED_SETTINGS}
    inputs = {"photos and poses": data, "settings": settings, **_split(scene)}
    if work.state.is_under_way("training", inputs):
        config = replace(config, **work.state.fixed("training"))
    if config.target_bytes != plan.target_bytes:
        before = "without a target size" if config.target_bytes is None else f"for {config.target_bytes:,} bytes"
        work.say(
            f"the model is trained {before}, and only packed for the size that is asked for now; another work folder "
            "(`work`) trains it anew"
        )

    def act(going_on: bool) -> tuple[dict, list[str]]:
        if not (going_on and _is_finished(run)):
            work.say(
                f"training: {plan.steps:,} steps on {len(scene.train)} photos, {len(scene.test)} held out; "
                f"on {describe_device(device)}"
            )
            resume = going_on and is_begun(run)
            shown = _TrainingProgress(work.reporter, plan.steps, max_pilot_steps(scene, config))
            try:
                trained = train(
                    scene, run, config, resume=resume, overwrite=True, cache=cache, device=device, quiet=True,
                    report=shown.step, phase=shown.phase, observer=observer,
                )  # fmt: skip
            except HyrfError as error:  # what it says of going on is about the command `train`
                raise error.__cause__ if isinstance(error.__cause__, HyrfError) else error from None
            if not trained.complete:
                raise KeyboardInterrupt
            if not (run / METRICS_FILE).is_file():  # a full disk; the next call completes it
                raise HyrfError(trained.missing)
        metrics = json.loads((run / METRICS_FILE).read_bytes())
        facts = {key: metrics[key] for key in ("gaussians", "bytes", "choices", "device")}
        psnr = describe(run / MODEL_FILE)["provenance"]["psnr"]
        facts |= {"steps": plan.steps, "target_bytes": config.target_bytes, "psnr": psnr}
        return facts, [f"{RUN}/{name}" for name in (MODEL_FILE, METRICS_FILE)]

    return work.stage("training", inputs, act, {name: getattr(config, name) for name in FIXED_SETTINGS})


def trained_for(work: Work) -> int | None:
    """The target size that the training in a work folder was begun for; None for none."""
    return work.state.fixed("training").get("target_bytes")


def _is_finished(run: Path) -> bool:
    """Whether a run came to its end, of which the record did not hear: the checkpoint goes last."""
    return (run / METRICS_FILE).is_file() and (run / MODEL_FILE).is_file() and not (run / CHECKPOINT_FILE).exists()


def _split(scene: Scene) -> dict[str, Any]:
    """Which photos are held out, and how large all are."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in scene.views})
    return {"held-out photos": [view.name for view in scene.test], "size of photos": sizes}


class _TrainingProgress:
    """Shows the parts of a training: the pilot runs, the steps, then scores and pictures."""

    def __init__(self, reporter: Reporter, steps: int, max_pilot_steps: int) -> None:
        """Args: steps: of the training; max_pilot_steps: of all pilot runs before it."""
        self._reporter, self._steps, self._max_pilot_steps = reporter, steps, max_pilot_steps
        self._part, self._pilot_steps, self._mse = "pilots", 0, math.nan

    def step(self, step: int, loss: float, mse: float, gaussians: int) -> None:
        """Take in a step, as `report` of `hyrfpack.train`: number 0 while pilots run."""
        if step == 0:
            self._pilot_steps += 1
            self._reporter.update(min(1.0, self._pilot_steps / max(self._max_pilot_steps, 1)), "pilot runs")
            return
        self._begin("training")
        if not math.isnan(mse):
            weight = 1.0 if math.isnan(self._mse) else RUNNING_MEAN_WEIGHT
            self._mse = mse if weight == 1 else weight * mse + (1 - weight) * self._mse
        quality = () if math.isnan(self._mse) else (f"PSNR {psnr_from_mse(self._mse):.2f}",)
        self._reporter.update(step / self._steps, f"{step:,}/{self._steps:,}", *quality, f"{gaussians:,} Gaussians")
        if step == self._steps:
            self._begin("results")

    def phase(self, what: str, done: int, total: int) -> None:
        """Take in other work, as `phase` of `hyrfpack.train`. After the last step, it says how far the part is."""
        if self._part == "results" and total:
            self._reporter.update(done / total, what, f"{done:,}/{total:,}")
        else:
            self._reporter.say(f"{what}  {done:,}/{total:,}" if total else what)

    def _begin(self, part: str) -> None:
        if part != self._part:  # its pace is another
            self._part = part
            self._reporter.begin_part(part)


# -- packing -------------------------------------------------------------------------------------------------------


def pack(work: Work, scene: Scene, plan: Plan, device: torch.device) -> dict[str, Any]:
    """Compress into `model.hyrf`; returns bytes and Gaussians."""

    def act(going_on: bool) -> tuple[dict, list[str]]:
        source, target = work.folder / RUN / MODEL_FILE, work.folder / PACKED
        try:
            report = compress(
                source, target, data=scene, finetune_steps=plan.finetune_steps, target_bytes=plan.target_bytes,
                device=device, say=work.reporter.say, report=work.reporter.tell,
            )  # fmt: skip
        except HyrfSizeError as error:
            anew = ", or name another work folder (`work`) to train a smaller model for this size"
            raise HyrfError(
                f"the trained model does not fit into {plan.target_bytes:,} bytes; ask for {error.min_bytes:,} bytes "
                f"or more (`target_bytes`){anew if trained_for(work) != plan.target_bytes else ''}"
            ) from error
        return {"bytes": report.bytes_after, "gaussians": report.gaussians, "found": report.found}, [PACKED]

    cameras = "photos" if plan.finetune_steps else "cameras"  # fine-tuning looks at all, the rest at where they are
    inputs = {
        "model": digest(work.folder / RUN / MODEL_FILE),
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
        report = distill(source, work.folder / PACKED, config, say=work.reporter.say, report=work.reporter.tell)
        return report.to_dict(), [PACKED]

    inputs = {"splats": digest_all(files, source.parent), "settings": asdict(config)}
    return work.stage("import", inputs, act)


# -- writing and scoring -------------------------------------------------------------------------------------------


def write(work: Work, model: Path, name: str, scene: Scene | None) -> tuple[dict[str, Any], Path]:
    """Export a model as `export/NAME`; returns the export's report and the path."""
    target = work.folder / EXPORTED / name

    def act(going_on: bool) -> tuple[dict, list[str]]:
        if name.lower().endswith(".hyrf"):
            copy(model, target)
            report: dict[str, Any] = {"bytes": target.stat().st_size}
        else:
            made = export(model, target, data=scene, say=work.reporter.say, report=work.reporter.tell)
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
        scores = evaluate(load(model, device), scene.test, report=work.reporter.tell)
        means = {name: getattr(scores, name) for name in ("psnr", "psnr_consistent", "ssim")}
        return {"views": len(scores.views), **means}, []

    inputs = {"model": digest(model), "photos": work.state.inputs("training")["photos and poses"], **_split(scene)}
    return work.stage("scoring", inputs, act)


def deliver(product: Path, output: Path, *, overwrite: bool) -> Path:
    """Copy what was made, a file or the files of a folder that this call holds, to where it is wanted.

    Args:
        overwrite: replace files that are there. Without it, a file gets a free name beside one that is there; of a
            folder, whose files name each other, one that is there is an error.

    Returns:
        Where it is.

    Raises:
        HyrfError: it cannot be copied; it stays in the work folder.
    """
    if not product.is_dir():
        return copy(product, output, overwrite=overwrite)
    files = {path: output / path.relative_to(product) for path in sorted(product.rglob("*")) if path.is_file()}
    different = [target for path, target in files.items() if digest(path) != digest(target)]
    Outputs(overwrite=overwrite).folder(output, [os.path.relpath(target, output) for target in different])
    for path, target in files.items():
        copy(path, target, overwrite=overwrite, rename=False)
    return output


def copy(source: Path, target: Path, *, overwrite: bool = True, rename: bool = True) -> Path:
    """Copy a file, whole or not at all, unless it is there; as `hyrfpack.atomic.pending_file`. Returns where it is."""
    if digest(source) == digest(target):
        return target
    with pending_file(target, source.stat().st_size, overwrite=overwrite, rename=rename) as pending:
        shutil.copyfile(source, pending.temporary)
    return pending.path
