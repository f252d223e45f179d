"""The training loop: each step renders one view on each process."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np
import torch
from torch import Tensor, nn

from hyrfpack.checks import check_float, check_int
from hyrfpack.config.train import FIELD_WARMUP_STEPS, TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.format.exposure_header import STOPS_PER_LOG_GAIN
from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.measure.stages import add_seconds
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.transfer import HostCopy
from hyrfpack.out_of_memory import explain_out_of_memory, has_run_out_of_memory
from hyrfpack.parallel.pool import keep_freed_memory, torch_on_one_thread
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import StepEvent, ignore_progress
from hyrfpack.scene import Picture, Scene, View
from hyrfpack.train.checkpoint import damaged_checkpoint, load_checkpoint, names_and_sizes, save_checkpoint
from hyrfpack.train.density import DensityControl
from hyrfpack.train.distributed import StepStats, average_gradients, check_settings, digest, pack_step_stats
from hyrfpack.train.exposure import initialize_exposures
from hyrfpack.train.launched import ConfirmedStep, LaunchedStep, RenderedView
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.provenance import training_background_spacing
from hyrfpack.train.resolution import ResolutionSchedule
from hyrfpack.train.setup import build_model, check_has_photos, usual_budget_for
from hyrfpack.train.spacing import gaussian_spacing
from hyrfpack.train.step_checks import MAX_GRADIENT
from hyrfpack.train.strategy import Strategy
from hyrfpack.train.view_renderer import ViewRenderer
from hyrfpack.version import __version__

_LOG = logging.getLogger(__name__)

OUT_OF_MEMORY_FIX = "reduce `max_gaussians` or `max_size`"
VIRTUAL_VIEWS_END = 0.85  # From this share of the run on, steps take photos alone, which are sharper.
MIN_CURVE_RECORDS = 200  # A run of more steps has up to twice as many records.


def shuffled(views: Sequence[View], seed: int, places: range) -> Iterator[View]:
    """Yield the views at `places` (from 0) of an endless sequence, in which each epoch is another permutation."""
    current_epoch, order = -1, np.zeros(0, np.int64)
    for index in places:
        epoch, place = divmod(index, len(views))
        if epoch != current_epoch:
            current_epoch, order = epoch, np.random.default_rng((seed, epoch)).permutation(len(views))
        yield views[order[place]]


def is_recorded(step: int, steps: int) -> bool:
    """Return whether the training curve has a record of this step; the last step always has one."""
    return step % max(1, steps // MIN_CURVE_RECORDS) == 0 or step == steps


class Trainer:
    """The training loop and its state: model, optimiser, density control strategy and step.

    Of several processes (ranks), each renders another view in a step, and all apply the mean of their gradients.
    `TrainConfig.steps` counts views, so W processes take 1/W as many steps, with larger learning rates
    (`LearningRates.at`). All ranks hold the same model, bit for bit, because they apply the same gradients.

    Attributes:
        steps: number of optimiser steps of the whole run.
        spacing: typical distance between neighbours in local units if the usual budget of Gaussians lay where the
            initial ones are, see `gaussian_spacing`.
        learning_rates: those of `config`, adapted to this spacing (`LearningRates.at_spacing`).
        kind: "pilot run" (`hyrfpack.train.pilots`), "teacher run" (`hyrfpack.train.teachers`), "first look"
            (`hyrfpack.make`), or empty for the run itself.
        renderer: renders the training views and computes their gradients.

    Example:
        >>> trainer = Trainer(scene, TrainConfig(steps=2000))
        >>> trainer.run()
        >>> trainer.model
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        cache: PictureCache | None = None,
        device: torch.device = torch.device("cpu"),  # noqa: B008 - a constant
        model: HybridModel | None = None,
        strategy: Strategy | None = None,
        ranks: Ranks = SINGLE_PROCESS,
        virtual: Sequence[View] = (),
    ) -> None:
        """Set up a run.

        Args:
            model: the model to continue training, changed in place; None builds an untrained one for the scene, whose
                fields start at lower learning rates (`FIELD_WARMUP_STEPS`).
            strategy: adds and removes Gaussians; None for `DensityControl` with the settings of `config.density`.
            ranks: the processes that train together; each of them sets up the same run.
            virtual: views that the first 85 % of the steps render in turn with the photos, see
                `hyrfpack.train.virtual_views`.

        Raises:
            HyrfTrainingError: the scene has no training views.
            HyrfDataError: a photo cannot be read.
        """
        check_has_photos(scene)
        self.ranks = ranks
        self.steps = -(-config.steps // ranks.size)
        self.scene = scene
        self.config = config
        self.cache = cache or PictureCache()
        self.device = device
        self.choices: dict[str, str] = {}  # For each setting, the choice and its reason.
        self.pilots: list[dict] = []  # The scores of the pilot runs, see `PilotScore`.
        self._warmup_steps = FIELD_WARMUP_STEPS if model is None else 0
        usual_budget = usual_budget_for(scene, config.steps)

        def build() -> tuple[HybridModel, int, dict[str, str], float]:
            built, budget, choices = build_model(scene, config, self.cache)
            return built, budget, choices, gaussian_spacing(built, scene.train, usual_budget)

        if model is None:
            model, self.budget, self.choices, self.spacing = ranks.run_on_main(build)
        else:
            _check_trainable(model)
            self.budget = config.max_gaussians or len(model)
            self.spacing = gaussian_spacing(model, scene.train, usual_budget)
        self.exposures, self.choices["exposure"] = initialize_exposures(
            scene, config, self.cache, device, ranks, virtual
        )
        self._virtual = list(virtual)
        self.renderer = ViewRenderer(
            [*scene.train, *virtual] if virtual else scene.train,
            config,
            self.exposures,
            device,
            is_single_process=ranks.is_single,
            has_position_gradients=model.config.position_gradients,
        )
        self.learning_rates = config.learning_rates.at_spacing(self.spacing)
        self._begin_to_optimize(model)
        self.strategy: Strategy = strategy or DensityControl(
            config.density, self.steps, self.budget, len(self.model), config.seed, device, ranks
        )
        self.resolution = ResolutionSchedule(scene.train, self.steps, len(self.model), is_on=config.resolution_schedule)
        self.step = 0
        self._launched: LaunchedStep | None = None  # The step whose numbers were not read yet.
        self.kind: Literal["", "pilot run", "teacher run", "first look"] = ""
        self.saved: int | None = None  # The step of the checkpoint on disk.
        self.records: list[dict] = []
        self.seconds: dict[str, float] = defaultdict(float)  # By stage, summed over all parts of a resumed run.
        self.elapsed = 0.0

    def _begin_to_optimize(self, model: HybridModel) -> None:
        """Make `model` the model that is trained, with a new optimiser."""
        model.precision = self.config.precision
        model.gaussians.pixel_sizes = None  # They belong to the Gaussians of a file, which training moves and replaces.
        model.background_spacing = training_background_spacing(self.scene)  # Scores are then those of the model's file.
        if not any(parameter.requires_grad for parameter in model.parameters()):  # A loaded model records none.
            model.requires_grad_(True)
        self.model = model.to(self.device)
        self.optimizer = Optimizer(self.model, self.learning_rates, self.ranks.size, self._warmup_steps)
        self.renderer.graphs.clear()

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(
        self,
        *,
        checkpoint: Path | None = None,
        progress: Callable[[StepEvent], None] = ignore_progress,
        stop: Callable[[], bool] = lambda: False,
        overwrite: bool = True,
    ) -> bool:
        """Train until the last step, or until `stop()` returns True.

        If a checkpoint cannot be written, as on a full disk, the main process logs a warning. Training continues and
        tries again at the next checkpoint.

        Args:
            checkpoint: path of the checkpoint; written every `checkpoint_every` steps and when stopped early.
            progress: called after each step.
            stop: called in each step; the run ends after the step in which it returns True.
            overwrite: replace a file at `checkpoint` that belongs to another run.

        Returns:
            Whether the run is complete.

        Raises:
            HyrfTrainingError: a parameter, the loss or a gradient is not finite. The message names step, view and
                group.
            HyrfError: the run was stopped early and the checkpoint cannot be written; or one of several processes
                cannot continue or has ended.
        """
        every = self.config.checkpoint_every or max(1, self.steps // 20)
        check_settings(self.ranks, {**self._settings(), "versions": (__version__, torch.__version__)})
        with (
            closing(self.cache.stream(self._order())) as views,
            torch_on_one_thread(),
            keep_freed_memory(),
            self._captured_steps(),
        ):
            while self.step < self.steps:
                start = time.perf_counter()
                self.step += 1
                complete, is_due = self.step == self.steps, self.step % every == 0
                confirmed = self._train_step(views, stop, confirm=complete or (checkpoint is not None and is_due))
                self.elapsed += time.perf_counter() - start
                self._report(confirmed, progress)
                stopped = (stop() if self.ranks.is_single else confirmed[-1].stop) and not complete
                if stopped:
                    self._report(self._confirm_launched(), progress)
                if checkpoint and (stopped or (is_due and not complete)):
                    try:
                        self.save(checkpoint, overwrite=overwrite or self.saved is not None)
                    except HyrfError as error:
                        if stopped:
                            raise
                        if self.ranks.is_main:
                            _LOG.warning(f"{error}; training continues, without the checkpoint of step {self.step:,}")
                if stopped:
                    # The launcher ends all processes once one has ended, so all wait until the checkpoint is written.
                    self.ranks.all_gather(None)
                    return False
        return True

    @contextmanager
    def _captured_steps(self) -> Iterator[None]:
        """Free the memory of captured steps in the end."""
        try:
            yield
        finally:
            self.renderer.graphs.release()

    def _order(self) -> Iterator[View]:
        """Return an iterator over this rank's views of the remaining steps, at the resolutions of these steps."""
        first, count = self.step * self.ranks.size, self.steps * self.ranks.size
        places = range(first + self.ranks.rank, count, self.ranks.size)
        views = self._iterate_views(places)
        return map(self.resolution.reduce_view, views, range(self.step + 1, self.steps + 1))

    def _report(self, confirmed: Sequence[ConfirmedStep], progress: Callable[[StepEvent], None]) -> None:
        """Add confirmed steps to the training curve and report them; the last one of the run fits the exposure map."""
        for stats in confirmed:
            self._record(stats)
            if stats.step == self.steps:
                self.fit_exposure_map()
                if reduced := self.resolution.describe():
                    self.choices["resolution"] = reduced
            share = self.resolution.share_done(stats.step)
            progress(StepEvent(stats.step, self.steps, stats.loss, stats.error, len(self.model), share))

    def _train_step(
        self, views: Iterator[tuple[View, Picture]], stop: Callable[[], bool], *, confirm: bool
    ) -> list[ConfirmedStep]:
        """Take one optimiser step, and add and prune Gaussians if a round is due.

        A step is confirmed when its numbers are read and found valid. If views are rendered into reserves, the host
        gives the GPU the next view's gradients before it reads the numbers of a step, so that the GPU never runs idle.

        Args:
            confirm: confirm this step, too, before returning.

        Returns:
            The steps that were confirmed.
        """
        problem: HyrfError | None = None
        confirmed: list[ConfirmedStep] = []
        rendered: RenderedView | None = None
        try:
            with explain_out_of_memory(OUT_OF_MEMORY_FIX), add_seconds(self.seconds, "data"):
                view, picture = next(views)
            rendered = self._compute_gradients(self.step, view, picture)
        except HyrfError as refusal:
            if self.ranks.is_single:
                raise
            problem = refusal.with_text()  # This copy has no traceback, which would keep the step's memory.
        confirmed += self._confirm_launched()
        if any(stats.was_retaken for stats in confirmed):  # These gradients are those of an older model.
            self._discard_gradients()
            rendered = self._compute_gradients(self.step, view, picture)
        self._update(self.step, rendered, stop, problem)
        rendered = None  # Otherwise its gradients would be kept until the next step.
        is_acting = self.strategy.acting(self.step)
        if confirm or is_acting or self.renderer.reserves is None:
            confirmed += self._confirm_launched(problem)
        if is_acting:
            with add_seconds(self.seconds, "density"):
                self.renderer.graphs.clear()  # They hold the addresses of parameters.
                self.strategy.act(self.step, self.model, self.optimizer)
                if not self.ranks.is_single:
                    self._synchronize()
                self.resolution.update(self.step, len(self.model))
        return confirmed

    @explain_out_of_memory(OUT_OF_MEMORY_FIX)
    def _compute_gradients(self, step: int, view: View, picture: Picture) -> RenderedView:
        """Render a view for a step, and set the gradients of its loss."""
        parameters = self._learnt_parameters()
        try:
            result = self.renderer.compute_gradients(
                self.model,
                parameters,
                view,
                picture,
                self._choose_background_color(step),
                self.resolution.render_settings(view.camera, step),
                absgrad=self.strategy.watching(step),
            )
        except HyrfError as error:
            if error.__cause__ is not None and has_run_out_of_memory(error):
                raise error.__cause__ from None
            if names := self._nonfinite_parameters():
                self._raise_nonfinite(step, "a number to be rendered is not finite", names)
            raise HyrfTrainingError(
                f"training stopped at step {step} on view '{view.name}': {error.problem}", fix=error.fix
            ) from error
        for parameter, gradient in zip(parameters, result.gradients, strict=True):
            parameter.grad = gradient
        for stage, seconds in result.seconds.items():
            self.seconds[stage] += seconds
        return RenderedView(view, picture, result)

    def _update(
        self, step: int, rendered: RenderedView | None, stop: Callable[[], bool], problem: HyrfError | None
    ) -> None:
        """Launch the rest of a step: observe its gradients, exchange them, update the parameters, copy the numbers.

        Nothing changes if the rendering turns out to be invalid. On one of several processes, None stands for a view
        that has a problem.
        """
        checks = None if rendered is None else rendered.result.checks
        valid = None if checks is None else checks.valid
        if rendered is None:
            loss = error = torch.zeros((), device=self.device)
        else:
            loss, error = rendered.result.loss, rendered.result.error
            with add_seconds(self.seconds, "density"):
                rendering = dataclasses.replace(rendered.result.rendering, valid=valid)
                self.strategy.observe(rendering, rendered.view.camera, self.model)
        packed = torch.stack((loss, error))
        if not self.ranks.is_single:
            with add_seconds(self.seconds, "exchange"):
                own_stats = pack_step_stats(loss, error, stop=stop(), problem=problem is not None)
                packed = average_gradients(self.ranks, self._learnt_parameters(), own_stats)
        with add_seconds(self.seconds, "optimizer"):
            broken = self.optimizer.step(step - 1, self.steps, valid)
            if self.exposures is not None:
                # A photo's gains take as many steps as with a single process, so their rate is that of such a run.
                seen, all_seen = (self.ranks.size * steps for steps in (step - 1, self.steps))
                rate = self.learning_rates.at("exposure", seen, all_seen)
                broken = torch.cat((broken, self.exposures.step(rate, self._views_of_step(step), valid)[None]))
        reserved, numbers = None, [packed, broken]
        if rendered is not None and checks is not None:  # Adam sets no flags where the step is not valid.
            reserved = rendered.view, rendered.picture
            numbers = [packed, checks.valid[None], checks.demand, checks.norms]
        self._launched = LaunchedStep(step, reserved, HostCopy(torch.cat(numbers)), len(packed))

    def _confirm_launched(self, problem: HyrfError | None = None, *, was_retaken: bool = False) -> list[ConfirmedStep]:
        """Confirm the launched step, if any: wait for its numbers and check them.

        If its reserve was too small, nothing was changed, and the step is taken again with a larger one.

        Args:
            problem: the problem of this process's view.
            was_retaken: whether the step was taken before.
        """
        if self._launched is None:
            return []
        launched, self._launched = self._launched, None
        step = launched.step
        with add_seconds(self.seconds, "loss"):
            sums, numbers = launched.read_numbers()
        self.ranks.raise_if_lost()
        stats = StepStats(sums[0], sums[1]) if self.ranks.is_single else StepStats.from_sums(sums, self.ranks.size)
        if stats.problem:
            self.ranks.raise_if_any(problem)
        if launched.reserved is None:
            flags = numbers
        else:
            valid, nonfinite_positions, in_view, nonfinite_inputs, pairs, *norms = numbers
            if nonfinite_positions or nonfinite_inputs:
                self._raise_nonfinite(step, "a number to be rendered is not finite", self._nonfinite_parameters())
            assert self.renderer.reserves is not None
            self.renderer.reserves.record(launched.reserved[0], len(self.model), int(in_view), int(pairs))
            flags = [float(not norm <= MAX_GRADIENT) for norm in norms]
            if not valid and np.isfinite(stats.loss) and not any(flags):
                self._retake(step, *launched.reserved)
                return self._confirm_launched(was_retaken=True)
        if not np.isfinite(stats.loss):
            self._raise_nonfinite(step, "the loss is not finite", self._nonfinite_parameters())
        if any(flags):
            self._raise_nonfinite(step, "a gradient is not finite", self._name_groups(flags))
        return [ConfirmedStep(step, stats.loss, stats.error, stats.stop, was_retaken)]

    def _retake(self, step: int, view: View, picture: Picture) -> None:
        """Launch a step again that changed nothing, because its reserve was too small."""
        self.optimizer.retract_step()
        if self.exposures is not None:
            self.exposures.retract_step()
        self._discard_gradients()
        self._update(step, self._compute_gradients(step, view, picture), lambda: False, None)

    def _discard_gradients(self) -> None:
        for parameter in self._learnt_parameters():
            parameter.grad = None

    def fit_exposure_map(self) -> None:
        """Fit the exposure map to the learnt per-image gains, if any, and store it in the model."""
        if self.exposures is None:
            return
        fit = self.exposures.fit_map(self.model.config.frame, self.scene.train)
        self.model.exposure = fit.map
        error = fit.leave_one_out_error * STOPS_PER_LOG_GAIN
        self.choices["exposure_map"] = f"{len(fit.map.positions)} centers; leave-one-out error {error:.2f} stops"

    def _learnt_parameters(self) -> list[nn.Parameter]:
        """Return the parameters whose gradients are averaged over the ranks."""
        return [*self.optimizer.parameters(), *([] if self.exposures is None else [self.exposures.values])]

    def _views_of_step(self, step: int) -> list[View]:
        """Return the views that all ranks render in a step."""
        places = range((step - 1) * self.ranks.size, step * self.ranks.size)
        return list(self._iterate_views(places))

    def _iterate_views(self, places: range) -> Iterator[View]:
        """Yield the views at `places` of the run, counted from 0: the last ones are photos, those before any views."""
        seed, photos, virtual = self.config.seed, self.scene.train, self._virtual
        end = int(VIRTUAL_VIEWS_END * self.steps) * self.ranks.size if virtual else 0
        mixed = range(places.start, max(places.start, min(places.stop, end)), places.step)
        yield from shuffled([*photos, *virtual], seed, mixed)
        yield from shuffled(photos, seed, places[len(mixed) :])

    def _synchronize(self) -> None:
        """Copy the state of rank 0 to all ranks, if their parameters differ after density control.

        A rank that had another number of Gaussians drops its own observations.
        """
        if len(set(self.ranks.all_gather(digest(self.model.parameters())))) == 1:
            return
        self._restore(self.ranks.broadcast(self._collect_tensors()))
        own = self.strategy.state_dict()
        observed = self.ranks.broadcast(_copy_to_cpu(own))
        if any(own[name].shape != value.shape for name, value in observed.items()):
            self.strategy.load_state_dict({name: torch.zeros_like(value) for name, value in observed.items()})

    def _record(self, stats: ConfirmedStep) -> None:
        """Add a record of a step to the training curve if `is_recorded`, unless all of its photo is masked."""
        if not np.isnan(stats.error) and is_recorded(stats.step, self.steps):
            psnr = psnr_from_mse(stats.error)
            record = {"step": stats.step, "loss": stats.loss, "psnr": psnr, "gaussians": len(self.model)}
            self.records.append({**record, "seconds": round(self.elapsed, 3)})

    def _choose_background_color(self, step: int) -> np.ndarray:
        """Return the colour (3,) behind transparent pixels of a step's photo, and behind a model without a sphere."""
        if self.config.background_color == "random" and not self.model.config.background:
            number = (step - 1) * self.ranks.size + self.ranks.rank + 1  # The number of the view, from 1.
            return np.random.default_rng((self.config.seed, 1, number)).random(3, dtype=np.float32)
        return np.array(self.model.config.solid, np.float32)

    def _name_groups(self, flags: Sequence[float]) -> list[str]:
        """Return the names of the parameter groups with a gradient that is not finite."""
        count = len(flags) - (self.exposures is not None)
        return self.optimizer.names(flags[:count]) + ["exposure"] * any(flags[count:])

    def _nonfinite_parameters(self) -> list[str]:
        return [name for name, p in self.model.named_parameters() if not torch.isfinite(p).all()]

    def _raise_nonfinite(self, step: int, what: str, groups: list[str]) -> NoReturn:
        where = ", ".join(groups) if groups else "none; look at the photo itself"
        views = " or ".join(f"'{view.name}'" for view in self._views_of_step(step))
        raise HyrfTrainingError(
            f"training stopped at step {step} on view {views}: {what} (parameter groups: {where})",
            fix="remove or mask the photo, or train with another `seed`",
        )

    # -- state ---------------------------------------------------------------------------------------------------

    def _settings(self) -> dict:
        views = names_and_sizes([*self.scene.train, *self._virtual])
        chosen = {"exposure": self.exposures is not None, "model": self.model.config.to_dict()}
        if not self.ranks.is_single:
            chosen["processes"] = self.ranks.size
        return {**self.config.to_dict(), "views": views, "strategy": type(self.strategy).__qualname__, **chosen}

    def _collect_tensors(self) -> dict[str, Tensor]:
        """Return the tensors of the run's state on the CPU, except the density control observations of each rank."""
        tensors: dict[str, Tensor] = {f"model.{name}": p for name, p in self.model.named_parameters()}
        tensors |= {f"adam.{name}": value for name, value in self.optimizer.state_dict().items()}
        if self.exposures is not None:
            tensors |= {f"exposure.{name}": value for name, value in self.exposures.state_dict().items()}
        return _copy_to_cpu(tensors)

    def _restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `_collect_tensors` returned."""
        explicit = [tensors[f"model.gaussians.{name}"] for name in Gaussians.PARAMETER_NAMES]
        model = HybridModel(self.model.config, Gaussians(*explicit))
        model.load_state_dict(_select_prefixed("model.", tensors))
        model.exposure = self.model.exposure
        self._begin_to_optimize(model)
        self.optimizer.load_state_dict(_select_prefixed("adam.", tensors))
        if self.exposures is not None:
            self.exposures.load_state_dict(_select_prefixed("exposure.", tensors))

    def save(self, path: Path, *, overwrite: bool = True) -> None:
        """Write a checkpoint to `path`. All ranks must call this, and rank 0 writes the file.

        Raises:
            HyrfError: the file cannot be written, or exists and `overwrite` is False.
        """
        observed = self.ranks.all_gather(_copy_to_cpu(self.strategy.state_dict()))

        def write() -> None:
            self._write_checkpoint(path, observed, overwrite)
            self.saved = self.step  # Before rank 0 waits for the others, so that errors name the checkpoint.

        self.ranks.run_on_main(write)
        self.saved = self.step

    def _write_checkpoint(self, path: Path, observed: list[dict[str, Tensor]], overwrite: bool) -> None:
        """Write a checkpoint, given the density control observations of each rank."""
        tensors = self._collect_tensors()
        for rank, values in enumerate(observed):
            tensors |= {f"{_strategy_prefix(rank)}{name}": value for name, value in values.items()}
        progress = {
            "step": self.step,
            "records": self.records,
            "seconds": dict(self.seconds),
            "elapsed": self.elapsed,
            "choices": self.choices,
            "resolution": self.resolution.changes,
            "pilots": self.pilots,
            "spacing": self.spacing,
        }
        save_checkpoint(path, settings=self._settings(), tensors=tensors, progress=progress, overwrite=overwrite)

    @explain_out_of_memory(OUT_OF_MEMORY_FIX)
    def load(self, path: Path) -> None:
        """Resume from the checkpoint at `path`, so that the result equals that of an uninterrupted run.

        All ranks must call this, and rank 0 reads the file.

        Raises:
            HyrfTrainingError: as `load_checkpoint`.
            HyrfError: memory ran out.
        """
        saved = self.ranks.run_on_all(
            lambda: load_checkpoint(path, self._settings()) if self.ranks.is_main else ({}, {})
        )
        tensors, progress = self.ranks.broadcast(saved)
        try:
            self._resume(tensors, progress)
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            if has_run_out_of_memory(error):
                raise
            raise damaged_checkpoint(path) from error

    def _resume(self, tensors: dict[str, Tensor], progress: dict) -> None:
        """Restore the state of a checkpoint's tensors and progress; any error means that they are not as saved."""
        check_int("step", progress["step"], 0, self.steps)
        check_float("elapsed", progress["elapsed"])
        if not isinstance(progress["records"], list):
            raise ValueError("the records are no list")
        self.spacing = progress.get("spacing", self.spacing)  # Checkpoints of earlier versions do not have it.
        self.learning_rates = self.config.learning_rates.at_spacing(self.spacing)
        self._restore(tensors)
        self._launched = None
        self.strategy.load_state_dict(_select_prefixed(_strategy_prefix(self.ranks.rank), tensors))
        self.step, self.records = progress["step"], progress["records"]
        self.saved = self.step
        self.seconds, self.elapsed = defaultdict(float, progress["seconds"]), progress["elapsed"]
        self.choices |= progress.get("choices", {})
        self.resolution.changes = [(first, factor) for first, factor in progress["resolution"]]
        self.pilots = progress.get("pilots", [])


def _check_trainable(model: HybridModel) -> None:
    """Check that the model has no residuals, which density control could not keep beside their Gaussians."""
    if any(getattr(model.gaussians, name) is not None for name in Gaussians.RESIDUAL_NAMES):
        raise HyrfTrainingError(
            "the model has residuals, as imported models do, and only models without them can be trained",
            fix="pass a model that `hyrfpack.train_model` made",
        )


def _copy_to_cpu(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu() for name, value in tensors.items()}


def _select_prefixed(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names start with `prefix`, by the names without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _strategy_prefix(rank: int) -> str:
    """Return the prefix that names of a rank's density control observations have in a checkpoint."""
    return f"density{rank or ''}."
