"""Compare PSNR on held-out photos of the same training run on the CPU and on the GPU, in each precision."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from hyrfpack.parallel import has_numba
from hyrfpack.scene import Scene
from tools.gpu.rows import Row
from tools.gpu.setup import Setup
from tools.gpu.timing import synchronize

PROBE_STEPS = 25  # timed on the CPU, to estimate how many steps its time limit allows
LATE_STEP_TIME_RATIO = 2.0  # late steps take about twice as long as the first ones, because there are more Gaussians
MIN_STEPS = 100
# Rounding alone can decide which Gaussian is split, so two equal runs differ by tenths of a dB.
MAX_PSNR_LOSS_DB = 0.3


def items(setup: Setup) -> list[str]:
    """Return the items: the folder of the real data set if there is one, then the built-in scene.

    The first item takes the time that Numba needs to compile the CPU's kernels.
    """
    return [*([setup.data] if setup.data else []), "demo"]


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield the rows of one data set: the CPU's run, then the GPU's run in each precision."""
    if not has_numba():
        note = "it needs Numba, because the CPU's training run takes too long without it"
        yield {"table": "Quality", "set": item, "status": "left out", "note": note}
        return
    from hyrfpack.data import load_scene
    from hyrfpack.demo.scene import write_demo_scene

    with tempfile.TemporaryDirectory(prefix="hyrfpack-gpu-") as folder:
        if item == "demo":
            write_demo_scene(folder, views=setup.demo_views, size=setup.demo_size)
        scene = load_scene(folder if item == "demo" else item)
        name = "built-in" if item == "demo" else Path(item).name
        yield from _compare_devices(name, scene, setup)


def _compare_devices(name: str, scene: Scene, setup: Setup) -> Iterator[Row]:
    cpu = torch.device("cpu")
    steps = _affordable_steps(scene, setup)
    baseline, row = _train(scene, steps, "float32", cpu)
    yield {"table": "Quality", "set": name, "steps": steps, "run": "CPU", **row}
    for precision in ("float32", "mixed"):
        psnr, row = _train(scene, steps, precision, setup.torch_device)
        row = {"table": "Quality", "set": name, "steps": steps, "run": f"GPU, {precision}", **row}
        row["against the CPU"] = f"{psnr - baseline:+.3f} dB"
        if not psnr >= baseline - MAX_PSNR_LOSS_DB:
            row |= {"status": "failed", "note": f"its PSNR is more than {MAX_PSNR_LOSS_DB} dB below the CPU's"}
        yield row


def _affordable_steps(scene: Scene, setup: Setup) -> int:
    """Return the number of steps: `quality_steps`, or as many as the CPU can take in `quality_seconds`."""
    _train(scene, 2, "float32", torch.device("cpu"))  # the first run compiles the kernels
    _, row = _train(scene, PROBE_STEPS, "float32", torch.device("cpu"))
    step_seconds = LATE_STEP_TIME_RATIO * row["seconds"] / PROBE_STEPS
    return min(setup.quality_steps, max(MIN_STEPS, int(setup.quality_seconds / step_seconds)))


def _train(scene: Scene, steps: int, precision: str, device: torch.device) -> tuple[float, Row]:
    """Train a model; return its PSNR on held-out photos in dB, and the cells of its row."""
    from hyrfpack.evaluate import evaluate_model
    from hyrfpack.train import TrainConfig, Trainer

    trainer = Trainer(scene, TrainConfig(steps=steps, precision=precision), device=device)
    start = time.perf_counter()  # without the set-up, which takes longer than a probe's steps
    trainer.run()
    synchronize(device)
    seconds = time.perf_counter() - start
    psnr = evaluate_model(trainer.model, scene.test).psnr
    cells = {"PSNR dB": f"{psnr:.3f}", "Gaussians": f"{len(trainer.model):,}", "steps/s": trainer.step / seconds}
    return psnr, {**cells, "seconds": seconds}
