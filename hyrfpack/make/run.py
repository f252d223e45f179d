"""Make a scene from photos: check the request, then run the stages one after the other."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import Any

from hyrfpack.checks import check_type
from hyrfpack.config.make import MakeConfig
from hyrfpack.config.poses import PosesConfig
from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.data.folder import first_readable_photo, list_photos
from hyrfpack.format import describe_file
from hyrfpack.lock import exclusive_folder
from hyrfpack.make import stages
from hyrfpack.make.held_out import score_note
from hyrfpack.make.minutes import fit_plan_to_minutes
from hyrfpack.make.plan import (
    ASSUMED_VIDEO_PHOTOS,
    Plan,
    estimate_photos_seconds,
    estimate_scene_seconds,
    expected_photo_size,
    requested_quality,
)
from hyrfpack.make.preview import remove_preview
from hyrfpack.make.progress import Reporter
from hyrfpack.make.request import Request, default_work_folder
from hyrfpack.make.source import LoadSettings, Source
from hyrfpack.make.stage_cache import StageCache, Stopped, interruptible
from hyrfpack.make.state import files_digest
from hyrfpack.outputs import StrPath
from hyrfpack.progress import Progress
from hyrfpack.scene import Scene
from hyrfpack.train import Trainer
from hyrfpack.train.resolution import PhotoSize

_LOG = logging.getLogger(__name__)

MEASUREMENT_TIME_RATIO = 0.15  # probes and pilot runs take about this ratio of the remaining time

__all__ = ["MakeResult", "Stopped", "make_scene"]


@dataclass(frozen=True)
class MakeResult:
    """Result of `make`.

    Attributes:
        output: the file or folder that was written.
        bytes: size of the output in bytes.
        gaussians: number of Gaussians of the scene.
        model: the packed model in the work folder; if the source was a model, that model.
        work: the work folder, which holds the products of all stages.
        views: number of held-out photos on which the model was scored.
        psnr, ssim: mean scores of these photos; None if there were none.
        psnr_consistent: mean PSNR at the consistent exposure (`hyrfpack.Evaluation`); None without scores or without an
            exposure map.
        poses: report of `hyrfpack.estimate_poses`; empty if the photos had poses.
        training: steps, Gaussians, bytes and decisions of the training; empty if there was none.
        export: report of `hyrfpack.export_model`; for splats, it has that of `hyrfpack.import_splats` under "import".
        seconds: time of each stage in all calls together, interrupted and killed ones included.
        total_seconds: sum of these times.
        kept: names of stages whose products of an earlier call were reused.
        note: reason why the score says little about the scene; empty if it is meaningful or there is no score.
    """

    output: Path
    bytes: int
    gaussians: int
    model: Path
    work: Path
    views: int = 0
    psnr: float | None = None
    psnr_consistent: float | None = None
    ssim: float | None = None
    poses: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    export: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    total_seconds: float = 0.0
    kept: tuple[str, ...] = ()
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain numbers, strings, lists and dictionaries, ready for JSON."""
        return {**asdict(self), "output": str(self.output), "model": str(self.model), "work": str(self.work)}


