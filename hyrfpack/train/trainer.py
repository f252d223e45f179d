"""The trainer: one view a step, until the run is done, interrupted or broken."""

from __future__ import annotations

import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hyrfpack.data import PictureCache
from hyrfpack.device import upload, upload_array
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate.metrics import decibels
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.parallel.pool import keep_freed_memory, torch_on_one_thread
from hyrfpack.render import render
from hyrfpack.scene import Picture, Scene, View
from hyrfpack.train.checkpoint import load_checkpoint, save_checkpoint
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.density import DensityControl
from hyrfpack.train.exposure import exposures_for
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.setup import build_model
from hyrfpack.train.strategy import Strategy

RECORDS = 200  # points on the training curve


def shuffled(views: Sequence[View], seed: int, steps: range) -> Iterator[View]:
    """The view of each of these steps, counted from 0: each epoch is a permutation of its own."""
    for step in steps:
        epoch, place = divmod(step, len(views))
        if place == 0 or step == steps.start:
            order = np.random.default_rng((seed, epoch)).permutation(len(views))
        yield views[order[place]]


def is_recorded(step: int, steps: int) -> bool:
    """Whether this step of a run is one of the about RECORDS that are written down, the last one among them."""
    return step % max(1, steps // RECORDS) == 0 or step == steps


class Trainer:
    """Holds a run: model, optimiser, strategy of density control, and the step they are at.

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
    ) -> None:
        """Set up a run.

        Args:
            model: to go on with, changed in place; None builds an untrained one that fits the scene.
            strategy: what adds and removes Gaussians; None for `DensityControl` as configured.
        """
        self.scene = scene
        self.config = config
        self.cache = cache or PictureCache()
        self.device = device
        self.choices: dict[str, str] = {}  # what was chosen for the run, each with its reason
        if model is None:
            model, self.budget, self.choices = build_model(scene, config)
        else:
            self.budget = config.max_gaussians or len(model)
        self.exposures, self.choices["exposure"] = exposures_for(scene, config, self.cache, device)
        self._take(model)
        self.strategy: Strategy = strategy or DensityControl(
            config.density, config.steps, self.budget, len(self.model), config.seed, device
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
        self.optimizer = Optimizer(self.model, self.config.learning_rates)

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(
        self,
        *,
        checkpoint: Path | None = None,
        report: Callable[[Trainer, float, float], None] = lambda trainer, loss, mse: None,
        stop: Callable[[], bool] = lambda: False,
        warn: Callable[[str], None] = warnings.warn,
    ) -> bool:
        """Train until the last step, or until `stop()` says so.

        Args:
            checkpoint: where to keep the run's state; written every `checkpoint_every` steps and when stopped early.
            report: called after each step with the loss and the mean squared error of its view (NaN where the whole
                photo is masked).
            stop: asked after each step.
            warn: told when a checkpoint cannot be written, as on a full disk. Training goes on and tries again at the
                next one, for hours of work are worth more than a checkpoint.

        Returns:
            Whether the run is complete.

        Raises:
            HyrfTrainingError: a parameter, the loss or a gradient is not finite; step, view and group are named.
            HyrfError: stopped early, and the checkpoint cannot be written.
        """
        every = self.config.checkpoint_every or max(1, self.config.steps // 20)
        keep_freed_memory()
        with closing(self.cache.stream(self._order())) as views, torch_on_one_thread():
            while self.step < self.config.steps:
                start = time.perf_counter()
                with self._timed("data"):
                    view, picture = next(views)
                loss, mse = self._train_step(view, picture)
                self.elapsed += time.perf_counter() - start
                self._record(loss, mse)
                report(self, loss, mse)
                complete = self.step == self.config.steps
                stopped = stop() and not complete
                if checkpoint and (stopped or (self.step % every == 0 and not complete)):
                    try:
                        self.save(checkpoint)
                    except HyrfError as error:
                        if stopped:
                            raise
                        warn(f"{error}; training goes on, without the checkpoint of step {self.step:,}")
                if stopped:
                    return False
        return True

    def _order(self) -> Iterator[View]:
        """Views in the order of the steps still to come."""
        return shuffled(self.scene.train, self.config.seed, range(self.step, self.config.steps))

    def _train_step(self, view: View, picture: Picture) -> tuple[float, float]:
        config = self.config
        self.step += 1
        with self._timed("data"):
            solid = self._solid()
            target, mask = upload(picture, solid, self.device)
        try:
            rendering = render(
                self.model,
                view.camera,
                absgrad=self.strategy.watching(self.step),
                solid=None if solid is None else upload_array(solid, self.device),
            )
        except HyrfError:
            self._refuse(view, "a number to be rendered is not finite", self._nonfinite_parameters())
        for stage, seconds in rendering.seconds.items():
            self.seconds[stage] += seconds
        with self._timed("loss"):
            image = rendering.rgb if self.exposures is None else self.exposures.exposed(rendering.rgb, view)
            loss = photometric_loss(image, target, mask, ssim_weight=config.ssim_weight)
        with self._timed("backward"):
            loss.backward()
        with self._timed("density"):
            self.strategy.observe(rendering, view.camera, self.model)
        with self._timed("optimizer"):
            broken = self.optimizer.step(self.step - 1, config.steps)
            if self.exposures is not None:
                rate = config.learning_rates.at("exposure", self.step - 1, config.steps)
                broken = torch.cat((broken, self.exposures.step(rate)[None]))
        with self._timed("loss"):
            # All that the host wants to know of this step, in one wait for the device.
            error = _mean_square(image.detach() - target, mask)
            value, mse, *flags = torch.stack((loss.detach(), error, *broken)).tolist()
        if not np.isfinite(value):
            self._refuse(view, "the loss is not finite", self._nonfinite_parameters())
        if any(flags):
            self._refuse(view, "a gradient is not finite", self._groups(flags))
        with self._timed("density"):
            self.strategy.act(self.step, self.model, self.optimizer)
        return value, mse

    def _record(self, loss: float, mse: float) -> None:
        """Keep what the step came to for the curve, unless all of its photo is masked."""
        steps = self.config.steps
        if not np.isnan(mse) and is_recorded(self.step, steps):
            record = {"step": self.step, "loss": loss, "psnr": decibels(mse), "gaussians": len(self.model)}
            self.records.append({**record, "seconds": round(self.elapsed, 3)})

    def _solid(self) -> np.ndarray | None:
        """The colour behind this step's picture, None when the model has a background of its own."""
        if self.model.config.background:
            return None
        if self.config.background_color == "random":
            return np.random.default_rng((self.config.seed, 1, self.step)).random(3, dtype=np.float32)
        return np.array(self.model.config.solid, np.float32)

    def _groups(self, flags: Sequence[float]) -> list[str]:
        """The parameter groups with a gradient that is not finite."""
        count = len(self.optimizer.groups)
        return self.optimizer.names(flags[:count]) + ["exposure"] * any(flags[count:])

    def _nonfinite_parameters(self) -> list[str]:
        return [name for name, p in self.model.named_parameters() if not torch.isfinite(p).all()]

    def _refuse(self, view: View, what: str, groups: list[str]) -> None:
        where = ", ".join(groups) if groups else "none; look at the photo itself"
        raise HyrfTrainingError(
            f"training stopped at step {self.step} on view '{view.name}': {what} (parameter groups: {where}); "
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
        return {**self.config.to_dict(), "views": views, "strategy": type(self.strategy).__qualname__, **chosen}

    def save(self, path: Path) -> None:
        """Write the run's state to `path`."""
        tensors: dict[str, Tensor] = {f"model.{name}": p for name, p in self.model.named_parameters()}
        tensors |= {f"adam.{name}": value for name, value in self.optimizer.state_dict().items()}
        if self.exposures is not None:
            tensors |= {f"exposure.{name}": value for name, value in self.exposures.state_dict().items()}
        tensors |= {f"density.{name}": value for name, value in self.strategy.state_dict().items()}
        progress = {
            "step": self.step,
            "records": self.records,
            "seconds": dict(self.seconds),
            "elapsed": self.elapsed,
            "choices": self.choices,
        }
        tensors = {name: value.detach().cpu() for name, value in tensors.items()}
        save_checkpoint(path, settings=self._settings(), tensors=tensors, progress=progress)
        self.saved = self.step

    def load(self, path: Path) -> None:
        """Go on from the state at `path`; the result is the one an uninterrupted run gives.

        Raises:
            HyrfTrainingError: as `load_checkpoint`.
        """
        tensors, progress = load_checkpoint(path, self._settings())
        explicit = [tensors[f"model.gaussians.{name}"] for name in Gaussians.NAMES]
        model = HybridModel(self.model.config, Gaussians(*explicit))
        model.load_state_dict(
            {name.removeprefix("model."): value for name, value in tensors.items() if name.startswith("model.")}
        )
        self._take(model)
        self.optimizer.load_state_dict(
            {name.removeprefix("adam."): value for name, value in tensors.items() if name.startswith("adam.")}
        )
        if self.exposures is not None:
            self.exposures.load_state_dict(
                {n.removeprefix("exposure."): value for n, value in tensors.items() if n.startswith("exposure.")}
            )
        self.strategy.load_state_dict(
            {name.removeprefix("density."): value for name, value in tensors.items() if name.startswith("density.")}
        )
        self.step, self.records = progress["step"], progress["records"]
        self.saved = self.step
        self.seconds, self.elapsed = defaultdict(float, progress["seconds"]), progress["elapsed"]
        self.choices |= progress.get("choices", {})


def _mean_square(error: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Mean of the squares over the pixels (H, W, 3) that count; NaN where none does."""
    squares = error.square()
    if mask is None:
        return squares.mean()
    return torch.where(mask[..., None], squares, 0).sum() / (squares.shape[-1] * mask.sum())
