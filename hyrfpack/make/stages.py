"""Stages of the pipeline: the inputs of each, the work, and the product in the work folder."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from hyrfpack.atomic import pending_file
from hyrfpack.compress import compress_model
from hyrfpack.config.compress import CompressConfig
from hyrfpack.config.export import ExportConfig
from hyrfpack.config.poses import PosesConfig
from hyrfpack.config.train import TrainConfig
from hyrfpack.context import RunContext
from hyrfpack.copying import copy_file
from hyrfpack.counts import format_count
from hyrfpack.device import describe_device
from hyrfpack.errors import HyrfError, HyrfSizeError, HyrfTrainingError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.export import export_model
from hyrfpack.format import describe_file, load_model
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.imports import ImportConfig, import_splats
from hyrfpack.make.first_look import show_first_look
from hyrfpack.make.plan import Plan
from hyrfpack.make.preview import remove_preview, write_preview
from hyrfpack.make.progress import Reporter
from hyrfpack.make.stage_cache import PRODUCT_NAMES, StageCache, Stopped
from hyrfpack.make.state import file_digest, files_digest
from hyrfpack.outputs import Outputs
from hyrfpack.progress import Event, StepEvent, TaskEvent
from hyrfpack.progress.status import StepMeans, format_psnr
from hyrfpack.scene import Scene
from hyrfpack.splats.files import list_source_files
from hyrfpack.train import Trainer, train_model
from hyrfpack.train.decisions import measures_length
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.run import is_begun, without_resume_hint
from hyrfpack.train.teachers import TEACHER_STEPS, TEACHER_TASK_PREFIX, count_teachers

_LOG = logging.getLogger(__name__)

SCENE_FOLDER = PRODUCT_NAMES["poses"]
RUN_FOLDER = PRODUCT_NAMES["training"]
PACKED_MODEL = PRODUCT_NAMES["compression"]
EXPORT_FOLDER = PRODUCT_NAMES["export"]
FIRST_LOOK_FOLDER = "first_look"  # deleted when the first look ends
FIXED_SETTINGS = ("target_bytes", "budget_factor", "exposure")  # a training run that was begun keeps these settings
POSES_REPORT_NAME = "poses.json"  # `hyrfpack.estimate_poses` writes its report into the scene's folder


# -- poses ---------------------------------------------------------------------------------------------------------


def is_posed(scene: Path) -> bool:
    """Return whether `hyrfpack.estimate_poses` has finished a scene; it writes the model last, after the report."""
    return (scene / POSES_REPORT_NAME).is_file() and (scene / "sparse" / "0").is_dir()


def run_pose_stage(
    stage_cache: StageCache,
    photos: Path,
    files: Sequence[Path],
    config: PosesConfig,
    observer: Callable[[Trainer], None] | None,
    context: RunContext,
) -> dict[str, Any]:
    """Estimate poses and write them into `scene/`; return the report of `hyrfpack.estimate_poses`.

    An observer gets a first look before the estimation, see `show_first_look`.
    """

    def execute(resuming: bool) -> tuple[dict, list[str]]:
        from hyrfpack.poses import estimate_poses

        scene = stage_cache.folder / SCENE_FOLDER
        if not (resuming and is_posed(scene)):
            if observer is not None:
                show_first_look(photos, stage_cache.folder / FIRST_LOOK_FOLDER, config, observer, context)
            estimate_poses(photos, scene, config, context=context)
        shutil.rmtree(scene / ".poses", ignore_errors=True)  # a call that was killed at its end leaves these
        written = sorted(path for path in scene.rglob("*") if path.is_file())
        report = json.loads((scene / POSES_REPORT_NAME).read_bytes())
        return report, [path.relative_to(stage_cache.folder).as_posix() for path in written]

    inputs = {"photos": files_digest(files, photos), **asdict(config)}
    return stage_cache.run_stage("poses", inputs, execute)


# -- training ------------------------------------------------------------------------------------------------------


def run_training_stage(
    stage_cache: StageCache,
    scene: Scene,
    scene_digest: str,
    plan: Plan,
    seed: int,
    observer: Callable[[Trainer], None] | None,
    context: RunContext,
) -> dict[str, Any]:
    """Train a model and write it into `run/`; return the numbers of steps and Gaussians, the decisions and other facts.

    A training run that was begun keeps its target size and what was decided from it. So a call with another target size
    does not train again.
    """
    config = plan.train_config(seed)
    run = stage_cache.folder / RUN_FOLDER
    settings = {name: value for name, value in config.to_dict().items() if name not in FIXED_SETTINGS}
    inputs = {"photos and poses": scene_digest, "settings": settings, **_split_inputs(scene)}
    if stage_cache.state.is_under_way("training", inputs):
        config = replace(config, **stage_cache.state.fixed("training"))
    if config.target_bytes != plan.target_bytes:
        target = "without a target size" if config.target_bytes is None else f"for {config.target_bytes:,} bytes"
        kept = (
            f"the trained model is kept: it was trained {target}, and only the compression is repeated"
            if stage_cache.state.facts("training", inputs) is not None
            else f"the training that was begun {target} is resumed, and only the compression changes"
        )
        _LOG.info(f"{kept}; name another work folder (`work`) to train again")

    def execute(resuming: bool) -> tuple[dict, list[str]]:
        if not (resuming and _is_run_finished(run)):
            resume = resuming and is_begun(run)
            has_teachers = resume and (run / CHECKPOINT_FILE).is_file()
            runs = describe_runs(scene, replace(config, virtual_views=config.virtual_views and not has_teachers))
            _LOG.info(f"training: {runs}; on {describe_device(context.choose_device())}")
            if not resume:
                remove_preview(stage_cache)  # it shows other photos or settings
            _train(stage_cache, scene, config, resume, observer, context)
        return _read_training_facts(run, config), [f"{RUN_FOLDER}/{name}" for name in (MODEL_FILE, METRICS_FILE)]

    return stage_cache.run_stage("training", inputs, execute, {name: getattr(config, name) for name in FIXED_SETTINGS})


def describe_runs(scene: Scene, config: TrainConfig) -> str:
    """Describe the training of a scene in words: its teacher runs, if it has any, its steps and photos."""
    photos = len(scene.train)
    teachers = count_teachers(photos, PhotoSize.of_views(scene.train), config)
    before = f"{teachers} teacher runs of {format_count(TEACHER_STEPS, 'step')}, then " if teachers else ""
    at_most = "at most " if measures_length(scene, config) else ""
    steps = f"{at_most}{format_count(config.steps, 'step')}"
    return f"{before}{steps} on {format_count(photos, 'photo')}, {len(scene.test)} held out"


def _train(
    stage_cache: StageCache,
    scene: Scene,
    config: TrainConfig,
    resume: bool,
    observer: Callable[[Trainer], None] | None,
    context: RunContext,
) -> None:
    """Train a model into `run/`. An interrupted training leaves a preview of the scene beside its checkpoint.

    Args:
        stage_cache: the stages of the pipeline.
        scene: the photos.
        config: settings of the training.
        resume: resume the run that is in `run/`.
        observer: observer of the training, besides that of the preview.
        context: context of the call.

    Raises:
        Stopped: the training was interrupted.
        HyrfError: it failed, or some of its results could not be written.
    """
    run = stage_cache.folder / RUN_FOLDER
    shown: list[Trainer] = []  # the trainer of which a preview would be written
    begun: set[str] = set()  # the kinds of runs that have taken a step

    def observe(trainer: Trainer) -> None:
        # A pilot run is short and lacks the validation photos. A teacher is shown until the next run has as many steps.
        # A finished main run is not kept, so that its memory is free while results are written.
        begun.add(trainer.kind)
        if trainer.kind == "" and trainer.step == trainer.steps:
            shown.clear()
        elif trainer.kind != "pilot run" and (not shown or trainer.step >= shown[0].step):
            shown[:] = [trainer]
        if observer is not None:
            observer(trainer)

    progress = _TrainingProgress(stage_cache.reporter).report_event
    try:
        trained = train_model(
            scene, run, config, resume=resume, overwrite=True, observer=observe,
            context=replace(context, progress=progress),
        )  # fmt: skip
    except HyrfError as error:  # the fix of this error refers to the command `train`
        plain = without_resume_hint(error)
        if resume and not begun and isinstance(plain, HyrfTrainingError):  # the checkpoint cannot be used
            plain = plain.with_text(fix=f"delete {run} and run the same command again")
        raise plain from None
    if not trained.complete:
        raise Stopped("training", write_preview(stage_cache, shown[0], context) if shown else None)
    if not (run / METRICS_FILE).is_file():  # the disk was full; the next call writes them
        raise HyrfError(trained.missing, fix="run the same command again, which writes what is missing")


def _read_training_facts(run: Path, config: TrainConfig) -> dict[str, Any]:
    """Return the facts of a finished training run: its Gaussians, bytes, decisions, device, steps, PSNR and target."""
    metrics = json.loads((run / METRICS_FILE).read_bytes())
    provenance = describe_file(run / MODEL_FILE)["provenance"]
    return {
        **{name: metrics[name] for name in ("gaussians", "bytes", "choices", "device")},
        **{name: provenance[name] for name in ("steps", "psnr")},
        "target_bytes": config.target_bytes,
    }


def trained_target_bytes(stage_cache: StageCache) -> int | None:
    """Return the target size in bytes with which the training in a work folder was begun; None if there was none."""
    return stage_cache.state.fixed("training").get("target_bytes")


def _is_run_finished(run: Path) -> bool:
    """Return whether a run is finished even if its record does not say so; `metrics.json` is written last."""
    return (run / METRICS_FILE).is_file() and (run / MODEL_FILE).is_file() and not (run / CHECKPOINT_FILE).exists()


def _split_inputs(scene: Scene) -> dict[str, Any]:
    """Return the inputs that identify the held-out photos and the sizes of all photos."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in scene.views})
    return {"held-out photos": [view.name for view in scene.test], "size of photos": sizes}


