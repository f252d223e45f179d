"""Rasterising on the CPU: Numba kernels on the shared thread pool, behind one autograd.Function."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.rasterize import cpu_bin, cpu_blend, cpu_project
from hyrfpack.ops.rasterize.reference import TILE, jacobian_limits
from hyrfpack.parallel.pool import run_ranges, run_tasks, thread_count

LEAST_RUN = 128  # pairs, about, that a thread blends while another wakes


@dataclass(frozen=True)
class _View:
    """What of the call is not a tensor to differentiate. Numbers of one type each: kernels are compiled for types."""

    axes: tuple[tuple[float, ...], ...]  # rows of the camera's rotation
    shift: tuple[float, ...]
    lens: tuple[float, ...]  # fx, fy, cx, cy and the limits of x/z and y/z in the Jacobian
    width: int
    height: int
    near: float
    antialiased: bool
    transmittance_min: np.float32
    depth: bool
    absgrad: np.ndarray | None


@dataclass(frozen=True)
class _Tiles:
    """The pairs of a picture, tile by tile and in depth order within each.

    Attributes:
        records: (V, 16) the projections of what is drawn, in depth order, see cpu_project.
        first: (N + 1,) where each Gaussian's slots begin, its places in the list of pairs Gaussian by Gaussian.
        starts: (tiles + 1,) where each tile's pairs begin.
        pairs: (P,) uint64, packed as in cpu_bin.
    """

    records: np.ndarray
    first: np.ndarray
    starts: np.ndarray
    pairs: np.ndarray


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    *,
    near: float,
    antialiased: bool,
    transmittance_min: float,
    depth: bool,
    absgrad: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor | None, Tensor, int, dict[str, float]]:
    """Arguments and results (a tuple in the order of the fields) as in `hyrfpack.ops.rasterize.rasterize`."""
    where = camera_from_world, intrinsics, width, height
    view = _view(*where, near, antialiased, transmittance_min, depth, None if absgrad is None else absgrad.detach())
    report: dict = {}
    rgb, transmittance, depths, visible = _Rasterize.apply(means, quats, scales, opacities, colors, view, report)
    return rgb, transmittance, depths, visible, report["pairs"], report["seconds"]


@torch.no_grad()
def sent_light(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    *,
    near: float,
    antialiased: bool,
    transmittance_min: float,
) -> tuple[Tensor, Tensor]:
    """Arguments and results as in `hyrfpack.ops.rasterize.light.sent_light`."""
    view = _view(camera_from_world, intrinsics, width, height, near, antialiased, transmittance_min)
    inputs = (means, quats, scales, opacities, means)  # no one looks at colours
    records, keys, boxes = _project(tuple(tensor.detach().contiguous().numpy() for tensor in inputs), view)
    tiles = _bin(cpu_bin.sort_by_depth(keys), records, boxes, view)
    of_pairs, transmittance = np.zeros(len(tiles.pairs), np.float32), np.empty((view.height, view.width), np.float32)
    _blend_into(tiles, view, None, transmittance, None, of_pairs)
    sums = np.empty(len(means), np.float32)
    run_ranges(lambda start, stop: cpu_blend.sum_slots(start, stop, tiles.first, of_pairs, sums), len(means))
    return torch.from_numpy(sums), torch.from_numpy(transmittance)


def _view(
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    near: float,
    antialiased: bool,
    transmittance_min: float,
    depth: bool = False,
    absgrad: Tensor | None = None,
) -> _View:
    camera = camera_from_world.detach().double().tolist()[:3]
    return _View(
        axes=tuple(tuple(row[:3]) for row in camera),
        shift=tuple(row[3] for row in camera),
        lens=tuple(float(number) for number in (*intrinsics, *jacobian_limits(intrinsics, width, height))),
        width=int(width),
        height=int(height),
        near=float(near),
        antialiased=bool(antialiased),
        transmittance_min=np.float32(transmittance_min),
        depth=depth,
        absgrad=None if absgrad is None else absgrad.numpy(),
    )


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, opacities, colors, view, report):
        inputs = tuple(tensor.contiguous() for tensor in (means, quats, scales, opacities, colors))
        arrays = tuple(tensor.detach().numpy() for tensor in inputs)
        clock = [perf_counter()]
        records, keys, boxes = _project(arrays, view)
        clock.append(perf_counter())
        order = cpu_bin.sort_by_depth(keys)
        clock.append(perf_counter())
        tiles = _bin(order, records, boxes, view)
        clock.append(perf_counter())
        rgb, transmittance, depths, blended = _blend(tiles, view)
        clock.append(perf_counter())

        report["pairs"] = len(tiles.pairs)
        report["seconds"] = {
            stage: clock[i + 1] - clock[i] for i, stage in enumerate(("project", "sort", "bin", "blend"))
        }
        visible = torch.from_numpy(tiles.first[1:] > tiles.first[:-1])
        rgb, transmittance = torch.from_numpy(rgb), torch.from_numpy(transmittance)
        depths = None if depths is None else torch.from_numpy(depths)
        ctx.save_for_backward(*inputs[:4], rgb, transmittance)
        ctx.tiles, ctx.blended, ctx.view = tiles, blended, view
        ctx.mark_non_differentiable(*([visible] if depths is None else [visible, depths]))
        return rgb, transmittance, depths, visible

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_rgb, grad_transmittance, _grad_depth, _grad_visible):
        *inputs, rgb, transmittance = (tensor.detach().numpy() for tensor in ctx.saved_tensors)
        gradients = grad_rgb.contiguous().numpy(), grad_transmittance.contiguous().numpy()
        rows = _blend_backward(ctx.tiles, ctx.blended, ctx.view, rgb, transmittance, *gradients)
        grads = _project_backward(ctx.tiles, ctx.view, rows, inputs)
        return *(torch.from_numpy(grad) for grad in grads), None, None


def _lines(count: int) -> np.ndarray:
    """(count, 16) float32, not initialised, each row one cache line."""
    numbers = np.empty(16 * count + 16, np.float32)
    skip = -numbers.ctypes.data // 4 % 16
    return numbers[skip : skip + 16 * count].reshape(count, 16)


def _project(arrays: tuple[np.ndarray, ...], view: _View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count = len(arrays[0])
    records = _lines(count)
    keys, boxes = np.empty(count, np.uint32), np.empty(count, np.uint32)
    where = view.axes, view.shift, view.lens, view.width, view.height, view.near, view.antialiased

    def task(start: int, stop: int) -> None:
        cpu_project.project(start, stop, *arrays, *where, records, keys, boxes)

    run_ranges(task, count)
    return records, keys, boxes


def _bin(order: np.ndarray, records: np.ndarray, boxes: np.ndarray, view: _View) -> _Tiles:
    count = len(order)
    tile_total = -(-view.width // TILE) * -(-view.height // TILE)
    chunks = max(1, min(4 * thread_count(), count // 256))
    edges = [count * i // chunks for i in range(chunks + 1)]
    tile_counts = np.zeros((chunks, tile_total), np.int64)
    first = np.zeros(len(records) + 1, np.int64)
    sorted_records = _lines(count)
    found: list = [None] * chunks

    def find(chunk: int) -> None:
        found[chunk] = cpu_bin.find_pairs(
            edges[chunk], edges[chunk + 1], order, boxes, records, view.width, view.height,
            tile_counts[chunk], first[1:], sorted_records,
        )  # fmt: skip

    run_tasks(find, chunks)
    np.cumsum(first, out=first)
    starts = np.empty(tile_total + 1, np.int64)
    cpu_bin.place_chunks(tile_counts, starts)
    if first[-1] >= cpu_bin.PAIRS_MAX:
        raise MemoryError(f"{first[-1]} pairs of a Gaussian and a tile; at most {cpu_bin.PAIRS_MAX - 1} can be drawn")
    pairs = np.empty(first[-1], np.uint64)

    def fill(chunk: int) -> None:
        cpu_bin.fill_tiles(edges[chunk], edges[chunk + 1], order, first, *found[chunk], tile_counts[chunk], pairs)

    run_tasks(fill, chunks)
    return _Tiles(sorted_records, first, starts, pairs)


def _tile_runs(starts: np.ndarray) -> list[tuple[int, int]]:
    """Contiguous runs of tiles of about equal work, 16 for each thread where that is enough."""
    work = starts + 4 * np.arange(len(starts))  # an empty tile costs about as much as four pairs
    count = max(1, min(16 * thread_count(), len(starts) - 1, work[-1] // LEAST_RUN))
    edges = np.searchsorted(work, work[-1] * np.arange(1, count) // count)
    edges = np.unique(np.concatenate([[0], edges, [len(starts) - 1]])).tolist()
    return list(zip(edges[:-1], edges[1:], strict=True))


def _blend(tiles: _Tiles, view: _View) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]:
    size = view.height, view.width
    rgb, transmittance = np.empty((*size, 3), np.float32), np.empty(size, np.float32)
    depths = np.empty(size, np.float32) if view.depth else None
    return rgb, transmittance, depths, _blend_into(tiles, view, rgb, transmittance, depths, None)


def _blend_into(
    tiles: _Tiles,
    view: _View,
    rgb: np.ndarray | None,
    transmittance: np.ndarray,
    depths: np.ndarray | None,
    light: np.ndarray | None,
) -> np.ndarray:
    """Blend all tiles into these arrays; after how many pairs each was finished."""
    blended = np.empty(len(tiles.starts) - 1, np.uint32)
    runs = _tile_runs(tiles.starts)

    def task(run: int) -> None:
        cpu_blend.blend_tiles(
            *runs[run], tiles.starts, tiles.pairs, tiles.records, view.width, view.height, view.transmittance_min,
            rgb, transmittance, depths, light, blended,
        )  # fmt: skip

    run_tasks(task, len(runs))
    return blended


def _blend_backward(
    tiles: _Tiles,
    blended: np.ndarray,
    view: _View,
    rgb: np.ndarray,
    transmittance: np.ndarray,
    grad_rgb: np.ndarray,
    grad_transmittance: np.ndarray,
) -> np.ndarray:
    gradient_rows = _lines(len(tiles.pairs))
    runs = _tile_runs(tiles.starts)

    def task(run: int) -> None:
        cpu_blend.blend_tiles_backward(
            *runs[run], tiles.starts, tiles.pairs, blended, tiles.records, view.width, view.height,
            view.transmittance_min, rgb, transmittance, grad_rgb, grad_transmittance, view.absgrad, gradient_rows,
        )  # fmt: skip

    run_tasks(task, len(runs))
    return gradient_rows


def _project_backward(tiles: _Tiles, view: _View, rows: np.ndarray, inputs: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    means, quats, scales, opacities = inputs
    grads = tuple(np.empty_like(array) for array in (means, quats, scales, opacities, means))

    def task(start: int, stop: int) -> None:
        cpu_project.project_backward(
            start, stop, tiles.first, rows, means, quats, scales, opacities,
            view.axes, view.shift, view.lens, view.antialiased, *grads, view.absgrad,
        )  # fmt: skip

    run_ranges(task, len(means))
    return grads
