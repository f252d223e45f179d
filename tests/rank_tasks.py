"""Functions that tests run in several processes by `rank_processes.run_on_ranks`."""

from __future__ import annotations

import dataclasses
import logging
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
import torch.distributed as dist
from scenes import alternating_gains, ball_scene, exposed_scene, visible_points_by_photo

from hyrfpack.blocks import train_blocks
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.parallel.ranks import Ranks, join_processes
from hyrfpack.progress import Event, Progress, StepEvent, TaskEvent
from hyrfpack.scene import Picture, Scene
from hyrfpack.train import (
    DensityConfig,
    TrainConfig,
    Trainer,
    budget_pilots,
    decisions,
    gradients,
    teachers,
    train_model,
)
from hyrfpack.train import trainer as trainers
from hyrfpack.train.distributed import average_gradients, digest

DENSITY_CONFIG = DensityConfig(start=0.05, stop=0.68, peak=0.4, excess=1.5, rounds=5, gradient=1e-5, resets=1)
# Two processes take 60 steps. Density control acts after every 7th step from 3 to 38, and the last rounds prune.
SIX_PHOTO_CONFIG = TrainConfig(steps=400, seed=3, max_gaussians=80, density=DENSITY_CONFIG)
# Three photos for two processes, so that in some steps both render the same photo.
EXPOSURE_CONFIG = dataclasses.replace(SIX_PHOTO_CONFIG, steps=59, exposure=True)
RUN_CONFIG = dataclasses.replace(SIX_PHOTO_CONFIG, steps=60, checkpoint_every=5)
BLOCK_CONFIG = TrainConfig(
    steps=12, seed=1, max_gaussians=150, exposure=True, preset="standard", checkpoint_every=1,
    density=DensityConfig(start=0.1, rounds=3, gradient=1e-5),
)  # fmt: skip


def six_photo_scene() -> Scene:
    return ball_scene(views=6, points=60, side=24)


def three_photo_scene() -> Scene:
    return exposed_scene(alternating_gains(3), side=32, points=60)


def held_out_scene() -> Scene:
    scene = ball_scene(views=7, points=60, side=24)
    return dataclasses.replace(scene, train=scene.train[2:], test=scene.train[:2])


def block_scene() -> Scene:
    """Return a scene of ten training photos and two held-out photos, with tracks."""
    scene = ball_scene(views=12, points=80, side=16)
    tracks = visible_points_by_photo(scene, facing=0.2)
    return dataclasses.replace(scene, train=scene.train[2:], test=scene.train[:2], tracks=tracks)


def error_message(work: Callable[[], object]) -> str | None:
    """Call a function and return the text of the HyrfError that it raises, or None."""
    try:
        work()
    except HyrfError as error:
        return str(error)
    return None


# -- collective operations -------------------------------------------------------------------------------------------


def call_collectives(ranks: Ranks) -> dict:
    """Call each collective operation once and return what it gives."""

    def refuse(who: int) -> Callable[[], None]:
        def work() -> None:
            if ranks.rank >= who:
                raise HyrfDataError(f"photo {ranks.rank} is bad", fix="replace it")

        return work

    weight, idle = torch.nn.Parameter(torch.zeros(2, 3)), torch.nn.Parameter(torch.zeros(2))
    weight.grad = torch.full((2, 3), float(ranks.rank))
    sums = average_gradients(ranks, [weight, idle], torch.tensor([1.0, ranks.rank]))
    with join_processes() as again:
        pass
    return {
        "ranks": ranks,
        "joined again": again,
        "still initialized": dist.is_initialized(),
        "gathered": ranks.all_gather({"rank": ranks.rank}),
        "broadcast": ranks.broadcast(("by", ranks.rank)),
        "summed": ranks.all_reduce(torch.tensor([1.0, ranks.rank])).tolist(),
        "returned": ranks.run_on_all(lambda: ranks.rank * 10),
        "returned by the main process": ranks.run_on_main(lambda: ("rank", ranks.rank)),
        "error on the last": error_message(lambda: ranks.run_on_all(refuse(ranks.size - 1))),
        "error on all": error_message(lambda: ranks.run_on_all(refuse(0))),
        "error on the main process": error_message(lambda: ranks.run_on_main(refuse(0))),
        "averaged": weight.grad.tolist(),
        "averaged of idle": None if idle.grad is None else idle.grad.tolist(),
        "sums": sums.tolist(),
        "threads": os.environ["HYRFPACK_THREADS"],
    }


