"""Photos in, scene out: what is asked for is checked, then the stages follow each other."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import Any

import torch

from hyrfpack.checks import check_choice, check_float, check_int
from hyrfpack.data import PictureCache
from hyrfpack.data.folder import first_readable_photo, list_photos
from hyrfpack.device import choose_device
from hyrfpack.format import describe
from hyrfpack.lock import exclusive_folder
from hyrfpack.make import stages
from hyrfpack.make.held_out import score_note
from hyrfpack.make.minutes import measure
from hyrfpack.make.plan import QUALITIES, Plan, forecast_photos, forecast_scene
from hyrfpack.make.progress import Progress, Reporter
from hyrfpack.make.request import Request, work_folder
from hyrfpack.make.source import Reading, Source
from hyrfpack.make.state import digest_all
from hyrfpack.make.work import Say, Stopped, Work, interruptible
from hyrfpack.outputs import StrPath
from hyrfpack.scene import Scene
from hyrfpack.train import Trainer
from hyrfpack.train.config import LARGEST_SEED, PRESETS

MEASUREMENT_TIME_RATIO = 0.15  # of the minutes that are left: probes and, for long runs, pilots

__all__ = ["MakeResult", "Stopped", "make"]


@dataclass(frozen=True)
class MakeResult:
    """What was made.

    Attributes:
        output: the file or folder that was written.
        bytes: of it.
        gaussians: that the scene has.
        model: the packed model, in the work folder; what was given where that was a model.
        work: the folder of every stage's product.
        views: how many held-out photos the model was scored on.
        psnr, ssim: their means; None where there was nothing to score on.
        psnr_consistent: mean, as in `hyrfpack.Evaluation`; None also where the model has no exposure map.
        poses: what `hyrfpack.estimate_poses` reports; empty where the photos had poses.
        training: steps, Gaussians, bytes and choices of the training; empty where there was none.
        export: what `hyrfpack.export` reports, or `hyrfpack.distill` of splats under "import".
        seconds: that each stage took in all calls together, those included that were interrupted or killed.
        total_seconds: the sum of them.
        kept: stages that were found done.
        note: why the score says little of the scene; empty where it does say something, or there is none.
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
        """Plain numbers, strings, lists and dictionaries, ready for JSON."""
        return {**asdict(self), "output": str(self.output), "model": str(self.model), "work": str(self.work)}