class _TrainingProgress:
    """Reports the parts of a training run: pilot runs, teacher runs, steps, then scores and pictures."""

    def __init__(self, reporter: Reporter) -> None:
        self._reporter, self._part, self._means = reporter, "pilots", StepMeans()

    def report_event(self, event: Event) -> None:
        """Report an event of `hyrfpack.train_model`."""
        if isinstance(event, StepEvent):
            self._begin("training")
            self._means.add(event)
            quality = () if self._means.mse is None else (format_psnr(self._means.mse),)
            self._reporter.update(
                event.share_done,
                f"step {event.step}/{event.steps}",
                *quality,
                format_count(event.gaussians, "Gaussian"),
            )
            if event.step == event.steps:
                self._begin("results")
        elif isinstance(event, TaskEvent):
            if event.task.startswith(TEACHER_TASK_PREFIX):
                self._begin("teachers")
            if self._part == "results" and event.total:
                event = replace(event, share=event.done / event.total)
            self._reporter.report_event(event)

    def _begin(self, part: str) -> None:
        if part != self._part:  # each part has a pace of its own
            self._part = part
            self._reporter.begin_part(part)


# -- packing -------------------------------------------------------------------------------------------------------


def run_compression_stage(stage_cache: StageCache, scene: Scene, plan: Plan, context: RunContext) -> dict[str, Any]:
    """Write the compressed model to `model.hyrf`; return its bytes, its Gaussians and the result of the search."""

    def execute(resuming: bool) -> tuple[dict, list[str]]:
        source, target = stage_cache.folder / RUN_FOLDER / MODEL_FILE, stage_cache.folder / PACKED_MODEL
        try:
            config = CompressConfig(finetune_steps=plan.finetune_steps or None, target_bytes=plan.target_bytes)
            report = compress_model(source, target, config, data=scene, context=context)
        except KeyboardInterrupt as error:
            raise Stopped("compression", source) from error
        except HyrfSizeError as error:
            fix = f"ask for {error.min_bytes:,} bytes or more (`target_bytes`)"
            if trained_target_bytes(stage_cache) != plan.target_bytes:
                fix += ", or name another work folder (`work`) to train a smaller model for this size"
            raise HyrfError(f"the trained model does not fit into {plan.target_bytes:,} bytes", fix=fix) from error
        return {"bytes": report.bytes_after, "gaussians": report.gaussians, "found": report.found}, [PACKED_MODEL]

    cameras = "photos" if plan.finetune_steps else "cameras"  # only fine-tuning reads the photos themselves
    inputs = {
        "model": file_digest(stage_cache.folder / RUN_FOLDER / MODEL_FILE),
        cameras: stage_cache.state.inputs("training")["photos and poses"],
        "finetune": plan.finetune_steps,
        "target size": plan.target_bytes,
    }
    return stage_cache.run_stage("compression", inputs, execute)


