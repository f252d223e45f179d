"""What `ranked.together` has several processes do."""

from __future__ import annotations

import dataclasses
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
import torch.distributed as dist
from scenes import alternating, ball_scene, exposed_scene

from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.parallel.ranks import Ranks, join_processes
from hyrfpack.scene import Picture, Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer, train
from hyrfpack.train import trainer as trainers
from hyrfpack.train.distributed import average_gradients, digest

DENSITY = DensityConfig(start=0.05, stop=0.68, peak=0.4, excess=1.5, rounds=5, gradient=1e-5, resets=1)
# Two processes take 60 steps, with rounds of density control after each 7th from 3 to 38, of which the last take away.
EVEN = TrainConfig(steps=400, seed=3, max_gaussians=80, density=DENSITY)
# Three photos for two processes: in some steps both have the same.
EXPOSED = dataclasses.replace(EVEN, steps=59, exposure=True)
RUN = dataclasses.replace(EVEN, steps=60, checkpoint_every=5)


def even_scene() -> Scene:
    return ball_scene(views=6, points=60, side=24)


def three_photos() -> Scene:
    return exposed_scene(alternating(3), side=32, points=60)


def run_scene() -> Scene:
    scene = ball_scene(views=7, points=60, side=24)
    return dataclasses.replace(scene, train=scene.train[2:], test=scene.train[:2])


def sentence_of(work: Callable[[], object]) -> str | None:
    """Of the error that it raises."""
    try:
        work()
    except HyrfError as error:
        return str(error)
    return None


# -- what ranks tell each other --------------------------------------------------------------------------------------


def talk(ranks: Ranks) -> dict:
    """Everything they can say, once each."""

    def refuse(who: int) -> Callable[[], None]:
        def work() -> None:
            if ranks.rank >= who:
                raise HyrfDataError(f"photo {ranks.rank} is bad")

        return work

    weight, idle = torch.nn.Parameter(torch.zeros(2, 3)), torch.nn.Parameter(torch.zeros(2))
    weight.grad = torch.full((2, 3), float(ranks.rank))
    sums = average_gradients(ranks, [weight, idle], torch.tensor([1.0, ranks.rank]))
    with join_processes() as again:
        pass
    return {
        "ranks": ranks,
        "again": again,
        "still there": dist.is_initialized(),
        "told": ranks.all_gather({"rank": ranks.rank}),
        "first": ranks.broadcast(("by", ranks.rank)),
        "added": ranks.all_reduce(torch.tensor([1.0, ranks.rank])).tolist(),
        "agreed": ranks.run_on_all(lambda: ranks.rank * 10),
        "refused by the last": sentence_of(lambda: ranks.run_on_all(refuse(ranks.size - 1))),
        "refused by all": sentence_of(lambda: ranks.run_on_all(refuse(0))),
        "averaged": weight.grad.tolist(),
        "averaged of idle": None if idle.grad is None else idle.grad.tolist(),
        "sums": sums.tolist(),
        "threads": os.environ["HYRFPACK_THREADS"],
    }


def leave(ranks: Ranks, leaver: int) -> None:
    """One ends without a word, and the others ask on."""
    ranks.all_gather("here")
    if ranks.rank == leaver:
        os._exit(0)
    ranks.all_reduce(torch.ones(3))


# -- training --------------------------------------------------------------------------------------------------------


def steps_of(ranks: Ranks, scene: Scene, config: TrainConfig) -> dict:
    """The numbers of each step of a run, and the bits that it ends with."""
    trainer, rows, digests = Trainer(scene, config, ranks=ranks), [], []

    def report(trainer: Trainer, loss: float, error: float) -> None:
        rows.append((loss, error, len(trainer.model)))
        digests.append(digest(trainer.model.parameters()))

    assert trainer.run(report=report)
    gains = None if trainer.exposures is None else trainer.exposures.values.detach().numpy()
    parameters = {name: p.detach().numpy() for name, p in trainer.model.named_parameters()}
    return {"rows": rows, "digests": digests, "gains": gains, "records": trainer.records, "parameters": parameters}


def train_both(ranks: Ranks) -> list[dict]:
    return [steps_of(ranks, even_scene(), EVEN), steps_of(ranks, three_photos(), EXPOSED)]


def ended_by(number: int, at: int) -> Callable[[int, float, float, int], None]:
    """A report that sends its own process a signal after a step."""

    def report(step: int, loss: float, error: float, gaussians: int) -> None:
        if step == at:
            os.kill(os.getpid(), number)

    return report


def quiet(step: int, loss: float, error: float, gaussians: int) -> None:
    pass