def exit_one_rank(ranks: Ranks, leaver: int) -> None:
    """End one process silently, while the others call a collective operation."""
    ranks.all_gather("here")
    if ranks.rank == leaver:
        os._exit(0)
    ranks.all_reduce(torch.ones(3))


def exit_one_rank_while_others_wait(ranks: Ranks, leaver: int, how: str) -> float:
    """End one process, while the others wait for something that is not a collective operation, as for a GPU.

    Returns:
        The seconds after which this process has noticed, or -1 if it has not noticed within a minute.
    """
    ranks.all_gather("here")
    if ranks.rank == leaver:
        if how == "error":
            raise HyrfDataError("photo 3 is bad", fix="replace it")
        if how == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        return 0.0
    start = time.monotonic()
    while time.monotonic() < start + (60 if how != "leave" else 1):
        if error_message(ranks.raise_if_lost) is not None:
            return time.monotonic() - start
        time.sleep(0.01)
    return -1.0


def collect_after_a_loss(ranks: Ranks) -> str | None:
    """Let process 1 be killed; return the error of process 0's next collective operation."""
    ranks.all_gather("here")
    if ranks.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    while error_message(ranks.raise_if_lost) is None:
        time.sleep(0.01)
    return error_message(lambda: ranks.all_reduce(torch.ones(3)))


# -- training --------------------------------------------------------------------------------------------------------


def record_training(ranks: Ranks, scene: Scene, config: TrainConfig, broken: Picture | None = None) -> dict:
    """Train a run and return its curve, a digest of the parameters after each step and the final parameters.

    Args:
        broken: takes the place of the fourth photo once the run is set up.
    """
    trainer, rows, digests = Trainer(scene, config, ranks=ranks), [], []
    if broken is not None:
        scene.train[3] = dataclasses.replace(scene.train[3], load=lambda: broken)

    def report(event: StepEvent) -> None:
        rows.append((event.loss, event.mse, event.gaussians))
        digests.append(digest(trainer.model.parameters()))

    assert trainer.run(progress=report)
    gains = None if trainer.exposures is None else trainer.exposures.values.detach().numpy()
    parameters = {name: p.detach().numpy() for name, p in trainer.model.named_parameters()}
    return {"rows": rows, "digests": digests, "gains": gains, "records": trainer.records, "parameters": parameters}


def train_both_scenes(ranks: Ranks) -> list[dict]:
    return [
        record_training(ranks, six_photo_scene(), SIX_PHOTO_CONFIG),
        record_training(ranks, three_photo_scene(), EXPOSURE_CONFIG),
    ]


def digest_of_first_model(ranks: Ranks) -> str:
    """Return the digest of an untrained model, for which each rank would draw other points."""
    config = dataclasses.replace(SIX_PHOTO_CONFIG, seed=ranks.rank, max_gaussians=2 * len(six_photo_scene().points))
    return digest(Trainer(six_photo_scene(), config, ranks=ranks).model.parameters())


def signal_at_step(number: int, at: int) -> Progress:
    """Return a progress function that sends its own process a signal after a step."""

    def progress(event: Event) -> None:
        if isinstance(event, StepEvent) and event.step == at:
            os.kill(os.getpid(), number)

    return progress


def cpu_context(ranks: Ranks, progress: Progress | None = None, device: str = "cpu") -> RunContext:
    return RunContext(device=device, ranks=ranks, progress=progress)


def train_run(ranks: Ranks, out: Path, resume: bool = False, overwrite: bool = False) -> tuple[bool, int, bool]:
    result = train_model(
        held_out_scene(),
        out,
        RUN_CONFIG,
        resume=resume,
        overwrite=overwrite,
        context=cpu_context(ranks),
    )
    assert not result.complete or result.model.is_file(), "a process returned before the model was written"
    return result.complete, result.step, bool(result.metrics)


