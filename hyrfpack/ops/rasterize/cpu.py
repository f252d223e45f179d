"""Rasterises on the CPU with Numba kernels on the shared thread pool, behind one autograd.Function."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.rasterize import cpu_bin, cpu_blend, cpu_median, cpu_project
from hyrfpack.ops.rasterize.cpu_project import GaussianArrays, Projection, ProjectionSettings
from hyrfpack.ops.rasterize.inputs import Gaussians3D, RasterSettings
from hyrfpack.ops.rasterize.reference import TILE_SIZE, jacobian_limits
from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel.pool import run_ranges, run_tasks
from hyrfpack.parallel.threads import thread_count

# A thread blends about this many pairs in the time that another one takes to start. Shorter runs would not pay off.
_MIN_PAIRS_PER_RUN = 128


@dataclass(frozen=True)
class _View:
    """The arguments of `rasterize` that get no gradients. Each has one fixed type, since kernels are compiled per type.

    Attributes:
        projection: the camera, and the settings of the projection.
        transmittance_min, depth: as in `RasterSettings`.
        absgrad: as in `rasterize`, or None.
    """

    projection: ProjectionSettings
    transmittance_min: np.float32
    depth: bool
    absgrad: np.ndarray | None

    @property
    def size(self) -> tuple[int, int]:
        """Return height and width of the image."""
        return self.projection.height, self.projection.width


@dataclass(frozen=True)
class _Tiles:
    """The (Gaussian, tile) pairs of an image, ordered by tile and, within a tile, by depth.

    Attributes:
        records: (V, 16) the projections of the V drawn Gaussians in depth order, see cpu_project.
        slot_starts: (N + 1,) the first slot of each Gaussian. Slots number the pairs Gaussian by Gaussian.
        starts: (tiles + 1,) the first pair of each tile.
        pairs: (P,) uint64, packed as in cpu_bin.
    """

    records: np.ndarray
    slot_starts: np.ndarray
    starts: np.ndarray
    pairs: np.ndarray


def rasterize(
    gaussians: Gaussians3D, colors: Tensor, viewport: Viewport, settings: RasterSettings, absgrad: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None, Tensor, int, dict[str, float]]:
    """Compute `hyrfpack.ops.rasterize.rasterize`; the result is a tuple of the fields of `Rasterization` in order."""
    view = _make_view(viewport, settings, None if absgrad is None else absgrad.detach())
    report: dict = {}
    rgb, transmittance, depths, visible = _Rasterize.apply(*gaussians, colors, view, report)
    return rgb, transmittance, depths, visible, report["pairs"], report["seconds"]


@torch.no_grad()
def sum_blend_weights(gaussians: Gaussians3D, viewport: Viewport, settings: RasterSettings) -> tuple[Tensor, Tensor]:
    """Compute `hyrfpack.ops.rasterize.blend_weights.sum_blend_weights`."""
    view = _make_view(viewport, settings)
    means, quats, scales, opacities = (tensor.detach().contiguous().numpy() for tensor in gaussians)
    projection = _project(GaussianArrays(means, quats, scales, opacities, means), view)  # Colours are not used.
    tiles = _bin_pairs(cpu_bin.sort_by_depth(projection.keys), projection, view)
    pair_weights, transmittance = np.zeros(len(tiles.pairs), np.float32), np.empty(view.size, np.float32)
    _blend_into(tiles, view, None, transmittance, None, pair_weights)
    sums = np.empty(len(means), np.float32)
    run_ranges(lambda start, stop: cpu_blend.sum_slots(start, stop, tiles.slot_starts, pair_weights, sums), len(means))
    return torch.from_numpy(sums), torch.from_numpy(transmittance)


@torch.no_grad()
def median_depth(
    gaussians: Gaussians3D, slopes: Tensor, max_ratio: float, viewport: Viewport, settings: RasterSettings
) -> Tensor:
    """Compute `hyrfpack.ops.rasterize.median_depth.median_depth`.

    Args:
        slopes: (N, 3) slopes dz/dx and dz/dy of each Gaussian's plane; the third column is not used.
        max_ratio: limit of a depth in the plane relative to the depth of the centre.
    """
    view = _make_view(viewport, settings)
    arrays = GaussianArrays(*(tensor.detach().contiguous().numpy() for tensor in (*gaussians, slopes)))
    projection = _project(arrays, view)
    tiles = _bin_pairs(cpu_bin.sort_by_depth(projection.keys), projection, view)
    depth = np.empty(view.size, np.float32)
    runs = _tile_runs(tiles.starts)

    def task(run: int) -> None:
        cpu_median.median_tiles(*runs[run], tiles.starts, tiles.pairs, tiles.records, np.float32(max_ratio), depth)

    run_tasks(task, len(runs))
    return torch.from_numpy(depth)


def _make_view(viewport: Viewport, settings: RasterSettings, absgrad: Tensor | None = None) -> _View:
    """Convert the arguments of `rasterize` that get no gradients to the types that the kernels take."""
    camera = viewport.pose.detach().double().tolist()[:3]
    projection = ProjectionSettings(
        axes=tuple(tuple(row[:3]) for row in camera),
        shift=tuple(row[3] for row in camera),
        lens=tuple(float(number) for number in (*viewport.intrinsics, *jacobian_limits(viewport))),
        width=int(viewport.width),
        height=int(viewport.height),
        near=float(settings.near),
        antialiased=bool(settings.antialiased),
        low_pass_variance=float(settings.low_pass_variance),
    )
    return _View(
        projection,
        transmittance_min=np.float32(settings.transmittance_min),
        depth=settings.depth,
        absgrad=None if absgrad is None else absgrad.numpy(),
    )


class _Rasterize(torch.autograd.Function):
    """Autograd function of `rasterize`."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, colors, view, report):
        inputs = tuple(tensor.contiguous() for tensor in (means, quats, scales, opacities, colors))
        arrays = GaussianArrays(*(tensor.detach().numpy() for tensor in inputs))
        times = [perf_counter()]
        projection = _project(arrays, view)
        times.append(perf_counter())
        order = cpu_bin.sort_by_depth(projection.keys)
        times.append(perf_counter())
        tiles = _bin_pairs(order, projection, view)
        times.append(perf_counter())
        rgb, transmittance, depths, blended = _blend(tiles, view)
        times.append(perf_counter())

        report["pairs"] = len(tiles.pairs)
        report["seconds"] = {
            stage: times[i + 1] - times[i] for i, stage in enumerate(("project", "sort", "bin", "blend"))
        }
        visible = torch.from_numpy(tiles.slot_starts[1:] > tiles.slot_starts[:-1])
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
        gradient = grad_rgb.contiguous().numpy(), grad_transmittance.contiguous().numpy()
        rows = _blend_backward(ctx.tiles, ctx.blended, ctx.view, (rgb, transmittance), gradient)
        grads = _project_backward(ctx.tiles, ctx.view, rows, GaussianArrays(*inputs, inputs[0]))
        return *(torch.from_numpy(grad) for grad in grads), None, None


