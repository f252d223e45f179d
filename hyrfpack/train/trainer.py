"""The trainer: one view a step and process, until the run is done, interrupted or broken."""

from __future__ import annotations

import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from torch import Tensor, nn

from hyrfpack.choices import CONSISTENT_EXPOSURE
from hyrfpack.data import PictureCache
from hyrfpack.device import Photos, upload_array
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate.metrics import psnr_from_mse
from hyrfpack.format.exposure_header import STOPS_PER_LOG_GAIN
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.parallel.pool import keep_freed_memory, torch_on_one_thread
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.render import RenderSettings, render
from hyrfpack.scene import Picture, Scene, View
from hyrfpack.train.checkpoint import load_checkpoint, save_checkpoint
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.density import DensityControl
from hyrfpack.train.exposure import exposures_for
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.setup import build_model
from hyrfpack.train.strategy import Strategy
from hyrfpack.train.together import Told, averaged, check_settings, digest, to_tell
from hyrfpack.version import __version__

RECORDS = 200  # points on the training curve


def shuffled(views: Sequence[View], seed: int, places: range) -> Iterator[View]:
    """The views at these places, counted from 0, of an endless order: each epoch is a permutation of its own."""
    there, order = -1, np.zeros(0, np.int64)
    for index in places:
        epoch, place = divmod(index, len(views))
        if epoch != there:
            there, order = epoch, np.random.default_rng((seed, epoch)).permutation(len(views))
        yield views[order[place]]