def train_and_kill(ranks: Ranks, out: Path, who: int, step: int) -> None:
    progress = signal_at_step(signal.SIGKILL, step) if ranks.rank == who else None
    train_model(held_out_scene(), out, RUN_CONFIG, context=cpu_context(ranks, progress))


def stop_and_resume(ranks: Ranks, whole: Path, parts: Path, alone: Path) -> dict:
    """Train one run without a stop, and one that rank 1 stops twice; resume one that a single process has started.

    Returns:
        For each run whether it completed, its last step and whether it has metrics; the errors; whether the checkpoint
        is kept.
    """
    said = {"whole": train_run(ranks, whole)}
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # All ranks receive the stop with the next step: before the first regular checkpoint, and between density rounds.
    for name, step in (("first", 2), ("second", 16)):
        context = cpu_context(ranks, signal_at_step(signal.SIGTERM, step) if ranks.rank == 1 else None)
        result = train_model(held_out_scene(), parts, RUN_CONFIG, resume=name == "second", context=context)
        said[name] = result.complete, result.step, bool(result.metrics)
    said["other size"] = error_message(lambda: train_run(ranks, alone, resume=True))
    said["there already"] = error_message(lambda: train_run(ranks, whole))
    said["checkpoint stays"] = ranks.run_on_all((parts / "checkpoint.pt").is_file)
    return said