def _cache_line_rows(count: int) -> np.ndarray:
    """Allocate an uninitialised array (count, 16) of float32 with each row on one cache line."""
    numbers = np.empty(16 * count + 16, np.float32)
    skip = -numbers.ctypes.data // 4 % 16
    return numbers[skip : skip + 16 * count].reshape(count, 16)


def _as_tuples(*values: tuple) -> list[tuple]:
    """Convert named tuples to tuples, whose types Numba recognises in a fraction of the time."""
    return [tuple(value) for value in values]


def _project(gaussians: GaussianArrays, view: _View) -> Projection:
    """Project all Gaussians."""
    count = len(gaussians.means)
    projection = Projection(_cache_line_rows(count), np.empty(count, np.uint32), np.empty(count, np.uint32))
    arguments = _as_tuples(gaussians, view.projection, projection)
    run_ranges(lambda start, stop: cpu_project.project(start, stop, *arguments), count)
    return projection


def _bin_pairs(order: np.ndarray, projection: Projection, view: _View) -> _Tiles:
    """List the pairs of each tile in depth order.

    Raises:
        MemoryError: there are cpu_bin.MAX_PAIRS pairs or more.
    """
    count, records, (height, width) = len(order), projection.records, view.size
    tile_total = -(-width // TILE_SIZE) * -(-height // TILE_SIZE)
    chunks = max(1, min(4 * thread_count(), count // 256))
    edges = [count * i // chunks for i in range(chunks + 1)]
    tile_counts = np.zeros((chunks, tile_total), np.int64)
    slot_starts = np.zeros(len(records) + 1, np.int64)
    sorted_records = _cache_line_rows(count)
    chunk_pairs: list = [None] * chunks
    pair_count = 0

    def find_chunk_pairs(chunk: int) -> None:
        nonlocal pair_count
        if pair_count >= cpu_bin.MAX_PAIRS:  # Further pairs would only take memory.
            raise _too_many_pairs()
        chunk_pairs[chunk] = cpu_bin.find_pairs(
            edges[chunk], edges[chunk + 1], order, projection.tile_count_bounds, records, width, height,
            cpu_bin.MAX_PAIRS, tile_counts[chunk], slot_starts[1:], sorted_records,
        )  # fmt: skip
        pair_count += len(chunk_pairs[chunk][0])

    run_tasks(find_chunk_pairs, chunks)
    np.cumsum(slot_starts, out=slot_starts)
    starts = np.empty(tile_total + 1, np.int64)
    cpu_bin.assign_chunk_offsets(tile_counts, starts)
    if slot_starts[-1] >= cpu_bin.MAX_PAIRS:
        raise _too_many_pairs()
    pairs = np.empty(slot_starts[-1], np.uint64)

    def fill_chunk_pairs(chunk: int) -> None:
        cpu_bin.fill_tiles(
            edges[chunk], edges[chunk + 1], order, slot_starts, *chunk_pairs[chunk], tile_counts[chunk], pairs
        )

    run_tasks(fill_chunk_pairs, chunks)
    return _Tiles(sorted_records, slot_starts, starts, pairs)


def _too_many_pairs() -> MemoryError:
    return MemoryError(f"a view has {cpu_bin.MAX_PAIRS:,} pairs of a Gaussian and a tile or more")


def _tile_runs(starts: np.ndarray) -> list[tuple[int, int]]:
    """Split the tiles into contiguous runs of about equal work, 16 per thread if there is enough work."""
    work = starts + 4 * np.arange(len(starts))  # An empty tile costs about as much as four pairs.
    count = max(1, min(16 * thread_count(), len(starts) - 1, work[-1] // _MIN_PAIRS_PER_RUN))
    edges = np.searchsorted(work, work[-1] * np.arange(1, count) // count)
    edges = np.unique(np.concatenate([[0], edges, [len(starts) - 1]])).tolist()
    return list(zip(edges[:-1], edges[1:], strict=True))


def _blend(tiles: _Tiles, view: _View) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]:
    """Blend all tiles; returns rgb, transmittance, depth if requested, and the pairs blended in each tile."""
    rgb, transmittance = np.empty((*view.size, 3), np.float32), np.empty(view.size, np.float32)
    depths = np.empty(view.size, np.float32) if view.depth else None
    return rgb, transmittance, depths, _blend_into(tiles, view, rgb, transmittance, depths, None)


def _blend_into(
    tiles: _Tiles,
    view: _View,
    rgb: np.ndarray | None,
    transmittance: np.ndarray,
    depths: np.ndarray | None,
    pair_weights: np.ndarray | None,
) -> np.ndarray:
    """Blend all tiles into the given arrays; returns the number of pairs blended in each tile, (tiles,)."""
    blended = np.empty(len(tiles.starts) - 1, np.uint32)
    runs = _tile_runs(tiles.starts)

    def task(run: int) -> None:
        cpu_blend.blend_tiles(
            *runs[run], tiles.starts, tiles.pairs, tiles.records, view.transmittance_min, rgb, transmittance, depths,
            pair_weights, blended,
        )  # fmt: skip

    run_tasks(task, len(runs))
    return blended


def _blend_backward(
    tiles: _Tiles,
    blended: np.ndarray,
    view: _View,
    image: tuple[np.ndarray, np.ndarray],
    gradient: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return the gradient row of each pair, (P, 16), at its slot; see `cpu_blend.blend_tiles_backward`."""
    gradient_rows = _cache_line_rows(len(tiles.pairs))
    runs = _tile_runs(tiles.starts)

    def task(run: int) -> None:
        cpu_blend.blend_tiles_backward(
            *runs[run], tiles.starts, tiles.pairs, blended, tiles.records, view.transmittance_min, image, gradient,
            view.absgrad, gradient_rows,
        )  # fmt: skip

    run_tasks(task, len(runs))
    return gradient_rows


def _project_backward(tiles: _Tiles, view: _View, rows: np.ndarray, gaussians: GaussianArrays) -> GaussianArrays:
    """Return the gradients of all arrays of Gaussians. Colours are not used; any array of their shape will do."""
    gradients = GaussianArrays(*map(np.empty_like, gaussians))
    arguments = _as_tuples(gaussians, view.projection, gradients)

    def task(start: int, stop: int) -> None:
        cpu_project.project_backward(start, stop, tiles.slot_starts, rows, *arguments, view.absgrad)

    run_ranges(task, len(gaussians.means))
    return gradients
