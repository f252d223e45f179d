"""Measure what the stride of the background costs and saves: error against the exact background, and time.

    python -m tools.studies.background_stride runs/street/model.hyrf runs/bonsai/model.hyrf

For cameras that each model stores, the table has the mean and the worst PSNR in dB against renders with a stride of 1,
and the median ms of a view, for fixed strides and for the stride that the renderer chooses.
"""

from __future__ import annotations

import argparse
import statistics
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import torch

import hyrfpack
from hyrfpack.measure.timing import time_alternately
from hyrfpack.render.background_stride import choose_background_stride
from hyrfpack.scene import Camera
from tools.studies.web_player import psnr, stored_cameras
from tools.tables import markdown_table

COMPARED_STRIDES = (1, 2, 3, 4, None)
REPEAT_COUNT = 3


def count_strides(model: hyrfpack.HybridModel, cameras: list[Camera]) -> str:
    """Return how often each stride is chosen, as "1 x 6, 2 x 2"."""
    settings, counts = hyrfpack.RenderSettings(), Counter[int]()
    for camera in cameras:
        viewport = model.config.frame.local_viewport(camera, torch.float32)
        light = 1 - hyrfpack.render_view(model, camera, settings, background=False).alpha
        counts[choose_background_stride(model, light, viewport, threshold=settings.background_threshold)] += 1
    return ", ".join(f"{stride} x {number}" for stride, number in sorted(counts.items()))


@torch.no_grad()
def measure(path: Path, cameras: list[Camera]) -> list[list[str]]:
    """Return the rows of one model."""
    model = hyrfpack.load_model(path)
    decoded = model.decode()

    def task(stride: int | None) -> Callable[[], list[torch.Tensor]]:
        settings = hyrfpack.RenderSettings(background_stride=stride)
        return lambda: [hyrfpack.render_view(model, camera, settings, decoded=decoded).rgb for camera in cameras]

    task(1)()  # compiles kernels
    times, pictures = time_alternately({str(stride): task(stride) for stride in COMPARED_STRIDES}, REPEAT_COUNT)
    rows = []
    for stride in COMPARED_STRIDES:
        scores = [
            psnr(found.numpy(), exact.numpy())
            for found, exact in zip(pictures[str(stride)], pictures["1"], strict=True)
        ]
        ms = times[str(stride)].per_part(len(cameras))
        name = f"chosen: {count_strides(model, cameras)}" if stride is None else str(stride)
        rows.append([path.parent.name, name, f"{statistics.mean(scores):.1f}", f"{min(scores):.1f}", f"{ms.ms:.1f}"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", help="models with a background sphere")
    parser.add_argument("--views", type=int, default=8, help="number of views of each model (8)")
    arguments = parser.parse_args()
    rows = [row for path in arguments.models for row in measure(path, stored_cameras(path, arguments.views))]
    print(markdown_table(["model", "stride", "mean dB", "worst dB", "ms"], rows))


if __name__ == "__main__":
    main()