def make_scene(
    photos: StrPath,
    output: StrPath,
    config: MakeConfig | None = None,
    *,
    work: StrPath | None = None,
    overwrite: bool = False,
    observer: Callable[[Trainer], None] | None = None,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> MakeResult:
    """Make a scene from photos: estimate missing poses, train, compress, score on held-out photos, and export.

    The product of each stage is kept in a work folder with a record of its inputs. The same call resumes an interrupted
    or killed one, and on a CPU writes the same bytes as an uninterrupted call. After a change of photos or settings,
    only the stages that depend on them run again.

    Args:
        photos: a folder of photos without poses, any path that `load_scene` reads, a video, a file of splats of
            another program (see `hyrfpack.import_splats`), or a `.hyrf` file to export.
        output: path of the output, whose ending selects the format (".hyrf", or one of `hyrfpack.export_model`, except
            ".json").
        config: settings; None for the defaults.
        work: the work folder. None puts it beside the output, with the output's name and the ending ".work".
        overwrite: replace an existing output. Without it, an output that appears during the call is also kept. A file
            then gets a free name beside it, which the result reports; a folder is an error.
        observer: observer of the training, see `hyrfpack.train_model`. With an observer, photos without poses get a
            coarse first look before their poses are estimated: a short training on small copies of them.
        context: device for training and packing, progress (`StageEvent`s), cache and stop; this process does all work.

    Returns:
        The output, the scores, and the reports of the stages.

    Raises:
        HyrfError: the source cannot be used, the output may not or cannot be written, or options exclude each other;
            all this is checked before any work. Or a stage fails; products of finished stages are kept.
        Stopped: the call was interrupted; a KeyboardInterrupt that names the stage.

    Example:
        >>> import hyrfpack
        >>> result = hyrfpack.make_scene("bonsai.hyrf", "made/bonsai.html")
        >>> result.output.name, result.bytes > 0, sorted(path.name for path in result.work.iterdir())
        ('bonsai.html', True, ['export', 'make.json'])
    """
    observing = None if observer is None else nullcontext(observer)
    return make_observed_scene(
        photos, output, config, work=work, overwrite=overwrite, observing=observing, context=context
    )


def make_observed_scene(
    photos: StrPath,
    output: StrPath,
    config: MakeConfig | None = None,
    *,
    work: StrPath | None = None,
    overwrite: bool = False,
    observing: AbstractContextManager[Callable[[Trainer], None] | None] | None = None,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> MakeResult:
    """Make a scene like `make_scene`, with an observer that exists only while the stages run.

    The context `observing` is entered after all arguments are checked, and yields the observer; None for no observer.
    The other arguments, the result and the errors are those of `make_scene`.
    """
    config = MakeConfig() if config is None else config
    check_type("config", config, MakeConfig)
    start_seconds = monotonic()
    pipeline: _Pipeline | None = None
    max_size = requested_quality(config).max_size if config.max_size is None else config.max_size
    load_settings = LoadSettings(config.images, max_size, config.test_every)
    with interruptible():
        try:
            request = Request(
                source=Source.from_path(photos, load_settings),
                output=Path(output),
                work=default_work_folder(Path(output)) if work is None else Path(work),
                load_settings=load_settings,
                config=config,
                device=context.choose_device(),
                overwrite=overwrite,
                is_observed=observing is not None,
            )
            request.check()
            with (
                exclusive_folder(request.work, "another folder with `work`"),
                exclusive_folder(request.output) if request.is_output_folder else nullcontext(),
                observing or nullcontext() as observer,
            ):
                with context.open_progress(interruptible=False) as progress:
                    pipeline = _Pipeline(request, observer, start_seconds, context, progress)
                    return pipeline.run()
        except Stopped:
            raise
        except KeyboardInterrupt as error:  # outside of a stage, or the second one
            stop = _find_stopped(error)
            if stop is not None:
                raise stop from error
            raise Stopped("preparation" if pipeline is None else pipeline.stage_cache.stage) from error


def _find_stopped(error: BaseException) -> Stopped | None:
    """Return the `Stopped` during whose handling an interrupt came, as while files were closed; None if there is none.

    It names the interrupted stage and its preview, which the second interrupt does not know.
    """
    context = error.__context__
    while context is not None and not isinstance(context, Stopped):
        context = context.__context__
    return context


class _Pipeline:
    """Runs the stages of one call of `make`."""

    def __init__(
        self,
        request: Request,
        observer: Callable[[Trainer], None] | None,
        start_seconds: float,
        context: RunContext,
        progress: Progress,
    ) -> None:
        """Prepare the stages.

        Args:
            request: the checked arguments of the call.
            observer: observer of the training.
            start_seconds: start of the call by the monotonic clock.
            context: context of the call.
            progress: function that gets the progress of all stages.
        """
        self.request = request
        self.observer = observer
        self.source = request.source
        self.start_seconds = start_seconds
        self.reporter = Reporter(request.stages, progress, context.stop)
        self.owns_cache = context.cache is None
        self.cache = context.cache or PictureCache()
        self.context = replace(context, device=request.device, progress=self.reporter.report_event, cache=self.cache)
        self.stage_cache = StageCache(request.work, self.reporter, request.check_replacing)

    def run(self) -> MakeResult:
        """Run all stages that the source needs.

        Raises:
            Stopped: a stage was interrupted.
        """
        kind = self.source.kind
        if kind == "model":
            return self._finish(self.source.path, scene=None)
        if kind == "splats":
            config = self.request.config
            target = requested_quality(config).import_psnr
            facts = stages.run_import_stage(self.stage_cache, self.source.path, target, config.seed, self.context)
            return self._finish(self.stage_cache.folder / stages.PACKED_MODEL, scene=None, imported=facts)
        return self._make_from_photos()

    def _make_from_photos(self) -> MakeResult:
        """Run all stages for photos with or without poses."""
        request, stage_cache, poses = self.request, self.stage_cache, {}
        path, load_settings, scene = self.source.path, request.load_settings, self.source.scene
        if scene is None:
            poses = self._estimate_poses()
            path = stage_cache.folder / stages.SCENE_FOLDER
            load_settings = replace(load_settings, images=None)
            scene = load_settings.load(path)
        else:
            for sentence in scene.notes:
                _LOG.info(sentence)
        plan, scene = self._decide_plan(path, load_settings, scene)
        if request.config.minutes is None or "measurement" in stage_cache.kept:
            self.reporter.estimates |= estimate_scene_seconds(scene, plan, request.device)
        training = stages.run_training_stage(
            stage_cache, scene, self._scene_digest(scene), plan, request.config.seed, self.observer, self.context
        )
        remove_preview(stage_cache)
        if self.owns_cache:
            self.cache.clear()  # compression needs the memory more than the photos
        stages.run_compression_stage(stage_cache, scene, plan, self.context)
        return self._finish(stage_cache.folder / stages.PACKED_MODEL, scene, poses=poses, training=training)

    def _estimate_poses(self) -> dict[str, Any]:
        """Estimate the poses of photos or of a video; return the report of the estimation."""
        request, source = self.request, self.source
        photos = list_photos(source.path) if source.kind == "photos" else []
        facts = first_readable_photo(photos)
        size = expected_photo_size(facts.size if facts else None, request.load_settings.max_size)
        plan, count = self._requested_plan(size), len(photos) or ASSUMED_VIDEO_PHOTOS
        estimates = estimate_photos_seconds(count, size, plan, request.device)
        if request.config.minutes is not None:
            left = 60 * request.config.minutes - estimates["poses"]
            estimates = {"poses": estimates["poses"], "training": max(0.0, left)}
        self.reporter.estimates |= estimates
        if source.archive is not None:
            _LOG.info(f"{source.archive.name} was unpacked into {source.path} and is reused from there")
        config = PosesConfig(request.config.matching, request.config.seed)
        return stages.run_pose_stage(self.stage_cache, source.path, source.files(), config, self.observer, self.context)

    def _scene_digest(self, scene: Scene) -> str:
        """Return the digest of all files of a scene; for an archive, that of its unpacked files."""
        return files_digest((file for file in scene.files if Path(file) != self.source.path), Path(scene.path))

    def _requested_plan(self, size: PhotoSize) -> Plan:
        """Return the plan that the quality and the other arguments request for photos of this size."""
        request, quality = self.request, requested_quality(self.request.config)
        return Plan(
            quality.training_steps(size.pixels, request.device),
            request.load_settings.max_size,
            quality.finetune_steps,
            request.config.target_bytes,
            request.config.max_gaussians,
            request.config.preset,
        )

    def _decide_plan(self, path: Path, load_settings: LoadSettings, scene: Scene) -> tuple[Plan, Scene]:
        """Return the plan, which fits into a time limit if there is one, and the scene at the plan's size of photos."""
        request, requested = self.request, self._requested_plan(PhotoSize.of_views(scene.train))
        if request.config.minutes is None:
            return requested, scene
        end = self.start_seconds + 60 * request.config.minutes
        left = max(0.0, end - monotonic())
        measurement_seconds = MEASUREMENT_TIME_RATIO * left
        self.reporter.estimates |= {"measurement": measurement_seconds, "training": left - measurement_seconds}

        def execute(resuming: bool) -> tuple[dict[str, Any], list[str]]:
            plan = fit_plan_to_minutes(
                path,
                load_settings,
                scene,
                replace(requested, finetune_steps=0),
                request.device,
                end,
                request.config.seed,
                self.cache,
                self.reporter,
            )
            return asdict(plan), []

        inputs = {
            "photos and poses": self._scene_digest(scene),
            "minutes": request.config.minutes,
            "size of photos": load_settings.max_size,
            "seed": request.config.seed,
            "target size": request.config.target_bytes,
            "number of Gaussians": request.config.max_gaussians,
            "preset": request.config.preset,
            "held-out photos": len(scene.test),
        }
        # A training run that was begun keeps its plan; for another target size, only packing runs again.
        earlier = {**inputs, "target size": stages.trained_target_bytes(self.stage_cache)}
        if self.stage_cache.state.facts("measurement", earlier) is not None:
            inputs = earlier
        plan = Plan(**self.stage_cache.run_stage("measurement", inputs, execute)).with_target_bytes(
            request.config.target_bytes
        )
        if plan.max_size != load_settings.max_size:
            scene = load_settings.load(path, plan.max_size)
        return plan, scene

    def _finish(
        self,
        model: Path,
        scene: Scene | None,
        *,
        imported: dict[str, Any] | None = None,
        poses: dict[str, Any] | None = None,
        training: dict[str, Any] | None = None,
    ) -> MakeResult:
        """Score the model, export it, and return the result."""
        request, stage_cache = self.request, self.stage_cache
        scores = {"views": 0} if scene is None else stages.run_scoring_stage(stage_cache, scene, request.device)
        exported, product = stages.run_export_stage(
            stage_cache, model, request.output.name, scene, is_player=request.is_output_folder
        )
        # The output is copied last, so that an existing output means a finished call.
        output = stages.copy_to_output(product, request.output, overwrite=request.overwrite)
        return MakeResult(
            output=output,
            bytes=exported["bytes"],
            gaussians=describe_file(model)["gaussians"],
            model=model,
            work=stage_cache.folder,
            views=scores["views"],
            psnr=scores.get("psnr"),
            psnr_consistent=scores.get("psnr_consistent"),
            ssim=scores.get("ssim"),
            poses=poses or {},
            training=training or {},
            export={**exported, "file": str(output), **({"import": imported} if imported else {})},
            seconds={name: round(seconds, 1) for name, seconds in stage_cache.seconds.items()},
            total_seconds=round(sum(stage_cache.seconds.values()), 1),
            kept=tuple(stage_cache.kept),
            note=score_note(scores["views"], scores.get("psnr"), (training or {}).get("psnr")),
        )