def run_import_stage(
    stage_cache: StageCache, source: Path, psnr: float, seed: int, context: RunContext
) -> dict[str, Any]:
    """Import splats of another program as `model.hyrf`; return the report of `hyrfpack.import_splats`."""
    config = ImportConfig(psnr=psnr, seed=seed)

    def execute(resuming: bool) -> tuple[dict, list[str]]:
        report = import_splats(
            source,
            stage_cache.folder / PACKED_MODEL,
            config,
            context=context,
        )
        if round(report.psnr, 1) < round(psnr, 1):
            _LOG.warning(f"the target PSNR of the import is {psnr:g} dB, but the file reaches {report.psnr:.1f} dB")
        return report.to_dict(), [PACKED_MODEL]

    inputs = {"splats": files_digest(list_source_files(source), source.parent), "settings": asdict(config)}
    return stage_cache.run_stage("import", inputs, execute)


# -- writing and scoring -------------------------------------------------------------------------------------------


def run_export_stage(
    stage_cache: StageCache, model: Path, name: str, scene: Scene | None, *, is_player: bool
) -> tuple[dict[str, Any], Path]:
    """Export a model as `export/NAME`, a file or a player; return the report of the export and the path."""
    target = stage_cache.folder / EXPORT_FOLDER / name

    def execute(resuming: bool) -> tuple[dict, list[str]]:
        if name.lower().endswith(".hyrf"):
            copy_if_different(model, target)
            report: dict[str, Any] = {"bytes": target.stat().st_size}
        else:
            context = RunContext(progress=stage_cache.reporter.report_event)
            if is_player:  # a name with a dot names a player only if it is a folder
                target.mkdir(parents=True, exist_ok=True)
            # A player is named after its source by default, and that is model.hyrf in every work folder.
            config = ExportConfig(title=name if is_player else None)
            exported = export_model(model, target, config, data=scene, context=context)
            report = {**asdict(exported), "file": name, "chosen_by": {}}
        files = sorted(target.rglob("*")) if target.is_dir() else [target]
        return report, [path.relative_to(stage_cache.folder).as_posix() for path in files if path.is_file()]

    inputs: dict[str, Any] = {"model": file_digest(model), "name": name}
    if scene is not None:
        inputs |= {"photos and poses": stage_cache.state.inputs("training")["photos and poses"], **_split_inputs(scene)}
    return stage_cache.run_stage("export", inputs, execute), target


