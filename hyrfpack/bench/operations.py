"""The hot operations on a model's own numbers: each implementation against the reference in float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hyrfpack.bench.rows import Row
from hyrfpack.bench.subject import Subject
from hyrfpack.measure.error import Error, largest_error, measure_error, measure_relative_error
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.model.calls import (
    Call,
    decoder_inputs,
    fields,
    hash_encode_call,
    mlp_call,
    rasterize_call,
    splat_inputs,
)
from hyrfpack.ops.poses import camera_center
from hyrfpack.scene import Camera


@dataclass(frozen=True)
class Way:
    """A way to run an operation.

    Attributes:
        name: for people.
        implementation: as the operation calls it.
        dtype: of all tensors, but for those in `dtypes`.
    """

    name: str
    implementation: str
    dtype: torch.dtype
    dtypes: Mapping[str, torch.dtype] = field(default_factory=dict)


# The first is what the others are measured against.
EXACT = Way("float64 reference", "reference", torch.float64)
RASTERIZE_WAYS = (
    EXACT,
    Way("float32 reference", "reference", torch.float32),
    Way("cpu", "cpu", torch.float32),
)
HASH_WAYS = (*RASTERIZE_WAYS, Way("cpu, bfloat16 table", "cpu", torch.float32, {"table": torch.bfloat16}))
MLP_WAYS = (*RASTERIZE_WAYS, Way("bfloat16 reference", "reference", torch.bfloat16))
DEFAULT_WAY = "cpu"


def rasterize_rows(subject: Subject, repeats: int, note: Callable[[str], None]) -> Iterator[Row]:
    """Draw the model's Gaussians as one view sees them; antialiased and not, forward and with all gradients."""
    model, camera, pose = _one_view(subject)
    inputs = splat_inputs(model, camera_center(pose))
    for antialiased in (False, True):
        call = rasterize_call(inputs, pose, camera.intrinsics, camera.width, camera.height, antialiased=antialiased)
        name = "antialiased, " if antialiased else ""
        yield from _compare("rasterize", name, call, RASTERIZE_WAYS, measure_error, repeats)


def hash_encode_rows(subject: Subject, repeats: int, note: Callable[[str], None]) -> Iterator[Row]:
    """Look up both fields' features at all Gaussians; gradients reach the table, as in training."""
    coords = subject.model.cube_coords(subject.model.gaussians.positions)
    for name, part in fields(subject.model):
        grid = part.grid.config
        call = hash_encode_call(coords, part.grid.table, grid.resolutions, grid.log2_table_size)
        yield from _compare("hash_encode", f"{name}, ", call, HASH_WAYS, measure_relative_error, repeats)


def mlp_rows(subject: Subject, repeats: int, note: Callable[[str], None]) -> Iterator[Row]:
    """Run both fields' decoders on the features of all Gaussians; the radiance field's as one view sees them."""
    model, _, pose = _one_view(subject)
    for name, part, features in decoder_inputs(model, camera_center(pose)):
        call = mlp_call(features, list(part.weights), list(part.biases))
        yield from _compare("mlp", f"{name}, ", call, MLP_WAYS, measure_relative_error, repeats)


def _one_view(subject: Subject) -> tuple[HybridModel, Camera, Tensor]:
    """The model, a camera, and its pose (4, 4) camera_from_local, float64."""
    camera = subject.cameras[len(subject.cameras) // 2]
    return subject.model, camera, torch.as_tensor(subject.model.config.frame.local_pose(camera))


def _compare(
    group: str,
    prefix: str,
    call: Call,
    ways: tuple[Way, ...],
    compare: Callable[[Tensor, Tensor, str], Error],
    repeats: int,
) -> Iterator[Row]:
    """Rows of one operation, forward alone and with gradients; all ways take turns."""
    for setting, make in (("forward", call.forward), ("forward + backward", call.both)):
        tasks = {way.name: make(way.implementation, way.dtype, way.dtypes) for way in ways}
        for way in ways:
            if way.implementation == "cpu":
                tasks[way.name]()  # compiles kernels that are not cached: not to be taken for a slow first run
        times, results = time_alternately(tasks, repeats)
        exact = results[ways[0].name]
        for way in ways:
            what, result = f"{group}, {prefix}{setting}, {way.name}", results[way.name]
            parts = {}
            if make == call.both:
                pairs = zip(call.wanted, result[1], exact[1], strict=True)
                parts = {name: measure_relative_error(found, right, what) for name, found, right in pairs}
            yield Row(
                group=group,
                setting=prefix + setting,
                value=way.name,
                is_reference=way is ways[0],
                is_default=way.name == DEFAULT_WAY,
                time=times[way.name],
                ratio=times[way.name].ratio_to(times[ways[0].name]),
                error=largest_error(list(parts.values())) if parts else compare(result, exact, what),
                parts=parts,
            )
