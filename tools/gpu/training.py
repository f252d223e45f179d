"""Time training steps of a given model by the wall clock."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import fmean

from hyrfpack.config.train import FULL_STEPS
from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.model import HybridModel
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, Trainer
from tools.gpu.rows import Row, make_goal_row, make_kernel_rows
from tools.gpu.setup import GOAL_ROOM_NAME, Setup
from tools.gpu.timing import Profile, profile_task, read_peak_memory_mb, reset_peak_memory, synchronize

GOAL_MINUTES = 10.0
PROFILED_STEPS = 5
WARM_LAUNCHED_STEPS, LAUNCHED_STEPS = 5, 100


@dataclass(frozen=True)
class TimedTraining:
    """Result of a timed training run.

    Attributes:
        room: name of the room, such as "1,000,000".
        model: the trained model.
        steps: number of timed steps, which a GPU replays.
        seconds: wall-clock time of these steps.
        launched_rate: steps per second that are launched one by one; None where no step is replayed.
        psnr: PSNR in dB on training photos, at the beginning and at the end.
        stages: seconds of each stage as the host measures them, longest first.
        peak: peak memory of tensors in MB; None on a CPU.
        profile: kernels of PROFILED_STEPS steps together.
    """

    room: str
    model: HybridModel
    steps: int
    seconds: float
    launched_rate: float | None
    psnr: tuple[float, float]
    stages: dict[str, float]
    peak: float | None
    profile: Profile

    def rows(self) -> Iterator[Row]:
        """Yield the row of the run, its goal if it has one, and the rows of its kernels."""
        rate = self.steps / self.seconds
        minutes = FULL_STEPS / rate / 60
        full = f"{minutes:.1f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
        total = sum(self.stages.values())
        yield {
            "table": "Training",
            "Gaussians": self.room,
            "steps timed": self.steps,
            "steps/s": rate,
            "steps/s, launched": self.launched_rate,
            "30,000 steps": full,
            "PSNR before, after": f"{self.psnr[0]:.1f}, {self.psnr[1]:.1f} dB",
            "peak MB": self.peak,
            "launches, waits a step": self._format_launches(),
            "host's time": ", ".join(f"{stage} {seconds / total:.0%}" for stage, seconds in self.stages.items()),
        }
        if self.room == GOAL_ROOM_NAME:
            yield make_goal_row(f"30,000 steps of {self.room} Gaussians", minutes, GOAL_MINUTES, "min", at_least=False)
        kernels = {name: ms / PROFILED_STEPS for name, ms in self.profile.times.items()}
        yield from make_kernel_rows(kernels, f"A training step of {self.room} Gaussians: kernels on the device")

    def _format_launches(self) -> str | None:
        if not self.profile.times:
            return None
        return f"{self.profile.launches / PROFILED_STEPS:.0f}, {self.profile.waits / PROFILED_STEPS:.1f}"


def time_training(room: str, scene: Scene, model: HybridModel, setup: Setup) -> TimedTraining:
    """Train `model` on the scene: first warm-up steps, then timed steps, then a few steps under the profiler."""
    device, count = setup.torch_device, len(model)
    trainer = Trainer(
        scene, TrainConfig(steps=FULL_STEPS, max_gaussians=count, resolution_schedule=False), device=device, model=model
    )
    errors: list[float] = []
    advance(trainer, setup.warm_steps, setup.step_seconds / 3, errors)
    reset_peak_memory(device)
    stages = dict(trainer.seconds)
    steps, seconds = _time_steps(trainer, setup.steps, setup.step_seconds, errors)
    peak = read_peak_memory_mb(device)
    stages = {name: value - stages.get(name, 0.0) for name, value in trainer.seconds.items()}
    launched_rate = None
    if trainer.renderer.replays_steps:
        trainer.renderer.replays_steps = False
        advance(trainer, WARM_LAUNCHED_STEPS, setup.step_seconds / 3, [])
        launched, launched_seconds = _time_steps(trainer, LAUNCHED_STEPS, setup.step_seconds / 3, [])
        launched_rate = launched / launched_seconds
        trainer.renderer.replays_steps = True
    profile = profile_task(lambda: advance(trainer, PROFILED_STEPS, setup.step_seconds, []), 1, device)
    return TimedTraining(
        room=room,
        model=trainer.model,
        steps=steps,
        seconds=seconds,
        launched_rate=launched_rate,
        psnr=(psnr_from_mse(fmean(errors[:5])), psnr_from_mse(fmean(errors[-5:]))),
        stages=dict(sorted(stages.items(), key=lambda item: -item[1])),
        peak=peak,
        profile=profile,
    )


def _time_steps(trainer: Trainer, steps: int, seconds: float, errors: list[float]) -> tuple[int, float]:
    """Do what `advance` does; return the number of steps and their wall-clock time in seconds."""
    synchronize(trainer.device)
    first_step, start = trainer.step, time.perf_counter()
    advance(trainer, steps, seconds, errors)
    synchronize(trainer.device)
    return trainer.step - first_step, time.perf_counter() - start


def advance(trainer: Trainer, steps: int, seconds: float, errors: list[float]) -> None:
    """Take `steps` steps, or as many as fit into `seconds`; append each step's mean squared error to `errors`."""
    last, end = trainer.step + steps, time.perf_counter() + seconds
    trainer.run(
        progress=lambda event: errors.append(event.mse),
        stop=lambda: trainer.step >= last or time.perf_counter() >= end,
    )