def run_scoring_stage(stage_cache: StageCache, scene: Scene, device: torch.device) -> dict[str, Any]:
    """Score `model.hyrf` on held-out photos; return the mean scores and the number of photos."""
    model = stage_cache.folder / PACKED_MODEL

    def execute(resuming: bool) -> tuple[dict, list[str]]:
        if not scene.test:
            return {"views": 0}, []
        scores = evaluate_model(load_model(model, device), scene.test, progress=stage_cache.reporter.report_event)
        means = {name: getattr(scores, name) for name in ("psnr", "psnr_consistent", "ssim")}
        return {"views": len(scores.views), **means}, []

    inputs = {
        "model": file_digest(model),
        "photos": stage_cache.state.inputs("training")["photos and poses"],
        **_split_inputs(scene),
    }
    return stage_cache.run_stage("scoring", inputs, execute)


def copy_to_output(product: Path, output: Path, *, overwrite: bool) -> Path:
    """Copy the product, a file or a folder that this call has locked, to the output.

    Args:
        product: file or folder in the work folder.
        output: path of the copy.
        overwrite: replace existing files. Without it, a file gets a free name beside an existing one. For a folder, an
            existing file is an error, because its files refer to each other by name.

    Returns:
        The path of the copy.

    Raises:
        HyrfError: the product cannot be copied; it stays in the work folder.
    """
    if not product.is_dir():
        return copy_if_different(product, output, overwrite=overwrite)
    files = {path: output / path.relative_to(product) for path in sorted(product.rglob("*")) if path.is_file()}
    different = [target for path, target in files.items() if file_digest(path) != file_digest(target)]
    # The rules of Outputs would take the poster of an unfinished copy for a photo of the user.
    is_begun = len(different) < len(files)
    if not is_begun or any(map(os.path.lexists, different)):
        Outputs(overwrite=overwrite).folder(output, [os.path.relpath(target, output) for target in different])
    for path, target in files.items():
        copy_if_different(path, target, overwrite=overwrite, rename=False)
    return output


def copy_if_different(source: Path, target: Path, *, overwrite: bool = True, rename: bool = True) -> Path:
    """Copy a file in one step, unless the target has the same content; see `hyrfpack.atomic.pending_file`.

    Returns:
        The path of the copy.
    """
    if file_digest(source) == file_digest(target):
        return target
    with pending_file(target, source.stat().st_size, overwrite=overwrite, rename=rename) as pending:
        copy_file(source, pending.temporary)
    return pending.path
