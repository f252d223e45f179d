"""Profile a training step on the CPU by operation, beside the time that memory and arithmetic of its cores allow.

    python -m tools.studies.step_profile --data ../shared/data/mipnerf360_bonsai --model runs/bonsai/model.hyrf
    python -m tools.studies.step_profile --data photos/room --model room.hyrf --max-size 800 --steps 16 --threads 1

The trainer takes --steps steps, after warm-up steps, on as many photos, which are decoded before. Learning rates are so
small that the model does not change. Exposure compensation and rounds of density control are left out. Each row is one
operation:

- ms: the median over the steps. As the steps show different photos, rows need not add up exactly to the total.
- share: of the total.
- MB, MFLOP: what the operation must move and compute at least (step_work.py); median over the steps.
- bound, ms: the larger of the times for both at the measured rates; and which of the two it is.
- time / bound: how far the operation is from it. An operation on data that the caches hold may be below 1.

The rates are the fastest of several copies of a large array (bytes read and written) and of several products of float32
matrices, on as many threads as the step uses. Only matrix products reach that arithmetic rate: it counts fused
multiply-adds, which other operations can rarely use. Nothing else should run on the machine; the line above the table
has the system's load.

How the step is split. Most forward rows are the trainer's own clock. Those of hash encoding, MLPs, composite and loss
are timed around calls, and "rest" is the remainder of a stage. In the backward pass, hooks of autograd read the clock
before and after each node of the graph. A node belongs to the operation whose result it first led to, and hash encoding
and MLPs are distinguished by name, so that the background's share is measured and not estimated. The rasteriser is one
node, so its two parts are timed around calls. What lies between nodes (autograd itself, the sum of the two gradients of
the radiance table, which decoding and background share, and the hooks) is the row "backward: autograd". "other" is the
rest of the step, mostly checks for finite numbers. So the rows of one step add up to its duration.

The error of the split: clocks and hooks add about 0.3 ms to a step of any size, half of it to "backward: autograd"
(steps of 32 x 32 pixels with and without them). In a step of 315 ms, torch.profiler's time in the backward pass of the
hash encodings was 1 % higher. Its time in that of the MLPs was 8 % higher, as it adds to each of their small products.

The results are in docs/research/training-step.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

import hyrfpack
from hyrfpack.config.train import LearningRates
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError
from hyrfpack.model import HybridModel
from hyrfpack.ops.background import grid_size
from hyrfpack.ops.composite import composite
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, cpu, rasterize
from hyrfpack.ops.rasterize.cpu_bin import SLOT_SHIFT_BITS
from hyrfpack.ops.rasterize.reference import TILE_SIZE
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.parallel.pool import run_tasks, torch_on_one_thread
from hyrfpack.parallel.threads import thread_count
from hyrfpack.progress import StepEvent
from hyrfpack.render import Rendering, render_view
from hyrfpack.scene import Camera, Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.resolution import background_stride
from tools.command import run_command
from tools.gpu.roofline import Work
from tools.gpu.scene import count_blended, decode_splats
from tools.gpu.timing import Rates
from tools.studies.step_work import ModelSizes, ViewSizes, count_step, measure_model_sizes
from tools.tables import markdown_table

WARM_UP_STEPS = 2
# Steps of this size change no float32 of a model. They are not smaller, because arithmetic on denormal numbers is slow.
FROZEN_RATE = 1e-12
COPIED_FLOATS_PER_THREAD = 1 << 25
MATRIX_SIDE = 1024
RATE_REPEATS = 15

OPERATION_ROWS = (
    "data",
    "cull",
    "decode: hash encoding",
    "decode: MLP",
    "decode: rest",
    "project",
    "sort",
    "bin",
    "blend",
    "background: hash encoding",
    "background: MLP",
    "background: rest",
    "composite",
    "loss",
    "loss backward",
    "composite backward",
    "background backward: MLP",
    "background backward: hash encoding",
    "background backward: rest",
    "blend backward",
    "project backward",
    "decode backward: MLP",
    "decode backward: hash encoding",
    "decode backward: rest",
    "backward: autograd",
    "density observation",
    "Adam",
    "other",
)
# Rows whose time is that of a stage of the trainer.
ROW_BY_STAGE = {
    **{stage: stage for stage in ("data", "cull", "project", "sort", "bin", "blend")},
    "density": "density observation",
    "optimizer": "Adam",
}
TABLE_COLUMNS = ("operation", "ms", "share", "MB", "MFLOP", "bound, ms", "limited by", "time / bound")
COLUMN_ALIGNMENTS = ("---", "--:", "--:", "--:", "--:", "--:", "---", "--:")


class StepRecorder:
    """Times the operations of a training step within the trainer's stages, and collects the sizes of the step.

    Attributes:
        seconds: time of each row that is measured here.
        overhead: time in which hooks were added to the autograd graph, which is part of the stage "loss".
    """

    def __init__(self) -> None:
        self._run_blend_backward = self._timed("blend backward", cpu._blend_backward)
        self.clear()

    def clear(self) -> None:
        """Forget the last step."""
        self.seconds: dict[str, float] = defaultdict(float)
        self.overhead = 0.0
        self._results: dict[str, list[Tensor]] = {}  # By operation, in the order in which they are computed.
        self._needed = 0
        self._node_start = 0.0

    def install(self, stack: ExitStack) -> None:
        """Replace the operations that the trainer calls by timed ones until the stack is closed."""
        replacements = {
            "hyrfpack.train.gradients.render_view": self._render_view,
            "hyrfpack.train.gradients.photometric_loss": self._photometric_loss,
            "hyrfpack.render.renderer.rasterize": self._rasterize,
            "hyrfpack.render.renderer.composite": self._composite,
            "hyrfpack.model.hash_grid.hash_encode": self._timed("decode: hash encoding", hash_encode),
            "hyrfpack.model.field.mlp": self._timed("decode: MLP", mlp),
            "hyrfpack.ops.background.reference.hash_encode": self._timed("background: hash encoding", hash_encode),
            "hyrfpack.ops.background.reference.mlp": self._background_mlp,
            "hyrfpack.ops.rasterize.cpu._blend_backward": self._blend_backward,
            "hyrfpack.ops.rasterize.cpu._project_backward": self._timed("project backward", cpu._project_backward),
        }
        for lookup, replacement in replacements.items():
            stack.enter_context(mock.patch(lookup, replacement))

    def sizes(self, model: HybridModel, photo_bytes: int) -> ViewSizes:
        """Return the sizes of the last step."""
        camera, rendering = self._camera, self._rendering
        starts, blended = self._tiles.starts, self._blended
        # A tile's first pairs are reached, up to the number that was blended.
        place = np.arange(len(self._tiles.pairs)) - np.repeat(starts[:-1], np.diff(starts))
        reached = self._tiles.pairs[place < np.repeat(blended.astype(np.int64), np.diff(starts))]
        return ViewSizes(
            pixels=camera.width * camera.height,
            photo_bytes=photo_bytes,
            in_view=len(rendering.indices),
            drawn=int(rendering.visible.sum()),
            pairs=rendering.pairs,
            reached=len(reached),
            evaluations=count_evaluations(reached),
            blended=count_blended(decode_splats(model, camera))[0],
            nodes=int(np.prod(grid_size(camera.height, camera.width, background_stride(camera)))),
            needed=self._needed,
        )

    def _timed(self, row: str, function: Callable) -> Callable:
        """Return the function with its time added to a row."""

        def run(*args: Any, **options: Any) -> Any:
            start = perf_counter()
            result = function(*args, **options)
            self.seconds[row] += perf_counter() - start
            return result

        return run

    def _render_view(self, model: HybridModel, camera: Camera, *args: Any, **options: Any) -> Rendering:
        self._camera, self._rendering = camera, render_view(model, camera, *args, **options)
        return self._rendering

    def _rasterize(self, gaussians: Gaussians3D, colors: Tensor, *args: Any, **options: Any) -> Rasterization:
        raster = rasterize(gaussians, colors, *args, **options)
        self._results["decode"] = [*gaussians, colors]
        self._results["rasterize"] = [raster.rgb, raster.transmittance]
        return raster

    def _background_mlp(self, x: Tensor, *args: Any, **options: Any) -> Tensor:
        self._needed = len(x)
        return self._timed("background: MLP", mlp)(x, *args, **options)

    def _composite(self, rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
        self._results["background"] = [grid]
        return self._timed("composite", composite)(rgb, transmittance, grid, stride)

    def _photometric_loss(self, image: Tensor, *args: Any, **options: Any) -> Tensor:
        loss = photometric_loss(image, *args, **options)
        start = perf_counter()
        self._results["composite"], self._results["loss"] = [image], [loss]
        seen: set[Any] = set()
        for operation, tensors in self._results.items():
            for node in iterate_new_nodes(tensors, seen):
                row = find_backward_row(operation, node.name())
                if row is not None:
                    node.register_prehook(self._start_node)
                    node.register_hook(self._node_end(row))
        self._results.clear()
        self.overhead += perf_counter() - start
        return loss

    def _start_node(self, _gradients: Any) -> None:
        self._node_start = perf_counter()

    def _node_end(self, row: str) -> Callable[[Any, Any], None]:
        def end(_inputs: Any, _outputs: Any) -> None:
            self.seconds[row] += perf_counter() - self._node_start

        return end

    def _blend_backward(self, tiles: Any, blended: np.ndarray, *args: Any) -> np.ndarray:
        self._tiles, self._blended = tiles, blended
        return self._run_blend_backward(tiles, blended, *args)


def iterate_new_nodes(tensors: Iterable[Tensor], visited: set[Any]) -> Iterator[Any]:
    """Yield the nodes of the autograd graph behind the tensors that are not in `visited`, and add them to it."""
    pending = [tensor.grad_fn for tensor in tensors]
    while pending:
        node = pending.pop()
        if node is not None and node not in visited:
            visited.add(node)
            pending.extend(parent for parent, _ in node.next_functions)
            yield node


def find_backward_row(operation: str, node: str) -> str | None:
    """Return the row of a node of the graph, or None if it has none.

    The rasteriser's node is timed inside. A node that accumulates a parameter's gradient counts as autograd, because a
    hook there could make it copy the gradient.

    Args:
        operation: the operation whose result the node first led to.
        node: the node's name.
    """
    if operation == "rasterize" or node.endswith("AccumulateGrad"):
        return None
    if operation not in ("decode", "background"):
        return f"{operation} backward"
    part = "hash encoding" if "HashEncode" in node else "MLP" if "Mlp" in node else "rest"
    return f"{operation} backward: {part}"


def count_evaluations(pairs: np.ndarray) -> int:
    """Return the number of pixels in the tile rows that packed pairs (P,) touch, summed over the pairs."""
    rows = pairs & np.uint64((1 << int(SLOT_SHIFT_BITS)) - 1)
    first, last = rows & np.uint64(15), rows >> np.uint64(4)
    return TILE_SIZE * int((last - first + np.uint64(1)).sum())


def split_step(seconds: dict[str, float], step: float, recorder: StepRecorder, background: bool) -> dict[str, float]:
    """Return the seconds of each row of one step; they add up to the step without the time to add hooks.

    Args:
        seconds: seconds of the trainer's stages in this step.
        step: seconds of the whole step.
        recorder: the recorder of this step.
        background: whether the model has a background sphere; without one, the stage is only compositing.
    """
    rows = defaultdict(float, recorder.seconds)
    for stage, row in ROW_BY_STAGE.items():
        rows[row] += seconds[stage]
    rows["loss"] = seconds["loss"] - recorder.overhead
    rows["decode: rest"] = seconds["decode"] - rows["decode: hash encoding"] - rows["decode: MLP"]
    parts = ("composite", "background: hash encoding", "background: MLP")
    rows["background: rest" if background else "composite"] = seconds["background"] - sum(rows[part] for part in parts)
    backward = sum(value for row, value in rows.items() if "backward" in row)
    rows["backward: autograd"] = seconds["backward"] - backward
    rows["other"] = step - recorder.overhead - sum(rows.values())
    return {
        row: rows[row] for row in OPERATION_ROWS if row in rows and (background or not row.startswith("background"))
    }


@dataclass(frozen=True)
class StepProfile:
    """Measured steps.

    Attributes:
        steps: seconds of each row of each step.
        views: sizes of each step.
        model: sizes of the model.
    """

    steps: list[dict[str, float]]
    views: list[ViewSizes]
    model: ModelSizes

    def median_ms(self, row: str) -> float:
        """Return the median milliseconds of a row."""
        return 1e3 * statistics.median(step[row] for step in self.steps)

    @property
    def total_ms(self) -> float:
        """Return the median milliseconds of a step."""
        return 1e3 * statistics.median(sum(step.values()) for step in self.steps)

    def median_works(self) -> dict[str, Work]:
        """Return the median bytes and operations of each row that has a count."""
        works = [count_step(self.model, view) for view in self.views]
        return {
            row: Work(*(statistics.median(getattr(work[row], name) for work in works) for name in ("bytes", "flops")))
            for row in works[0]
        }


def profile_steps(scene: Scene, model: HybridModel, steps: int) -> StepProfile:
    """Profile `steps` training steps of the model on up to as many photos of the scene, evenly selected.

    Raises:
        HyrfError: a photo cannot be read, or shows no Gaussian of the model.
    """
    count = min(steps, len(scene.train))
    scene = dataclasses.replace(scene, train=[scene.train[len(scene.train) * i // count] for i in range(count)])
    last = WARM_UP_STEPS + steps
    config = TrainConfig(
        resolution_schedule=False,
        steps=last + 1,  # A round of density control is due at the last step, which is not reached.
        max_gaussians=len(model),
        density=DensityConfig(start=1, stop=1, peak=1, rounds=1),
        exposure=False,
        learning_rates=LearningRates(**{group.name: 2 * (FROZEN_RATE,) for group in dataclasses.fields(LearningRates)}),
    )
    cache = PictureCache()
    photo_bytes = 4 if any(cache.get(view).alpha is not None for view in scene.train) else 3
    trainer, recorder = Trainer(scene, config, cache, model=model), StepRecorder()
    profile = StepProfile([], [], measure_model_sizes(model))
    before: dict[str, float] = defaultdict(float)
    elapsed = 0.0

    def record(event: StepEvent) -> None:
        nonlocal before, elapsed
        seconds = defaultdict(float, {stage: s - before[stage] for stage, s in trainer.seconds.items()})
        if event.step > WARM_UP_STEPS:
            rows = split_step(seconds, trainer.elapsed - elapsed, recorder, model.config.background)
            view = recorder.sizes(model, photo_bytes)
            if not view.drawn:
                raise HyrfError(
                    f"{scene.path}: a photo shows no Gaussian of the model", fix="pass the photos of this model"
                )
            profile.steps.append(rows)
            profile.views.append(view)
        recorder.clear()
        before, elapsed = defaultdict(float, trainer.seconds), trainer.elapsed

    with ExitStack() as stack:
        recorder.install(stack)
        trainer.run(progress=record, stop=lambda: trainer.step == last)
    return profile


def measure_core_rates() -> Rates:
    """Measure the rates of the cores: the fastest of RATE_REPEATS copies and matrix products on all threads.

    Each thread copies an array and multiplies matrices of its own.
    """
    threads = thread_count()
    sources = [torch.ones(COPIED_FLOATS_PER_THREAD) for _ in range(threads)]
    targets = [torch.ones(COPIED_FLOATS_PER_THREAD) for _ in range(threads)]
    matrices = [torch.rand(MATRIX_SIDE, MATRIX_SIDE) for _ in range(threads)]
    products = [torch.empty(MATRIX_SIDE, MATRIX_SIDE) for _ in range(threads)]

    def copy(index: int) -> None:
        targets[index].copy_(sources[index])

    def multiply(index: int) -> None:
        torch.mm(matrices[index], matrices[index], out=products[index])

    def fastest(task: Callable[[int], None]) -> float:
        times = []
        for _ in range(RATE_REPEATS):
            start = perf_counter()
            run_tasks(task, threads)
            times.append(perf_counter() - start)
        return min(times)

    with torch_on_one_thread():
        copy_seconds, product_seconds = fastest(copy), fastest(multiply)
    flops = threads * 2 * MATRIX_SIDE**3 / product_seconds
    return Rates(copy=threads * 8 * COPIED_FLOATS_PER_THREAD / copy_seconds, bf16=flops, fp32=flops)


def describe(profile: StepProfile, cameras: Sequence[Camera], rates: Rates) -> str:
    """Return the line above the table: sizes of photos and of the step, threads and measured rates."""
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    have_same_size = len({(camera.width, camera.height) for camera in cameras}) == 1

    def median(name: str) -> int:
        return round(statistics.median(getattr(view, name) for view in profile.views))

    parts = [
        f"photos of {'' if have_same_size else 'up to '}{largest.width:,} x {largest.height:,}",
        f"{profile.model.gaussians:,} Gaussians",
        f"{median('in_view'):,} in view and {median('drawn'):,} visible",
        f"{median('pairs'):,} pairs",
        f"{median('needed'):,} of {median('nodes'):,} background nodes"
        if profile.model.background
        else "no background",
        f"{thread_count()} threads" if thread_count() > 1 else "1 thread",
        f"{rates.fp32 / 1e9:,.0f} GFLOP/s",
        f"{rates.copy / 1e9:.1f} GB/s",
    ]
    if hasattr(os, "getloadavg"):
        parts.append(f"load {os.getloadavg()[0]:.1f}")
    return ", ".join(parts)


def table_rows(profile: StepProfile, rates: Rates) -> list[list[str]]:
    """Return the cells of the table."""
    works, total = profile.median_works(), profile.total_ms
    rows = []
    for row in profile.steps[0]:
        ms = profile.median_ms(row)
        cells = [row, f"{ms:.2f}", f"{ms / total:.1%}"]
        if work := works.get(row):
            bound = work.min_ms(rates)
            limit = "memory" if work.bytes / rates.copy > work.flops / rates.fp32 else "arithmetic"
            cells += [
                f"{work.bytes / 1e6:,.2f}",
                f"{work.flops / 1e6:,.1f}",
                f"{bound:.2f}",
                limit,
                f"{ms / bound:.1f}",
            ]
        rows.append(cells + [""] * (len(TABLE_COLUMNS) - len(cells)))
    bound = sum(work.min_ms(rates) for work in works.values())
    sums = (sum(getattr(work, name) for work in works.values()) / 1e6 for name in ("bytes", "flops"))
    cells = ["total", f"{total:.2f}", "100.0%", *(f"{number:,.1f}" for number in sums)]
    return [*rows, [*cells, f"{bound:.2f}", "", f"{total / bound:.1f}"]]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a data set: photos with poses")
    parser.add_argument("--model", type=Path, required=True, help="a trained model of these photos")
    parser.add_argument("--max-size", type=int, default=1600, help="longest side of the photos in pixels (1600)")
    parser.add_argument("--steps", type=int, default=8, help="measured steps, each on one photo (8)")
    parser.add_argument("--threads", type=int, help="threads of kernels (all cores, or HYRFPACK_THREADS)")
    options = parser.parse_args(arguments)
    if options.steps < 1 or options.max_size < 0 or (options.threads or 1) < 1:
        parser.error("--steps and --threads must be 1 or more, --max-size 0 or more")
    if options.threads:
        os.environ["HYRFPACK_THREADS"] = str(options.threads)
    try:
        model = hyrfpack.load_model(options.model)
        scene = hyrfpack.load_scene(options.data, max_size=options.max_size)
        profile = profile_steps(scene, model, options.steps)
    except HyrfError as error:
        parser.error(str(error))
    rates = measure_core_rates()
    table = markdown_table(TABLE_COLUMNS, table_rows(profile, rates), COLUMN_ALIGNMENTS)
    print(f"{describe(profile, [view.camera for view in scene.train], rates)}\n\n{table}")


if __name__ == "__main__":
    run_command(main)