def run(ranks: Ranks, out: Path, resume: bool = False, overwrite: bool = False) -> tuple[bool, int, bool]:
    result = train(run_scene(), out, RUN, ranks=ranks, resume=resume, overwrite=overwrite, device="cpu", report=quiet)
    return result.complete, result.step, bool(result.metrics)


def run_and_die(ranks: Ranks, out: Path, who: int, step: int) -> None:
    report = ended_by(signal.SIGKILL, step) if ranks.rank == who else quiet
    train(run_scene(), out, RUN, ranks=ranks, device="cpu", report=report)


def stop_and_resume(ranks: Ranks, whole: Path, parts: Path, alone: Path) -> dict:
    """A run of one piece; one of which rank 1 alone is told to stop, twice; one that a single process began."""
    said = {"whole": run(ranks, whole)}
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # All hear of it with the next step: they stop before the first regular checkpoint, and between rounds.
    for name, step in (("first", 2), ("second", 16)):
        report = ended_by(signal.SIGTERM, step) if ranks.rank == 1 else quiet
        result = train(run_scene(), parts, RUN, ranks=ranks, resume=name == "second", device="cpu", report=report)
        said[name] = result.complete, result.step, bool(result.metrics)
    said["other size"] = sentence_of(lambda: run(ranks, alone, resume=True))
    said["there already"] = sentence_of(lambda: run(ranks, whole))
    said["checkpoint stays"] = ranks.run_on_all((parts / "checkpoint.pt").is_file)
    return said


def started_anew(ranks: Ranks, out: Path) -> list[tuple[bool, int, bool]]:
    """As torchrun starts them again, first where nothing is left, then where the last run was stopped."""
    again = dataclasses.replace(ranks, restarts=1)
    steps: list[int] = []
    first = train(run_scene(), out / "none", dataclasses.replace(RUN, steps=4), ranks=again, device="cpu", report=quiet)
    train(run_scene(), out / "some", RUN, ranks=again, device="cpu", report=lambda step, *_: steps.append(step))
    return [first.step, steps]


# -- refusals --------------------------------------------------------------------------------------------------------


def refusals(ranks: Ranks) -> dict[str, str | None]:
    """The sentence of each thing that one rank alone, or all, cannot take."""

    def unreadable() -> NoReturn:
        raise HyrfDataError("003.png: cannot be read")

    def scene_with(load: Callable[[], Picture]) -> Scene:
        scene = even_scene()
        view = scene.train[3]
        scene.train[3] = dataclasses.replace(view, load=load)
        return scene

    broken = np.array(even_scene().train[3].load().rgb, np.float32)
    broken[3, 5, 1] = np.nan
    short = dataclasses.replace(EVEN, steps=12)
    mine = ranks.rank == 1
    fewer = dataclasses.replace(even_scene(), train=even_scene().train[:5])
    cases: dict[str, Callable[[], object]] = {
        "photo": lambda: steps_of(ranks, scene_with(unreadable) if mine else even_scene(), short),
        "nan": lambda: steps_of(ranks, scene_with(lambda: Picture(broken)), short),
        "nan on one": lambda: steps_of(ranks, scene_with(lambda: Picture(broken)) if mine else even_scene(), short),
        "seed": lambda: steps_of(ranks, even_scene(), dataclasses.replace(short, seed=4) if mine else short),
        "photos": lambda: steps_of(ranks, fewer if mine else even_scene(), short),
    }
    said = {name: sentence_of(case) for name, case in cases.items()}
    version, trainers.__version__ = trainers.__version__, "0.0" if mine else trainers.__version__
    said["version"] = sentence_of(lambda: steps_of(ranks, even_scene(), short))
    trainers.__version__ = version
    said["checkpoint"] = sentence_of(lambda: Trainer(even_scene(), short, ranks=ranks).load(Path("nowhere.pt")))
    said["none"] = sentence_of(lambda: steps_of(ranks, even_scene(), short))
    return said


def refused_set_up(ranks: Ranks, out: Path) -> dict[str, str | None]:
    """What `train` refuses before the first step, on all ranks alike."""
    scene = run_scene()
    held_out = [dataclasses.replace(scene.test[0], load=_unreadable)]
    bad = dataclasses.replace(scene, test=held_out)
    return {
        "held out": sentence_of(lambda: train(bad, out, RUN, ranks=ranks, device="cpu", report=quiet)),
        "nothing to resume": sentence_of(lambda: run(ranks, out, resume=True)),
        "device": sentence_of(
            lambda: train(run_scene(), out, RUN, ranks=ranks, device="what" if ranks.rank else "cpu", report=quiet)
        ),
    }


def _unreadable() -> NoReturn:
    raise HyrfDataError("held.png: cannot be read")