def resume_pilots(ranks: Ranks, whole: Path, parts: Path) -> list[int]:
    """Train one run without a stop, and one that both ranks stop in the second pilot run and then resume.

    Returns:
        The numbers of the pilot runs that this rank takes in the resumed run.
    """
    decisions.MIN_BUDGET_STEPS, budget_pilots.BUDGET_PILOT_STEPS = 10, 6
    scene, config = ball_scene(views=10, points=60, side=24), TrainConfig(steps=10)
    train_model(scene, whole, config, context=cpu_context(ranks))
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def stop_in_second_pilot(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.task == "budget pilot run 2/2: training" and event.done == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    stopped = train_model(scene, parts, config, context=cpu_context(ranks, stop_in_second_pilot))
    assert not stopped.complete
    numbers: list[int] = []

    def number_pilots(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.task.startswith("budget pilot run"):
            numbers.append(int(event.task.split()[3].split("/")[0]))

    train_model(scene, parts, config, resume=True, context=cpu_context(ranks, number_pilots))
    return sorted(set(numbers))


def resume_teachers(ranks: Ranks, whole: Path, parts: Path) -> list[int]:
    """Train one run with teachers without a stop, and one that rank 1 stops in the second teacher run, then resume it.

    Returns:
        The numbers of the teacher runs that the resumed run takes.
    """
    teachers.usual_steps, teachers.TEACHER_STEPS = lambda _: 12, 8
    scene, config = six_photo_scene(), dataclasses.replace(SIX_PHOTO_CONFIG, steps=12)
    train_model(scene, whole, config, context=cpu_context(ranks))
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def stop_in_second_teacher(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.task == "teacher run 2/3: training" and event.done == 2:
            os.kill(os.getpid(), signal.SIGTERM)

    context = cpu_context(ranks, stop_in_second_teacher if ranks.rank == 1 else None)
    assert not train_model(scene, parts, config, context=context).complete
    numbers: list[int] = []

    def number_teachers(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.task.startswith("teacher run") and event.done == 1:
            numbers.append(int(event.task.removeprefix("teacher run ")[0]))

    train_model(scene, parts, config, resume=True, context=cpu_context(ranks, number_teachers))
    return numbers


def log_lost_checkpoints(ranks: Ranks, checkpoint: Path) -> list[str]:
    """Train three steps, after the first two of which a checkpoint is due; return the messages of this process."""
    messages: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    logging.getLogger("hyrfpack").addHandler(handler)
    config = dataclasses.replace(RUN_CONFIG, steps=6, checkpoint_every=1)
    Trainer(six_photo_scene(), config, ranks=ranks).run(checkpoint=checkpoint)
    return messages


def train_after_restart(ranks: Ranks, out: Path) -> list[tuple[bool, int, bool]]:
    """Train as after a restart by torchrun, first in an empty folder, then in one with a checkpoint."""
    again = dataclasses.replace(ranks, restarts=1)
    steps: list[int] = []

    def record_step(event: Event) -> None:
        steps.extend([event.step] if isinstance(event, StepEvent) else [])

    first = train_model(
        held_out_scene(),
        out / "none",
        dataclasses.replace(RUN_CONFIG, steps=4),
        context=cpu_context(again),
    )
    train_model(
        held_out_scene(),
        out / "some",
        RUN_CONFIG,
        context=cpu_context(again, record_step),
    )
    return [first.step, steps]


# -- errors ----------------------------------------------------------------------------------------------------------


def collect_errors(ranks: Ranks) -> dict[str, str | None]:
    """Return the error of each input that one rank alone, or all ranks, cannot use."""

    def unreadable() -> NoReturn:
        raise HyrfDataError("003.png: cannot be read", fix="replace it")

    def scene_with(load: Callable[[], Picture]) -> Scene:
        scene = six_photo_scene()
        view = scene.train[3]
        scene.train[3] = dataclasses.replace(view, load=load)
        return scene

    broken = np.array(six_photo_scene().train[3].load().rgb, np.float32)
    broken[3, 5, 1] = np.nan
    short = dataclasses.replace(SIX_PHOTO_CONFIG, steps=12)
    mine = ranks.rank == 1
    fewer = dataclasses.replace(six_photo_scene(), train=six_photo_scene().train[:5])
    cases: dict[str, Callable[[], object]] = {
        "photo": lambda: record_training(ranks, scene_with(unreadable) if mine else six_photo_scene(), short),
        "nan": lambda: record_training(ranks, six_photo_scene(), short, Picture(broken)),
        "nan on one": lambda: record_training(ranks, six_photo_scene(), short, Picture(broken) if mine else None),
        "seed": lambda: record_training(
            ranks, six_photo_scene(), dataclasses.replace(short, seed=4) if mine else short
        ),
        "photos": lambda: record_training(ranks, fewer if mine else six_photo_scene(), short),
    }
    said = {name: error_message(case) for name, case in cases.items()}
    version, trainers.__version__ = trainers.__version__, "0.0" if mine else trainers.__version__
    said["version"] = error_message(lambda: record_training(ranks, six_photo_scene(), short))
    trainers.__version__ = version
    drawing = gradients.render_view
    if mine:
        gradients.render_view = _run_out_of_memory
    said["memory"] = error_message(lambda: record_training(ranks, six_photo_scene(), short))
    gradients.render_view = drawing
    said["checkpoint"] = error_message(lambda: Trainer(six_photo_scene(), short, ranks=ranks).load(Path("nowhere.pt")))
    said["none"] = error_message(lambda: record_training(ranks, six_photo_scene(), short))
    return said


def _run_out_of_memory(*arguments: object, **options: object) -> NoReturn:
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")


def collect_setup_errors(ranks: Ranks, out: Path) -> dict[str, str | None]:
    """Return the errors with which `train` ends on all ranks before the first step."""
    scene = held_out_scene()
    held_out = [dataclasses.replace(scene.test[0], load=_unreadable)]
    bad = dataclasses.replace(scene, test=held_out)
    return {
        "held out": error_message(lambda: train_model(bad, out, RUN_CONFIG, context=cpu_context(ranks))),
        "nothing to resume": error_message(lambda: train_run(ranks, out, resume=True)),
        "device": error_message(
            lambda: train_model(
                held_out_scene(),
                out,
                RUN_CONFIG,
                context=cpu_context(ranks, device="what" if ranks.rank else "cpu"),
            )
        ),
    }


def _unreadable() -> NoReturn:
    raise HyrfDataError("held.png: cannot be read", fix="replace it")


# -- training in blocks ----------------------------------------------------------------------------------------------


def train_two_blocks(ranks: Ranks, out: Path, lost_at_step: int | None) -> tuple[bool, int]:
    """Train two blocks, and return whether all is complete and the number of steps of this rank.

    Args:
        lost_at_step: the step after which rank 1 is killed; None for no step.
    """
    steps = 0

    def count(event: Event) -> None:
        nonlocal steps
        steps += isinstance(event, StepEvent)
        if steps == lost_at_step and ranks.rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)

    context = RunContext(progress=count, ranks=ranks)
    return train_blocks(block_scene(), out, BLOCK_CONFIG, "2x1", context=context).complete, steps
