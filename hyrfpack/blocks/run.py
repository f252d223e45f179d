"""Do a complete training run in blocks: divide the scene, train each block, and merge the results."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.blocks.cells import ground_axes, ground_extent
from hyrfpack.blocks.journal import Journal, is_begun, open_journal, read_grid
from hyrfpack.blocks.merge import merge_blocks
from hyrfpack.blocks.plan import MIN_BLOCK_PHOTOS, Block, BlockPlan, parse_grid, plan_blocks
from hyrfpack.checks import check_type
from hyrfpack.config.train import TrainConfig
from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.data.cache import memory_bytes
from hyrfpack.data.preset import detect_preset
from hyrfpack.device import describe_device
from hyrfpack.errors import HyrfError, HyrfFormatError, HyrfTrainingError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format.parts import load_model_or_parts
from hyrfpack.format.run_folder import BLOCKS_FOLDER, CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.format.sections import MAX_PARTS
from hyrfpack.lock import exclusive_folder, try_lock
from hyrfpack.model.merged import parts_of
from hyrfpack.outputs import Outputs
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Progress, TaskEvent, items_of_progress
from hyrfpack.scene import Scene
from hyrfpack.train.checkpoint import names_and_sizes, saved_decisions
from hyrfpack.train.checks import check_outputs, check_photos
from hyrfpack.train.decisions import measures_budget, measures_exposure
from hyrfpack.train.distributed import check_settings
from hyrfpack.train.finish import TrainResult
from hyrfpack.train.results import VIEWS_FOLDER, remove_results, scene_facts
from hyrfpack.train.run import Observer, resuming, train_model, without_resume_hint
from hyrfpack.train.setup import PACKED_HEADER_BYTES, budget_for, check_target
from hyrfpack.train.stop import catch_stop_signals
from hyrfpack.version import __version__

_LOG = logging.getLogger(__name__)

# "auto" makes at least one block for so many photos. Blocks share photos, so one may have more.
PHOTOS_PER_BLOCK = 500
# Peak memory of training: 1,260 bytes for each Gaussian, of which there are up to two for each one of the budget.
BYTES_PER_BUDGETED_GAUSSIAN = 2_500
# Gaussians take at most this ratio of the device's memory; photos and the pixels of one view take the rest.
MAX_MEMORY_RATIO = 0.5
POLL_SECONDS = 1.0  # A process without a block looks for one this often.


def block_log_path(log: Path, block: Block) -> Path:
    """Return the path of a block's log, which has the block's name in its own."""
    return log.with_stem(f"{log.stem}-{block.name}")


def train_blocks(
    scene: Scene,
    out: Path | str,
    config: TrainConfig | None = None,
    blocks: str = "auto",
    *,
    resume: bool = False,
    overwrite: bool = False,
    observer: Observer | None = None,
    log: Path | str | None = None,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> TrainResult:
    """Train a large scene in blocks and write them as one merged file.

    The ground is divided into cells. Each block trains on all photos that show its cell, as a run of its own in
    `blocks/`, and keeps the Gaussians in its cell. Blocks train one after the other, or side by side in several
    processes. The folder gets `model.hyrf` (a merged file of profile raw, a part for each block), `metrics.json` and
    `views/`, as by `train_model`. A process trains one block at a time.

    Args:
        scene: the scene, from `hyrfpack.load_scene`.
        out: the run's folder, created if missing.
        config: settings of the run; None for the defaults. `steps` are those of each block. `max_gaussians` and
            `target_bytes` are divided among the blocks by their points, some of which several blocks count, so the
            merged file may hold somewhat more. The pilot runs of the block with the most photos decide `exposure` and
            `budget_factor` for all.
        blocks: columns x rows of the grid, such as "2x2"; columns follow each other along the longer side of the
            scene. "auto" takes as many as memory and photos ask for. A single block is a run of `train_model`.
        resume: resume an interrupted run; blocks that are finished are kept.
        overwrite: replace an earlier run in the folder.
        observer: see `hyrfpack.train_model`.
        log: see `hyrfpack.train_model`. The log of a block has its name in the name of the file.
        context: device, processes, progress and stop, see `hyrfpack.train_model`. Several processes train one block
            each at a time, and need a common file system. Only rank 0 merges and returns metrics, and the model
            exists only when it has returned. If the launcher
            restarts the processes, they resume.

    Raises:
        HyrfError: the grid does not suit the scene, or an error of `train_model`, which names the block.
        TypeError: `scene` is no Scene or `config` no TrainConfig.

    Example:
        >>> import hyrfpack
        >>> scene = hyrfpack.load_scene("photos/bonsai")
        >>> quiet = hyrfpack.RunContext(progress=None)
        >>> result = hyrfpack.train_blocks(scene, "runs/blocks", hyrfpack.TrainConfig(steps=5), "2x1", context=quiet)
        >>> result.complete, result.step, [block["name"] for block in result.metrics["blocks"]]
        (True, 10, ['1-1', '2-1'])
    """
    check_type("scene", scene, Scene)
    out = Path(out)
    config = TrainConfig() if config is None else config
    check_type("config", config, TrainConfig)
    device = context.choose_device()
    check_target(scene, config)
    ranks = context.ranks or SINGLE_PROCESS
    _check_processes(ranks, scene, config, blocks)
    # This check ignores existing results. It runs first, so that no folder is created where nothing may be written.
    ranks.run_on_main(lambda: check_outputs(out, scene, overwrite=True))
    may_resume = resume or ranks.restarts > 0
    if blocks == "auto":
        # Machines may differ in their memory, but all processes need the same grid, and a resumed run keeps its own.
        kept = ranks.run_on_main(lambda: read_grid(out) if may_resume and is_begun(out) else None)
        blocks = kept or ranks.broadcast("{}x{}".format(*choose_grid(scene, config, device, ranks)))
    columns, rows = parse_grid(blocks)
    if columns * rows == 1:
        return train_model(
            scene, out, config, resume=resume, overwrite=overwrite, observer=observer, log=log, context=context
        )
    if config.preset == "auto":
        config = dataclasses.replace(config, preset=detect_preset(scene)[0])
    plan = plan_blocks(scene, columns, rows)
    check_settings(ranks, {f"photos of block {block.name}": names_and_sizes(block.photos) for block in plan.blocks})
    with exclusive_folder(out, ranks=ranks):
        resume = ranks.broadcast(resume or (ranks.restarts > 0 and is_begun(out)))
        cache = context.cache or PictureCache(memory_bytes() // 4 // ranks.local_size)

        def begin() -> Journal:
            journal = open_journal(out, f"{columns}x{rows}", plan, config, resume=resume, overwrite=overwrite)
            if ranks.is_main:
                check_outputs(out, scene, overwrite=resume or overwrite)
                if log is not None:
                    logs = Outputs(scene=scene, overwrite=resume or overwrite)
                    for block in plan.blocks:
                        logs.file(block_log_path(Path(log), block))
                with context.open_progress("blocks", interruptible=False) as progress:
                    check_photos(scene, cache, progress)
            return journal

        journal = ranks.run_on_all(begin)
        ranks.run_on_all(lambda: journal.start() if ranks.is_main and not resume else None)
        return _BlockRun(
            scene=scene,
            out=out,
            config=config,
            plan=plan,
            journal=journal,
            resume=resume,
            overwrite=overwrite,
            observer=observer,
            log=None if log is None else Path(log),
            context=dataclasses.replace(context, device=device, cache=cache),
            device=device,
            ranks=ranks,
        ).execute()


def _check_processes(ranks: Ranks, scene: Scene, config: TrainConfig, blocks: str) -> None:
    """Raise HyrfTrainingError unless all processes were started with the same settings, photos and versions."""
    versions = {"versions": (__version__, torch.__version__)}
    check_settings(ranks, {"blocks": blocks, **config.to_dict(), "photos": names_and_sizes(scene.views), **versions})


def choose_grid(scene: Scene, config: TrainConfig, device: torch.device, ranks: Ranks) -> tuple[int, int]:
    """Return columns and rows of about square cells, at least as many as memory and photos ask for.

    A cell has at least MIN_BLOCK_PHOTOS photos in the mean, and there are at most MAX_PARTS.
    """
    if device.type == "cuda":
        memory = torch.cuda.get_device_properties(device).total_memory
    else:
        memory = memory_bytes() // ranks.local_size
    budget, _ = budget_for(scene, config)
    needed_blocks = max(
        budget * BYTES_PER_BUDGETED_GAUSSIAN / (MAX_MEMORY_RATIO * memory), len(scene.train) / PHOTOS_PER_BLOCK
    )
    max_blocks = max(1, min(MAX_PARTS, len(scene.train) // MIN_BLOCK_PHOTOS))
    count = max(1, min(math.ceil(needed_blocks), max_blocks))
    along, across = ground_extent(scene, ground_axes(scene)).tolist()
    rows = min(count, max(1, round(math.sqrt(count * across / along)))) if along > 0 else 1
    while rows * math.ceil(count / rows) > max_blocks:
        rows -= 1
    return math.ceil(count / rows), rows


@dataclasses.dataclass(frozen=True)
class _BlockRun:
    """One call of `train_blocks`, in a folder that it has locked."""

    scene: Scene
    out: Path
    config: TrainConfig
    plan: BlockPlan
    journal: Journal
    resume: bool
    overwrite: bool
    observer: Observer | None
    log: Path | None
    context: RunContext
    device: torch.device
    ranks: Ranks

    def execute(self) -> TrainResult:
        """Train blocks until all are finished, and merge them in the main process."""
        steps = 0
        while waiting := [block for block in self.plan.blocks if not self.journal.is_finished(block.name)]:
            trained = False
            for block in waiting:
                with self._claim(block) as is_mine:
                    config = self._block_config(block) if is_mine else None
                    if config is None or self.journal.is_finished(block.name):
                        continue
                    with catch_stop_signals(self.context.stop) as stop:
                        result = self._train_block(block, config, stop)
                steps, trained = steps + result.step, True
                is_left = any(not self.journal.is_finished(other.name) for other in self.plan.blocks)
                if not result.complete or (is_left and stop()):  # A signal in the last step lets the block finish.
                    return TrainResult(False, steps, None, {})
            # Other processes are training what is left, or deciding its settings. If one of them ends, its claim ends.
            if not trained:
                if self.context.stop is not None and self.context.stop():
                    return TrainResult(False, steps, None, {})
                time.sleep(POLL_SECONDS)
        if not self.ranks.is_main:
            return TrainResult(True, steps, self.out / MODEL_FILE, {})
        metrics = [self._read_metrics(block) for block in self.plan.blocks]
        try:
            with self.context.open_progress("blocks", interruptible=False) as progress:
                return self._merge(metrics, progress, overwrite=self.resume or self.overwrite)
        except HyrfError as error:
            if isinstance(error, HyrfTrainingError | HyrfFormatError):  # merging again would fail in the same way
                raise
            kept = f"the trained blocks are kept, {resuming(self.overwrite)} merges them"
            raise error.with_text(fix=f"{error.fix}; {kept}") from error

    def _claim(self, block: Block) -> AbstractContextManager[bool]:
        """Keep other processes from training a block in a `with` block, whose value is False if one is at it."""
        if self.ranks.is_single:
            return nullcontext(True)
        return try_lock(self.journal.path.parent / f"{block.name}.lock")

    def _train_block(self, block: Block, config: TrainConfig, stop: Callable[[], bool]) -> TrainResult:
        """Train a block, or resume it if its training has begun; `stop` returns whether to stop."""
        label = f"block {block.name} ({self.plan.blocks.index(block) + 1} of {len(self.plan.blocks)})"
        _LOG.info(f"{label}: {len(block.photos)} photos, {block.point_count:,} points")
        resumes = self.journal.is_begun(block.name)
        is_silent = self.context.progress == "auto" and not self.context.is_shown
        try:
            result = train_model(
                block.cut(self.scene),
                self.journal.folder(block.name),
                config,
                resume=resumes,
                overwrite=not resumes,
                observer=self.observer if self.ranks.is_main else None,
                log=None if self.log is None else block_log_path(self.log, block),
                context=dataclasses.replace(
                    self.context, ranks=None, progress=None if is_silent else self.context.progress, stop=stop
                ),
            )
            if result.missing:
                raise HyrfError(result.missing, fix="free space on the disk")
        except HyrfError as error:
            kept = f"finished blocks are kept, {resuming(self.overwrite)} continues"
            plain = without_resume_hint(error)  # A run without blocks is resumed in another way.
            raise plain.with_text(f"{label}: {plain.problem}", f"{plain.fix}; {kept}") from error
        return result

    def _block_config(self, block: Block) -> TrainConfig | None:
        """Return the settings of a block; None if the first block has not written what it decided yet.

        A total budget is shared out by the points that photos of blocks show. The pilot runs of the first block decide
        for all blocks.
        """
        config, first = self.config, self.plan.blocks[0]
        if config.max_gaussians is not None or config.target_bytes is not None:
            total, _ = budget_for(self.scene, config, len(self.plan.blocks) * PACKED_HEADER_BYTES)
            budget = max(1, round(total * block.point_count / len(self.scene.points)))
            config = dataclasses.replace(config, max_gaussians=budget, target_bytes=None)
        if block is first:
            return config
        scene = first.cut(self.scene)
        if not (measures_exposure(scene, config) or measures_budget(scene, config)):
            return config
        if self.journal.is_finished(first.name):
            settings = self._read_metrics(first)["settings"]
            exposure, factor = settings["exposure"], settings["budget_factor"]
        elif (checkpoint := self.journal.folder(first.name) / CHECKPOINT_FILE).is_file():
            saved = saved_decisions(checkpoint)
            exposure, factor = saved.exposure, saved.budget_factor
        else:
            return None
        config = dataclasses.replace(config, exposure=exposure)
        return config if config.max_gaussians is not None else dataclasses.replace(config, budget_factor=factor)

    def _read_metrics(self, block: Block) -> dict:
        """Read the metrics of a finished block."""
        path = self.journal.folder(block.name) / METRICS_FILE
        try:
            metrics = json.loads(path.read_bytes())
            _check_metrics(metrics)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise HyrfError(
                f"{path}: the results of a finished block are missing or damaged",
                fix="train anew with `overwrite=True`",
            ) from error
        return metrics

    def _merge(self, metrics: list[dict], progress: Progress, *, overwrite: bool) -> TrainResult:
        """Merge the models of all blocks, score the result on the held-out photos, and write `metrics.json`.

        Args:
            metrics: the content of the `metrics.json` of each block.
        """
        progress(TaskEvent("merging blocks"))
        models = [self.journal.folder(block.name) / MODEL_FILE for block in self.plan.blocks]
        gains = [{name: np.array(gain) for name, gain in each["log_gains"].items()} for each in metrics]
        target = self.out / MODEL_FILE
        merged = merge_blocks(self.scene, self.plan, models, gains, target, overwrite=overwrite)
        if overwrite:
            remove_results(self.out, self.scene)
        content = self._describe(metrics, merged.kept, merged.file.bytes_after)
        unwritten: list[str] = []
        if self.scene.test:
            model = load_model_or_parts(merged.file.file)
            for part in parts_of(model):
                part.to(self.device)
                part.precision = self.config.precision
            scores = evaluate_model(
                model,
                self.scene.test,
                pictures=self.out / VIEWS_FOLDER,
                overwrite=overwrite,
                progress=items_of_progress(progress, "scoring held-out photos", len(self.scene.test)),
                unwritten=unwritten,
            )
            content["evaluation"] = scores.to_dict()
        write_atomic(self.out / METRICS_FILE, json.dumps(content, indent=1).encode(), overwrite=overwrite)
        missing = f"{unwritten[0]}; the model is finished, but {VIEWS_FOLDER} is missing" if unwritten else ""
        if missing:
            _LOG.warning(missing)
        return TrainResult(True, content["curve"][-1]["step"], Path(merged.file.file), content, missing)

    def _describe(self, metrics: list[dict], kept: list[int], size: int) -> dict[str, Any]:
        """Return the content of the run's `metrics.json` without scores: sums over the blocks."""
        seconds = sum(each["seconds"] for each in metrics)
        stages: Counter[str] = Counter()
        curve: list[dict] = []
        for each in metrics:
            stages.update(each["stage_seconds"])
            before = curve[-1] if curve else {"step": 0, "seconds": 0.0}
            curve += [
                {**record, "step": before["step"] + record["step"], "seconds": before["seconds"] + record["seconds"]}
                for record in each["curve"]
            ]
        grid = self.journal.settings["blocks"]
        return {
            "settings": self.config.to_dict(),
            "device": describe_device(self.device),
            "processes": self.ranks.size,
            "scene": scene_facts(self.scene),
            "choices": {"blocks": f"{grid}: {len(self.plan.blocks)} blocks"},
            "notes": self.scene.notes,
            "gaussians": sum(kept),
            "bytes": size,
            "seconds": seconds,
            "steps_per_second": curve[-1]["step"] / max(seconds, 1e-9),
            "stage_seconds": dict(sorted(stages.items())),
            "curve": curve,
            "blocks": [
                {
                    "name": block.name,
                    "folder": f"{BLOCKS_FOLDER}/{block.name}",
                    "photos": len(block.photos),
                    "points": block.point_count,
                    "gaussians": each["gaussians"],
                    "kept": count,
                    "seconds": each["seconds"],
                }
                for block, each, count in zip(self.plan.blocks, metrics, kept, strict=True)
            ],
        }


def _check_metrics(metrics: dict[str, Any]) -> None:
    """Check what the results of all blocks are put together from; a file of them may be damaged.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: a value is missing, or is of another type.
    """
    settings, curve, gains = metrics["settings"], metrics["curve"], metrics["log_gains"]
    numbers = [metrics["seconds"], metrics["gaussians"], *metrics["stage_seconds"].values()]
    numbers += [record[name] for record in curve for name in ("step", "seconds")]
    numbers += [] if settings["budget_factor"] is None else [settings["budget_factor"]]
    numbers += [value for gain in gains.values() for value in gain]
    if not (
        curve
        and type(settings["exposure"]) is bool
        and all(type(number) in (int, float) for number in numbers)
        and all(len(gain) == 3 for gain in gains.values())
    ):
        raise ValueError("a value has another type")
