"""The same training on the GPU, in each precision, and on the CPU: what held-out photos say of each."""

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

PROBE_STEPS = 25  # on the CPU, to see how many it has time for
LATER_STEPS = 2.0  # times what a first step takes: there are more Gaussians then
LEAST_STEPS = 100
# Rounding alone decides here and there which Gaussian is split, so that two runs of one kind differ by tenths of a dB.
BOUND = 0.3


def items(setup: Setup) -> list[str]:
    """The built-in scene, and the real set where there is one."""
    return ["demo", *([setup.data] if setup.data else [])]


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Rows of one set: the CPU's run, then the GPU's in both precisions."""
    if not has_numba():
        note = "it needs Numba, for the CPU's run that the GPU's are compared with takes too long without it"
        yield {"table": "Quality", "set": item, "status": "left out", "note": note}
        return
    from hyrfpack.data import load_scene
    from hyrfpack.demo.scene import write_demo_scene

    with tempfile.TemporaryDirectory(prefix="hyrfpack-gpu-") as folder:
        if item == "demo":
            write_demo_scene(folder, views=setup.demo_views, size=setup.demo_size)
        scene = load_scene(folder if item == "demo" else item)
        name = "built-in" if item == "demo" else Path(item).name
        yield from _compare(name, scene, setup)


def _compare(name: str, scene: Scene, setup: Setup) -> Iterator[Row]:
    cpu = torch.device("cpu")
    steps = _affordable_steps(scene, setup)
    baseline, row = _train(scene, steps, "float32", cpu)
    yield {"table": "Quality", "set": name, "steps": steps, "run": "CPU", **row}
    for precision in ("float32", "mixed"):
        psnr, row = _train(scene, steps, precision, setup.torch_device)
        row = {"table": "Quality", "set": name, "steps": steps, "run": f"GPU, {precision}", **row}
        row["against the CPU"] = f"{psnr - baseline:+.3f} dB"
        if not psnr >= baseline - BOUND:
            row |= {"status": "failed", "note": f"more than {BOUND} dB below the CPU's"}
        yield row


def _affordable_steps(scene: Scene, setup: Setup) -> int:
    """As many steps as asked for, or as the CPU has time for."""
    _train(scene, 2, "float32", torch.device("cpu"))  # compiles the kernels
    _, row = _train(scene, PROBE_STEPS, "float32", torch.device("cpu"))
    each = LATER_STEPS * row["seconds"] / PROBE_STEPS
    return min(setup.quality_steps, max(LEAST_STEPS, int(setup.quality_seconds / each)))


def _train(scene: Scene, steps: int, precision: str, device: torch.device) -> tuple[float, Row]:
    """Held-out PSNR in dB after training, and cells of the row."""
    from hyrfpack.evaluate import evaluate
    from hyrfpack.train import TrainConfig, Trainer

    start = time.perf_counter()
    trainer = Trainer(scene, TrainConfig(steps=steps, precision=precision), device=device)
    trainer.run()
    synchronize(device)
    seconds = time.perf_counter() - start
    psnr = evaluate(trainer.model, scene.test).psnr
    cells = {"PSNR dB": f"{psnr:.3f}", "Gaussians": f"{len(trainer.model):,}", "steps/s": steps / seconds}
    return psnr, {**cells, "seconds": seconds}
