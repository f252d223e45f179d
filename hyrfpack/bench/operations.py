"""Measure the hot operations on a model's own data: each implementation against the float64 reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import (
    OperationCall,
    collect_splat_inputs,
    iterate_decoder_inputs,
    list_named_fields,
    make_hash_encode_call,
    make_mlp_call,
    make_rasterize_call,
)
from hyrfpack.bench.rows import Row
from hyrfpack.bench.subject import Subject
from hyrfpack.measure.error import Error, largest_error, measure_error, measure_relative_error
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import RasterSettings
from hyrfpack.ops.viewport import Viewport


@dataclass(frozen=True)
class Variant:
    """An implementation and the dtypes that an operation runs with.

    Attributes:
        name: name in tables and plots.
        implementation: name by which the operation selects the implementation.
        dtype: dtype of all tensors that are not in `dtypes`.
        dtypes: dtypes of individual tensors by name.
    """

    name: str
    implementation: str
    dtype: torch.dtype
    dtypes: Mapping[str, torch.dtype] = field(default_factory=dict)


# The first variant of each tuple is the reference of the others.
FLOAT64_REFERENCE = Variant("float64 reference", "reference", torch.float64)
RASTERIZE_VARIANTS = (
    FLOAT64_REFERENCE,
    Variant("float32 reference", "reference", torch.float32),
    Variant("cpu", "cpu", torch.float32),
)
HASH_ENCODE_VARIANTS = (
    *RASTERIZE_VARIANTS,
    Variant("cpu, bfloat16 table", "cpu", torch.float32, {"table": torch.bfloat16}),
)
MLP_VARIANTS = (*RASTERIZE_VARIANTS, Variant("bfloat16 reference", "reference", torch.bfloat16))
DEFAULT_VARIANT = "cpu"


def measure_rasterize(subject: Subject, repeats: int, notes: list[str]) -> Iterator[Row]:
    """Measure the rasterisation of one view, with and without antialiasing, forward and with all gradients."""
    model, viewport = _middle_view(subject)
    inputs = collect_splat_inputs(model, camera_center(viewport.pose))
    for antialiased in (False, True):
        call = make_rasterize_call(inputs, viewport, RasterSettings(antialiased=antialiased))
        name = "antialiased, " if antialiased else ""
        yield from _compare("rasterize", name, call, RASTERIZE_VARIANTS, measure_error, repeats)


def measure_hash_encode(subject: Subject, repeats: int, notes: list[str]) -> Iterator[Row]:
    """Measure the lookup of both fields' features at all Gaussians, with gradients of the table, as in training."""
    coords = subject.model.cube_coords(subject.model.gaussians.positions)
    for name, part in list_named_fields(subject.model):
        grid = part.grid.config
        call = make_hash_encode_call(coords, part.grid.table, grid.resolutions, grid.log2_table_size)
        yield from _compare("hash_encode", f"{name}, ", call, HASH_ENCODE_VARIANTS, measure_relative_error, repeats)


def measure_mlp(subject: Subject, repeats: int, notes: list[str]) -> Iterator[Row]:
    """Measure both fields' decoders on the features of all Gaussians, seen from one camera."""
    model, viewport = _middle_view(subject)
    for name, part, features in iterate_decoder_inputs(model, camera_center(viewport.pose)):
        call = make_mlp_call(features, list(part.weights), list(part.biases))
        yield from _compare("mlp", f"{name}, ", call, MLP_VARIANTS, measure_relative_error, repeats)


def _middle_view(subject: Subject) -> tuple[HybridModel, Viewport]:
    """Return the model and the middle camera in local units, with a float64 pose."""
    camera = subject.cameras[len(subject.cameras) // 2]
    return subject.model, subject.model.config.frame.local_viewport(camera, torch.float64)


def _compare(
    group: str,
    prefix: str,
    call: OperationCall,
    variants: tuple[Variant, ...],
    compare: Callable[[Tensor, Tensor, str], Error],
    repeats: int,
) -> Iterator[Row]:
    """Yield the rows of one operation, forward only and with gradients; all variants are timed in turns."""
    for setting, make in (("forward", call.forward_task), ("forward + backward", call.forward_backward_task)):
        tasks = {variant.name: make(variant.implementation, variant.dtype, variant.dtypes) for variant in variants}
        for variant in variants:
            if variant.implementation == "cpu":
                tasks[variant.name]()  # compiles kernels that are not cached, which must not count as a slow first run
        times, results = time_alternately(tasks, repeats)
        exact = results[variants[0].name]
        for variant in variants:
            what, result = f"{group}, {prefix}{setting}, {variant.name}", results[variant.name]
            parts = {}
            if make == call.forward_backward_task:
                pairs = zip(call.gradient_inputs, result[1], exact[1], strict=True)
                parts = {name: measure_relative_error(value, reference, what) for name, value, reference in pairs}
            yield Row(
                group=group,
                setting=prefix + setting,
                value=variant.name,
                is_reference=variant is variants[0],
                is_default=variant.name == DEFAULT_VARIANT,
                time=times[variant.name],
                ratio=times[variant.name].ratio_to(times[variants[0].name]),
                error=largest_error(list(parts.values())) if parts else compare(result, exact, what),
                parts=parts,
            )
