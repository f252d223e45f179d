"""Train a full run on the real data set on the GPU, as far as the time allows, and score it at intervals."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean

from hyrfpack.measure.psnr import psnr_from_mse
from tools.gpu.rows import Row
from tools.gpu.setup import Setup

TABLE_NAME = "Full run"


def items(setup: Setup) -> list[str]:
    """Return the one item, the folder of the real data set; "no data set" if there is none."""
    return [setup.data or "no data set"]


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield a row after each `full_run_interval` seconds of training, until `full_run_seconds` or the last step.

    Each interval ends with a checkpoint in the folder for temporary files, from which a later call on this machine
    of the same commit resumes.
    """
    if setup.data is None:
        yield {"table": TABLE_NAME, "status": "left out", "note": "name a real data set with --data"}
        return
    from hyrfpack.data import load_scene
    from hyrfpack.evaluate import evaluate_model
    from hyrfpack.train import TrainConfig, Trainer

    end = time.perf_counter() + setup.full_run_seconds
    scene = load_scene(item)
    trainer = Trainer(scene, TrainConfig(steps=setup.full_run_steps), device=setup.torch_device)
    commit = re.sub(r"[^\w.-]", "_", setup.commit)
    name = f"hyrfpack-gpu-{Path(item).name}-{setup.full_run_steps}-{commit}.checkpoint"
    checkpoint = Path(tempfile.gettempdir(), name)
    if checkpoint.exists():
        trainer.load(checkpoint)
    ended = False
    while not ended:
        start, first_step, errors = time.perf_counter(), trainer.step, list[float]()
        stop = min(end, start + setup.full_run_interval)
        trainer.run(
            checkpoint=checkpoint,
            progress=lambda event, errors=errors: errors.append(event.mse),
            stop=lambda stop=stop: time.perf_counter() >= stop,
        )
        seconds = time.perf_counter() - start
        yield {
            "table": TABLE_NAME,
            "set": Path(item).name,
            "step": f"{trainer.step:,} of {trainer.steps:,}",
            "training seconds": trainer.elapsed,
            "steps/s": (trainer.step - first_step) / seconds,
            "Gaussians": f"{len(trainer.model):,}",
            "PSNR of training photos": f"{psnr_from_mse(fmean(errors)):.2f} dB",
            "PSNR of held-out photos": f"{evaluate_model(trainer.model, scene.test).psnr:.3f} dB",
        }
        ended = trainer.step == trainer.steps or time.perf_counter() >= end
    if trainer.step == trainer.steps:
        checkpoint.unlink(missing_ok=True)
