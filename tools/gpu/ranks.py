"""Train the built-in scene with one process and with two, which exchange their gradients, and compare PSNR.

Two GPUs communicate by NCCL. On a machine with one GPU both processes share it, and gloo sends the gradients.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from hyrfpack.parallel.ranks import COLLECTIVES_VARIABLE
from tools.gpu.process import TimedProcess
from tools.gpu.rows import Row
from tools.gpu.setup import Setup

TABLE_NAME = "Several processes"
# Two processes take half as many steps of the optimiser, each with the mean gradient of two photos.
MAX_PSNR_LOSS_DB = 1.0


def items(setup: Setup) -> list[str]:
    """Return the one item, the built-in scene."""
    return ["demo"]


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield the row of one process, then that of two."""
    from hyrfpack.demo.scene import write_demo_scene

    baseline: float | None = None
    with tempfile.TemporaryDirectory(prefix="hyrfpack-gpu-") as folder:
        scene = write_demo_scene(Path(folder, "scene"), views=setup.demo_views, size=setup.demo_size)
        for count in (1, 2):
            row, psnr = _train(scene, Path(folder, f"run-{count}"), count, setup)
            if baseline is not None and psnr is not None and not psnr >= baseline - MAX_PSNR_LOSS_DB:
                note = f"its PSNR is more than {MAX_PSNR_LOSS_DB} dB below that of one process"
                row |= {"status": "failed", "note": note}
            yield row
            baseline = psnr


def choose_collectives(device: str, gpus: int) -> str:
    """Return what sends gradients between two processes: "nccl" if each has a GPU of its own, or else "gloo"."""
    return "nccl" if device == "cuda" and gpus > 1 else "gloo"


def _train(scene: Path, out: Path, count: int, setup: Setup) -> tuple[Row, float | None]:
    """Train with `count` processes by the command line; return the row, and PSNR in dB unless it failed."""
    command = [sys.executable, "-m", "hyrfpack", "train", str(scene), "-o", str(out), "--device", setup.device]
    command += ["--steps", str(setup.ranks_steps), "--processes", str(count)]
    collectives = choose_collectives(setup.device, torch.cuda.device_count())
    start = time.perf_counter()
    environment = {**os.environ, COLLECTIVES_VARIABLE: collectives}
    process = TimedProcess(command, setup.ranks_seconds, setup.log_path(f"train-{count}"), environment)
    lines = [line.strip() for line in process.lines() if line.strip()]
    row: Row = {"table": TABLE_NAME, "processes": count, "collectives": collectives if count > 1 else ""}
    row |= {"steps": setup.ranks_steps, "seconds": round(time.perf_counter() - start, 1)}
    if process.is_out_of_time:
        return row | {"status": "failed", "note": f"not done within {setup.ranks_seconds:.0f} s"}, None
    if process.exit_code:
        reason = (lines or ["no output"])[-1]
        return row | {"status": "failed", "note": f"exit code {process.exit_code}: {reason}"}, None
    psnr = json.loads((out / "metrics.json").read_bytes())["evaluation"]["psnr"]
    return row | {"PSNR of held-out photos": f"{psnr:.3f} dB"}, psnr