def is_recorded(step: int, steps: int) -> bool:
    """Whether this step of a run is one of the about RECORDS that are written down, the last one among them."""
    return step % max(1, steps // RECORDS) == 0 or step == steps


class Trainer:
    """Holds a run: model, optimiser, strategy of density control, and the step they are at.

    On several processes (ranks) each renders another view of a step, and all take it by the mean of their gradients:
    `TrainConfig.steps` counts views, so W processes take as many steps over W, larger ones (`LearningRates.at`).
    All hold the same model, bit by bit, for they see the same gradients and decide by the same numbers.

    Attributes:
        steps: of the optimiser, until the end.

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
    ) -> None:
        """Set up a run.

        Args:
            model: to go on with, changed in place; None builds an untrained one that fits the scene.
            strategy: what adds and removes Gaussians; None for `DensityControl` as configured.
            ranks: the processes that train together, each of which sets up the same run.
        """
        self.ranks = ranks
        self.steps = -(-config.steps // ranks.size)
        self.scene = scene
        self.config = config
        self.cache = cache or PictureCache()
        self.device = device
        self.photos = Photos(device)
        self.choices: dict[str, str] = {}  # what was chosen for the run, each with its reason
        self.pilots: list[dict] = []  # scores of the pilot runs by which it was chosen
        if model is None:
            model, self.budget, self.choices = build_model(scene, config)
        else:
            self.budget = config.max_gaussians or len(model)
        self.exposures, self.choices["exposure"] = exposures_for(scene, config, self.cache, device)
        self._take(model)
        self.strategy: Strategy = strategy or DensityControl(
            config.density, self.steps, self.budget, len(self.model), config.seed, device, ranks
        )
        self.step = 0
        self.saved: int | None = None  # the step that the checkpoint on disk is of
        self.records: list[dict] = []
        self.seconds: dict[str, float] = defaultdict(float)  # by stage, over all parts of a resumed run
        self.elapsed = 0.0

    def _take(self, model: HybridModel) -> None:
        """Train this model from here on."""
        model.precision = self.config.precision
        if not any(parameter.requires_grad for parameter in model.parameters()):  # as of a model that was loaded
            model.requires_grad_(True)
        self.model = model.to(self.device)
        self.optimizer = Optimizer(self.model, self.config.learning_rates, self.ranks.size)

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(
        self,
        *,
        checkpoint: Path | None = None,
        report: Callable[[Trainer, float, float], None] = lambda trainer, loss, mse: None,
        stop: Callable[[], bool] = lambda: False,
        warn: Callable[[str], None] = warnings.warn,
        overwrite: bool = True,
    ) -> bool:
        """Train until the last step, or until `stop()` says so.

        Args:
            checkpoint: where to keep the run's state; written every `checkpoint_every` steps and when stopped early.
            report: called after each step with the loss and the mean squared error of its view (NaN where the whole
                photo is masked).
            stop: asked after each step; by several processes during each, to be the last.
            warn: told when a checkpoint cannot be written, as on a full disk. Training goes on and tries again at the
                next one, for hours of work are worth more than a checkpoint.
            overwrite: replace a file at `checkpoint` that is of another run.

        Returns:
            Whether the run is complete.

        Raises:
            HyrfTrainingError: a parameter, the loss or a gradient is not finite; step, view and group are named.
            HyrfError: stopped early, and the checkpoint cannot be written; or, on all processes, one of them cannot go
                on or has gone.
        """
        every = self.config.checkpoint_every or max(1, self.steps // 20)
        check_settings(self.ranks, {**self._settings(), "versions": (__version__, torch.__version__)})
        keep_freed_memory()
        with closing(self.cache.stream(self._order())) as views, torch_on_one_thread():
            while self.step < self.steps:
                start = time.perf_counter()
                self.step += 1
                loss, mse, stopped = self._train_step(views, stop)
                self.elapsed += time.perf_counter() - start
                self._record(loss, mse)
                complete = self.step == self.steps
                if complete:
                    self._fit_exposure_map()
                report(self, loss, mse)
                stopped = (stop() if self.ranks.is_single else stopped) and not complete
                if checkpoint and (stopped or (self.step % every == 0 and not complete)):
                    try:
                        self.save(checkpoint, overwrite=overwrite or self.saved is not None)
                    except HyrfError as error:
                        if stopped:
                            raise
                        warn(f"{error}; training goes on, without the checkpoint of step {self.step:,}")
                if stopped:
                    # The launcher ends all processes once one has left, so all wait until the checkpoint is written.
                    self.ranks.all_gather(None)
                    return False
        return True

    def _order(self) -> Iterator[View]:
        """This rank's views, in the order of the steps still to come."""
        first, count = self.step * self.ranks.size, self.steps * self.ranks.size
        return shuffled(self.scene.train, self.config.seed, range(first + self.ranks.rank, count, self.ranks.size))

    def _train_step(self, views: Iterator[tuple[View, Picture]], stop: Callable[[], bool]) -> tuple[float, float, bool]:
        """Take a step: loss and mean squared error, means over all ranks' views, and whether one of them is to stop."""
        problem: HyrfError | None = None
        try:
            with self._timed("data"):
                view, picture = next(views)
            loss, error = self._gradients(view, picture)
        except HyrfError as refusal:
            if self.ranks.is_single:
                raise
            problem = refusal
            loss = error = torch.zeros((), device=self.device)
        said = torch.stack((loss, error))
        if not self.ranks.is_single:
            with self._timed("exchange"):
                mine = to_tell(loss, error, stop=stop(), problem=problem is not None)
                said = averaged(self.ranks, self._learnt(), mine)
        with self._timed("optimizer"):
            broken = self.optimizer.step(self.step - 1, self.steps)
            if self.exposures is not None:
                # A photo's gains take as many steps as in one process.
                seen, all_seen = (self.ranks.size * steps for steps in (self.step - 1, self.steps))
                rate = self.config.learning_rates.at("exposure", seen, all_seen)
                broken = torch.cat((broken, self.exposures.step(rate, self._views_of_step())[None]))
        with self._timed("loss"):
            # All that the host wants to know of this step, in one wait for the device.
            numbers = torch.cat((said, broken)).tolist()
        said_numbers, flags = numbers[: len(said)], numbers[len(said) :]
        told = Told(*said_numbers) if self.ranks.is_single else Told.of(said_numbers, self.ranks.size)
        if told.problem:
            self.ranks.raise_if_any(problem)
        if not np.isfinite(told.loss):
            self._refuse("the loss is not finite", self._nonfinite_parameters())
        if any(flags):
            self._refuse("a gradient is not finite", self._groups(flags))
        with self._timed("density"):
            before = self.model.gaussians.positions
            self.strategy.act(self.step, self.model, self.optimizer)
            if not self.ranks.is_single and self.model.gaussians.positions is not before:
                self._stay_alike()
        return told.loss, told.error, told.stop

    def _gradients(self, view: View, picture: Picture) -> tuple[Tensor, Tensor]:
        """Add a view's gradients: its loss and mean squared error (NaN where all of the photo is masked), scalars."""
        with self._timed("data"):
            solid = self._solid()
            target, mask = self.photos.get(view.name, picture, solid)
        try:
            rendering = render(
                self.model,
                view.camera,
                RenderSettings(exposure=CONSISTENT_EXPOSURE),  # the photo's own gains come after
                absgrad=self.strategy.watching(self.step),
                solid=None if solid is None else upload_array(solid, self.device),
            )
        except HyrfError:
            self._refuse("a number to be rendered is not finite", self._nonfinite_parameters())
        for stage, seconds in rendering.seconds.items():
            self.seconds[stage] += seconds
        with self._timed("loss"):
            image = rendering.rgb if self.exposures is None else self.exposures.exposed(rendering.rgb, view)
            loss = photometric_loss(image, target, mask, ssim_weight=self.config.ssim_weight)
        with self._timed("backward"):
            loss.backward()
        with self._timed("density"):
            self.strategy.observe(rendering, view.camera, self.model)
        with self._timed("loss"):
            return loss.detach(), _mean_square(image.detach() - target, mask)

    def _fit_exposure_map(self) -> None:
        """Give the model the exposure map of the per-image gains that were learnt, if any."""
        if self.exposures is None:
            return
        fit = self.exposures.fit_map(self.model.config.frame, self.scene.train)
        self.model.exposure = fit.map
        error = fit.leave_one_out_error * STOPS_PER_LOG_GAIN
        self.choices["exposure_map"] = f"{len(fit.map.positions)} centers; leave-one-out error {error:.2f} stops"

    def _learnt(self) -> list[nn.Parameter]:
        """What gradients are shared of."""
        return [*self.model.parameters(), *([] if self.exposures is None else [self.exposures.values])]

    def _views_of_step(self) -> list[View]:
        """The views that the ranks render in this step."""
        places = range((self.step - 1) * self.ranks.size, self.step * self.ranks.size)
        return list(shuffled(self.scene.train, self.config.seed, places))

    def _stay_alike(self) -> None:
        """See that all ranks still hold the same numbers after Gaussians came and went; else take those of rank 0."""
        if len(set(self.ranks.all_gather(digest(self.model.parameters())))) > 1:
            self._restore(self.ranks.broadcast(self._tensors()))

    def _record(self, loss: float, mse: float) -> None:
        """Keep what the step came to for the curve, unless all of its photo is masked."""
        if not np.isnan(mse) and is_recorded(self.step, self.steps):
            record = {"step": self.step, "loss": loss, "psnr": psnr_from_mse(mse), "gaussians": len(self.model)}
            self.records.append({**record, "seconds": round(self.elapsed, 3)})

    def _solid(self) -> np.ndarray | None:
        """The colour behind this step's picture, None when the model has a background of its own."""
        if self.model.config.background:
            return None
        if self.config.background_color == "random":
            number = (self.step - 1) * self.ranks.size + self.ranks.rank + 1  # of the view, from 1
            return np.random.default_rng((self.config.seed, 1, number)).random(3, dtype=np.float32)
        return np.array(self.model.config.solid, np.float32)

    def _groups(self, flags: Sequence[float]) -> list[str]:
        """The parameter groups with a gradient that is not finite."""
        count = len(flags) - (self.exposures is not None)
        return self.optimizer.names(flags[:count]) + ["exposure"] * any(flags[count:])

    def _nonfinite_parameters(self) -> list[str]:
        return [name for name, p in self.model.named_parameters() if not torch.isfinite(p).all()]

    def _refuse(self, what: str, groups: list[str]) -> NoReturn:
        where = ", ".join(groups) if groups else "none; look at the photo itself"
        views = " or ".join(f"'{view.name}'" for view in self._views_of_step())
        raise HyrfTrainingError(
            f"training stopped at step {self.step} on view {views}: {what} (parameter groups: {where}); "
            "lower the learning rates or remove the view"
        )

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] += time.perf_counter() - start

    # -- state ---------------------------------------------------------------------------------------------------

    def _settings(self) -> dict:
        views = [[view.name, view.camera.width, view.camera.height] for view in self.scene.train]
        chosen = {"exposure": self.exposures is not None, "model": self.model.config.to_dict()}
        if not self.ranks.is_single:
            chosen["processes"] = self.ranks.size
        return {**self.config.to_dict(), "views": views, "strategy": type(self.strategy).__qualname__, **chosen}

    def _tensors(self) -> dict[str, Tensor]:
        """The run's state, but for what each rank has collected for density control, on the CPU."""
        tensors: dict[str, Tensor] = {f"model.{name}": p for name, p in self.model.named_parameters()}
        tensors |= {f"adam.{name}": value for name, value in self.optimizer.state_dict().items()}
        if self.exposures is not None:
            tensors |= {f"exposure.{name}": value for name, value in self.exposures.state_dict().items()}
        return _on_cpu(tensors)

    def _restore(self, tensors: dict[str, Tensor]) -> None:
        """The inverse of `_tensors`."""
        explicit = [tensors[f"model.gaussians.{name}"] for name in Gaussians.PARAMETER_NAMES]
        model = HybridModel(self.model.config, Gaussians(*explicit))
        model.load_state_dict(_under("model.", tensors))
        model.exposure = self.model.exposure
        self._take(model)
        self.optimizer.load_state_dict(_under("adam.", tensors))
        if self.exposures is not None:
            self.exposures.load_state_dict(_under("exposure.", tensors))

    def save(self, path: Path, *, overwrite: bool = True) -> None:
        """Write the run's state to `path`; rank 0 does, and all have to call it.

        Raises:
            HyrfError: the file cannot be written, or not without `overwrite`.
        """
        collected = self.ranks.all_gather(_on_cpu(self.strategy.state_dict()))
        if not self.ranks.is_main:
            self.saved = self.step
            return
        tensors = self._tensors()
        for rank, values in enumerate(collected):
            tensors |= {f"{_collected_by(rank)}{name}": value for name, value in values.items()}
        progress = {
            "step": self.step,
            "records": self.records,
            "seconds": dict(self.seconds),
            "elapsed": self.elapsed,
            "choices": self.choices,
            "pilots": self.pilots,
        }
        save_checkpoint(path, settings=self._settings(), tensors=tensors, progress=progress, overwrite=overwrite)
        self.saved = self.step

    def load(self, path: Path) -> None:
        """Go on from the state at `path`, which rank 0 reads; the result is the one an uninterrupted run gives.

        Raises:
            HyrfTrainingError: as `load_checkpoint`.
        """
        saved = self.ranks.run_on_all(
            lambda: load_checkpoint(path, self._settings()) if self.ranks.is_main else ({}, {})
        )
        tensors, progress = self.ranks.broadcast(saved)
        self._restore(tensors)
        self.strategy.load_state_dict(_under(_collected_by(self.ranks.rank), tensors))
        self.step, self.records = progress["step"], progress["records"]
        self.saved = self.step
        self.seconds, self.elapsed = defaultdict(float, progress["seconds"]), progress["elapsed"]
        self.choices |= progress.get("choices", {})
        self.pilots = progress.get("pilots", [])


def _on_cpu(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu() for name, value in tensors.items()}


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Those whose names start so, by the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _collected_by(rank: int) -> str:
    """What names start with in a checkpoint of what a rank has collected for density control."""
    return f"density{rank or ''}."


def _mean_square(error: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Mean of the squares over the pixels (H, W, 3) that count; NaN where none does."""
    squares = error.square()
    if mask is None:
        return squares.mean()
    return torch.where(mask[..., None], squares, 0).sum() / (squares.shape[-1] * mask.sum())