def make(
    photos: StrPath,
    output: StrPath,
    *,
    quality: str = "normal",
    minutes: float | None = None,
    work: StrPath | None = None,
    images: str | None = None,
    max_size: int | None = None,
    test_every: int | None = None,
    matching: str = "auto",
    target_bytes: int | None = None,
    max_gaussians: int | None = None,
    preset: str = "auto",
    seed: int = 0,
    device: str | torch.device = "auto",
    overwrite: bool = False,
    report: Callable[[Progress], None] | None = None,
    say: Say = lambda sentence: None,
    observer: Callable[[Trainer], None] | None = None,
) -> MakeResult:
    """Make a scene of photos: poses if there are none, training, compression, scores on held-out photos, export.

    Each stage's product is kept in a work folder, with what it was made from. The same call goes on after an
    interruption, a kill included, and on a CPU ends with the same bytes as one that was not interrupted. After a change
    of photos or settings, the stages that depend on them are done anew and the others taken as they are.

    Args:
        photos: a folder of photos, or whatever `load_scene` reads where they have poses; a video; a file of splats
            that another program made (see `hyrfpack.distill`); or a `.hyrf` file, to be exported.
        output: what to make; the ending says what (".hyrf", or as `hyrfpack.export` knows them).
        quality: one of QUALITIES.
        minutes: instead of a quality, how long the call shall take: steps and size of photos follow from a measurement.
        work: the work folder; None for the output's name with the ending ".work" beside it.
        images, max_size: as of `load_scene`; None for what the quality says.
        test_every: as of `load_scene`. None holds out every 8th photo, of fewer than 16 one and of fewer than 8 none.
        matching: as of `hyrfpack.estimate_poses`.
        target_bytes: pack the model into so many bytes. Another size in a later call packs the trained model anew and
            does not train it again.
        max_gaussians, preset: as of `hyrfpack.TrainConfig`; `max_gaussians` instead of `target_bytes`.
        seed: of all that is random, 0 to 2^64 - 1.
        device: where to train and to pack, see `hyrfpack.device.choose_device`.
        overwrite: replace an output that is there. Without it, one that appears in the meantime is kept, too: a file
            gets a free name beside it, which the result tells; a folder is an error.
        report: told how far the work is.
        say: told what is going on, in sentences.
        observer: of the training, as of `hyrfpack.train`.

    Raises:
        HyrfError: what is given cannot be used, the output may not or cannot be written, options do not go together
            (all of which is found before the work), or a stage fails. What is finished is kept.
        Stopped: it was interrupted; a KeyboardInterrupt that names the stage.
        ValueError: a number or a word is none of those allowed.

    Example:
        >>> import hyrfpack
        >>> result = hyrfpack.make("bonsai.hyrf", "made/bonsai.html")
        >>> result.output.name, result.bytes > 0, sorted(path.name for path in result.work.iterdir())
        ('bonsai.html', True, ['export', 'make.json'])
    """
    check_choice("quality", quality, QUALITIES)
    check_int("seed", seed, 0, LARGEST_SEED)
    check_choice("preset", preset, PRESETS)
    for name, value in {"target_bytes": target_bytes, "max_gaussians": max_gaussians}.items():
        if value is not None:
            check_int(name, value, 1)
    if minutes is not None:
        check_float("minutes", minutes, 0.0)
    began = monotonic()
    reading = Reading(images, QUALITIES[quality].max_size if max_size is None else max_size, test_every)
    with interruptible():
        try:
            request = Request(
                source=Source.of(photos, reading),
                output=Path(output),
                work=work_folder(Path(output)) if work is None else Path(work),
                reading=reading,
                quality=quality,
                minutes=minutes,
                matching=matching,
                target_bytes=target_bytes,
                max_gaussians=max_gaussians,
                preset=preset,
                seed=seed,
                device=choose_device(device),
                overwrite=overwrite,
            )
            request.check()
            with (
                exclusive_folder(request.work, "another folder with `work`"),
                exclusive_folder(request.output) if request.makes_folder else nullcontext(),
            ):
                return _Making(request, began, report, say, observer).run()
        except Stopped:
            raise
        except KeyboardInterrupt as error:  # before, between and after the stages
            raise Stopped("preparation") from error


class _Making:
    """One call of `make`."""

    def __init__(
        self,
        request: Request,
        began: float,
        report: Callable[[Progress], None] | None,
        say: Say,
        observer: Callable[[Trainer], None] | None,
    ) -> None:
        """Args: began: when the call did, by the monotonic clock."""
        self.observer = observer
        self.request = request
        self.source = request.source
        self.began = began
        self.say = say
        self.reporter = Reporter(request.stages, report)
        self.work = Work(request.work, self.reporter, say, request.check_replacing)

    def run(self) -> MakeResult:
        kind = self.source.kind
        if kind == "model":
            return self._result(self.source.path, scene=None)
        if kind == "splats":
            steps = QUALITIES[self.request.quality].import_steps
            facts = stages.import_splats(self.work, self.source.path, steps, self.request.seed)
            return self._result(self.work.folder / stages.PACKED, scene=None, imported=facts)
        return self._from_photos()

    def _from_photos(self) -> MakeResult:
        request, work, poses = self.request, self.work, {}
        path, reading, scene = self.source.path, request.reading, self.source.scene
        if scene is None:
            poses = self._poses()
            path, reading = work.folder / stages.SCENE, Reading(None, reading.max_size, reading.test_every)
            scene = reading.scene(path)
        else:
            for sentence in scene.notes:
                self.say(sentence)
        cache = PictureCache()
        plan, scene = self._plan(path, reading, scene, cache)
        if request.minutes is None:
            self.reporter.estimates |= forecast_scene(scene, plan, request.device)
        training = stages.fit(
            work, scene, self._digest(scene), plan, request.seed, request.device, cache, self.observer
        )
        stages.pack(work, scene, plan, request.device)
        return self._result(work.folder / stages.PACKED, scene, poses=poses, training=training)

    def _poses(self) -> dict[str, Any]:
        """What the estimation reports of photos without poses, or of a video."""
        request, source = self.request, self.source
        photos = list_photos(source.path) if source.kind == "photos" else []
        facts = first_readable_photo(photos)
        sizes = [facts.size] * len(photos) if facts else []
        forecast = forecast_photos(sizes, self._asked(), request.device)
        if request.minutes is not None:
            forecast = {"poses": forecast["poses"], "training": max(0.0, 60 * request.minutes - forecast["poses"])}
        self.reporter.estimates |= forecast
        if source.archive is not None:
            self.say(f"{source.archive.name} was unpacked into {source.path}, where it is found again")
        return stages.pose(self.work, source.path, source.files(), request.matching, request.seed)

    def _digest(self, scene: Scene) -> str:
        """Of all that is read of a scene; an archive's files are, where they are unpacked."""
        return digest_all((file for file in scene.files if Path(file) != self.source.path), Path(scene.path))

    def _asked(self) -> Plan:
        """What the quality asks for."""
        quality = QUALITIES[self.request.quality]
        steps = quality.steps if self.request.device.type == "cpu" else quality.gpu_steps
        request = self.request
        return Plan(
            steps,
            request.reading.max_size,
            quality.finetune_steps,
            request.target_bytes,
            request.max_gaussians,
            request.preset,
        )

    def _plan(self, path: Path, reading: Reading, scene: Scene, cache: PictureCache) -> tuple[Plan, Scene]:
        """What is asked for or fits the minutes, and the scene at the size that this takes."""
        request = self.request
        if request.minutes is None:
            return self._asked(), scene
        end = self.began + 60 * request.minutes
        left = max(0.0, end - monotonic())
        measuring = MEASUREMENT_TIME_RATIO * left
        self.reporter.estimates |= {"measurement": measuring, "training": left - measuring}

        def act(going_on: bool) -> tuple[dict[str, Any], list[str]]:
            asked = replace(self._asked(), finetune_steps=0)
            plan = measure(
                path, reading, scene, asked, request.device, end, request.seed, cache, self.reporter, self.say
            )
            return asdict(plan), []

        inputs = {
            "photos and poses": self._digest(scene),
            "minutes": request.minutes,
            "size of photos": reading.max_size,
            "seed": request.seed,
            "target size": request.target_bytes,
            "number of Gaussians": request.max_gaussians,
            "preset": request.preset,
        }
        # A training that was begun keeps its plan: another target size is only packed anew.
        earlier = {**inputs, "target size": stages.trained_for(self.work)}
        if self.work.state.facts("measurement", earlier) is not None:
            inputs = earlier
        plan = Plan(**self.work.stage("measurement", inputs, act)).packed_into(request.target_bytes)
        return plan, scene if plan.max_size == reading.max_size else reading.scene(path, plan.max_size)

    def _result(
        self,
        model: Path,
        scene: Scene | None,
        *,
        imported: dict[str, Any] | None = None,
        poses: dict[str, Any] | None = None,
        training: dict[str, Any] | None = None,
    ) -> MakeResult:
        """Score, and write what is wanted."""
        request, work = self.request, self.work
        scores = {"views": 0} if scene is None else stages.score(work, scene, request.device)
        exported, product = stages.write(work, model, request.output.name, scene)
        output = stages.deliver(product, request.output, overwrite=request.overwrite)  # last: where it is, all is done
        return MakeResult(
            output=output,
            bytes=exported["bytes"],
            gaussians=describe(model)["gaussians"],
            model=model,
            work=work.folder,
            views=scores["views"],
            psnr=scores.get("psnr"),
            psnr_consistent=scores.get("psnr_consistent"),
            ssim=scores.get("ssim"),
            poses=poses or {},
            training=training or {},
            export={**exported, "file": str(output), **({"import": imported} if imported else {})},
            seconds={name: round(seconds, 1) for name, seconds in work.seconds.items()},
            total_seconds=round(sum(work.seconds.values()), 1),
            kept=tuple(work.kept),
            note=score_note(scores["views"], scores.get("psnr"), (training or {}).get("psnr")),
        )
