"""Measure each operation alone: its time against the roofline, and its error against the float64 reference."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import (
    OperationCall,
    iterate_decoder_inputs,
    join_color_and_transmittance,
    list_named_fields,
    make_hash_encode_call,
    make_loss_call,
    make_mlp_call,
    make_rasterize_call,
)
from hyrfpack.model import HybridModel
from hyrfpack.ops.adam import adam_step
from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, rasterize
from hyrfpack.ops.shade import Shading, shade
from hyrfpack.ops.viewport import Viewport
from hyrfpack.render import RenderSettings
from tools.gpu import roofline
from tools.gpu.compare import check_call, check_passes, largest_relative_error, make_bound_status, relative_error
from tools.gpu.roofline import Work
from tools.gpu.rows import Row
from tools.gpu.scene import (
    TIDY_LOOK,
    TRAINED_LOOK,
    Look,
    Splats,
    count_blended,
    decode_splats,
    make_cameras,
    make_model,
)
from tools.gpu.setup import Setup
from tools.gpu.timing import group_kernels, measure_median_ms, measure_rates, profile_task

TABLE_NAME = "Kernels"
BACKGROUND_STRIDE = 2
# Words in the kernels' names that identify their stage of the rasteriser. All other kernels of a forward pass, such as
# torch's sorts and prefix sums, belong to binning.
STAGE_KERNEL_WORDS = {"project": ("project",), "blend": ("blend", "sum_rows")}
Works = tuple[Work, Work]  # forward, backward


def items(setup: Setup) -> list[str]:
    """Return the names of the operations, in the order in which they are measured."""
    return list(ITEM_ROW_GENERATORS)


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield the rows of one operation."""
    yield from ITEM_ROW_GENERATORS[item](setup)


def measure_peak_rates(setup: Setup) -> Iterator[Row]:
    """Yield the device's measured peak rates, to which the shares in the other rows refer."""
    rates = measure_rates(setup.torch_device)
    yield {"table": "Measured rates", "rate": "copy, bytes read and written", "value": f"{rates.copy / 1e12:.3f} TB/s"}
    yield {"table": "Measured rates", "rate": "bf16 matrix product", "value": f"{rates.bf16 / 1e12:.1f} TFLOP/s"}
    yield {"table": "Measured rates", "rate": "fp32 matrix product", "value": f"{rates.fp32 / 1e12:.1f} TFLOP/s"}


def measure_rasterize(name: str, look: Look, setup: Setup) -> Iterator[Row]:
    """Measure the whole rasteriser and its stages, forward and backward; the error is that of a crop of the picture."""
    splats = _splats(setup, look)
    call, crop = (
        make_rasterize_call(view_splats.inputs, view_splats.viewport)
        for view_splats in (splats, crop_splats(splats, setup.crop))
    )
    raster = rasterize(splats.gaussians, splats.colors, splats.viewport, implementation=setup.implementation)
    pairs, pixels, count = int(raster.pairs), setup.width * setup.height, len(splats.inputs["means"])
    blended, reached = count_blended(splats)
    tiles = -(-setup.width // 16) * -(-setup.height // 16)
    visible_count = int(raster.visible.sum())
    size = f"{count:,} Gaussians, {visible_count:,} visible, {pairs:,} pairs, {setup.width} x {setup.height}"
    works = {
        "project": roofline.count_project(count),
        "bin": roofline.count_bin_pairs(visible_count, pairs, tiles),
        "blend": roofline.count_blend(pairs, pixels, reached, blended),
    }
    backward_works = {
        "project": roofline.count_project_backward(visible_count),
        "blend": roofline.count_blend_backward(pairs, pixels, reached, blended),
    }
    totals = (sum(works.values(), Work(0, 0)), sum(backward_works.values(), Work(0, 0)))
    yield from _measure_passes(name, size, call, totals, setup, crop)
    forward, backward = call.separate_tasks(setup.implementation)
    for pass_name, task, parts in (("forward", forward, works), ("backward", backward, backward_works)):
        measured = profile_task(task, 5, setup.torch_device).times
        for stage, ms in group_kernels(
            measured, STAGE_KERNEL_WORDS, "bin" if pass_name == "forward" else "other"
        ).items():
            if stage in parts and ms:
                yield _row(f"- {stage}", pass_name, size, ms, parts[stage], setup)
            elif ms:
                yield {"table": TABLE_NAME, "kernel": f"- {stage}", "pass": pass_name, "size": size, "ms": ms}
        for kernel, ms in list(measured.items())[:12]:
            yield {
                "table": "Rasteriser's kernels on the device",
                "call": name,
                "pass": pass_name,
                "name": kernel[:90],
                "ms": ms,
            }


def measure_hash_encode(setup: Setup) -> Iterator[Row]:
    """Measure the hash encoding of both fields for all Gaussians; gradients go to the table, as in training."""
    model = _model(setup)
    coords = model.cube_coords(model.gaussians.positions).detach()
    for name, field in list_named_fields(model):
        grid = field.grid.config
        # A trained table has values of about 0.1; the initial values of training are about 1e-4.
        numbers = 1e3 * field.grid.table.detach(), grid.resolutions, grid.log2_table_size
        call, part = (make_hash_encode_call(points, *numbers) for points in (coords, _sample(coords, setup)))
        sizes = len(coords), grid.levels, grid.rows
        works = roofline.count_hash_encode(*sizes), roofline.count_hash_encode_backward(*sizes)
        size = f"{len(coords):,} points, {grid.levels} levels, {grid.rows:,} rows"
        yield from _measure_passes(f"hash encode, {name}", size, call, works, setup, part)


def measure_mlp(mixed: bool, setup: Setup) -> Iterator[Row]:
    """Measure the decoders of both fields on all Gaussians."""
    for name, field, x in iterate_decoder_inputs(_model(setup), torch.zeros(3)):
        x += 0.5 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0)).to(x.device)
        call, part = (make_mlp_call(rows, field.weights, field.biases, mixed) for rows in (x, _sample(x, setup)))
        widths = [x.shape[1], *(weight.shape[0] for weight in field.weights)]
        works = roofline.count_mlp(len(x), widths, mixed), roofline.count_mlp_backward(len(x), widths, mixed)
        precision = "mixed" if mixed else "float32"
        size = f"{len(x):,} rows, {'-'.join(map(str, widths))}"
        yield from _measure_passes(f"mlp, {name}, {precision}", size, call, works, setup, part)


@torch.no_grad()
def measure_decode(setup: Setup) -> Iterator[Row]:
    """Measure the decoding of all Gaussians' geometry and colours for a frame; the error includes all rounding."""
    model, camera = _model(setup), make_cameras(1, setup.width, setup.height)[0]
    viewpoint = torch.as_tensor(camera.position, dtype=torch.float32, device=setup.torch_device)
    sample = _sample(torch.arange(len(model), device=setup.torch_device), setup)
    exact = copy.deepcopy(model).double()
    exact.precision = "float32"  # no factor of the reference's products is rounded to bfloat16
    errors = {
        "geometry": largest_relative_error(
            *(vars(decoder.decode_geometry(sample)).values() for decoder in (model, exact))
        ),
        "radiance": relative_error(
            model.decode_colors(viewpoint, sample), exact.decode_colors(viewpoint.double(), sample)
        ),
    }
    tasks = {
        "geometry": lambda: model.decode_geometry(),
        "radiance": lambda: model.decode_colors(viewpoint),
    }
    times = measure_median_ms(tasks, setup.repeats, setup.torch_device)
    for name, field in list_named_fields(model):
        widths = [field.weights[0].shape[1], *(weight.shape[0] for weight in field.weights)]
        mixed = model.precision == "mixed"
        work = roofline.count_decode(len(model), widths, field.grid.config.levels, field.grid.config.rows, mixed)
        row = _row(f"decode {name}", "forward", f"{len(model):,} Gaussians", times[name], work, setup)
        yield row | {"value error": errors[name]} | make_bound_status(errors[name], 1e-2)


@torch.no_grad()
def measure_shade(setup: Setup) -> Iterator[Row]:
    """Measure the colours of all Gaussians for a view, with the view-independent part computed beforehand."""
    model, camera = _model(setup), make_cameras(1, setup.width, setup.height)[0]
    positions = model.gaussians.positions.detach()
    viewpoint = torch.as_tensor(camera.position, dtype=torch.float32, device=setup.torch_device)
    ours = setup.implementation
    for precision, shading in _shadings(model).items():
        task = {"shade": lambda shading=shading: shade(positions, viewpoint, shading, implementation=ours)}
        ms = measure_median_ms(task, setup.repeats, setup.torch_device)["shade"]
        part, exact = _shading_sample(shading, setup), _shading_sample(shading, setup, torch.float64)
        sample = _sample(positions, setup)
        error = relative_error(
            shade(sample, viewpoint, part, implementation=ours),
            shade(sample.double(), viewpoint.double(), exact, implementation="reference"),
        )
        work = roofline.count_shade(len(positions), _widths(shading), shading.mixed)
        row = _row(f"shade, {precision}", "forward", f"{len(positions):,} Gaussians", ms, work, setup)
        yield row | {"value error": error} | make_bound_status(error, 3e-3 if shading.mixed else 1e-4)


def _shadings(model: HybridModel) -> dict[str, Shading]:
    """Return the model's shading in each precision; on a CPU both are the same."""
    shadings = {}
    for precision in ("float32", "mixed"):  # "mixed" is the default, so the model ends in its initial precision
        model.precision = precision
        shading = model.compute_shading()
        shadings["mixed" if shading.mixed else "float32"] = shading
    return shadings


def _widths(shading: Shading) -> list[int]:
    """Return the widths of the encoded direction, the hidden layers and the colours."""
    return [shading.direction_weight.shape[1], *(len(bias) for bias in (shading.first_layer[0], *shading.biases))]


def _shading_sample(shading: Shading, setup: Setup, dtype: torch.dtype | None = None) -> Shading:
    """Return the rows whose error is measured, converted to `dtype` if it is given."""
    rows = {name: _sample(getattr(shading, name), setup) for name in ("first_layer", "color_logits")}
    return _cast(replace(shading, **rows), dtype)


def _cast(shading: Shading, dtype: torch.dtype | None) -> Shading:
    """Return the shading with contiguous tensors, converted to `dtype` if it is given."""

    def cast(tensor: Tensor) -> Tensor:
        return (tensor if dtype is None else tensor.to(dtype)).contiguous()

    return replace(
        shading,
        first_layer=cast(shading.first_layer),
        color_logits=cast(shading.color_logits),
        direction_weight=cast(shading.direction_weight),
        weights=tuple(map(cast, shading.weights)),
        biases=tuple(map(cast, shading.biases)),
    )


@torch.no_grad()
def measure_rasterize_shaded(setup: Setup) -> Iterator[Row]:
    """Measure culling, shading and rasterising in one call, as for frames of a fixed model.

    The error is that of a crop of the picture.
    """
    model, splats = _model(setup), _splats(setup)
    exact = Gaussians3D(*(tensor.double() for tensor in splats.gaussians))
    blended, reached = count_blended(splats)
    tiles = -(-setup.width // 16) * -(-setup.height // 16)
    pixels = setup.width * setup.height
    for precision, shading in _shadings(model).items():

        def draw(viewport: Viewport = splats.viewport, shading: Shading = shading) -> Rasterization:
            return rasterize(splats.gaussians, shading, viewport, implementation=setup.implementation)

        raster = draw()
        pairs, visible_count = int(raster.pairs), int(raster.visible.sum())
        ms = measure_median_ms({"draw": draw}, setup.repeats, setup.torch_device)["draw"]
        project = roofline.count_project_shaded(len(model), visible_count, _widths(shading), shading.mixed)
        # The decoder's arithmetic and the blending's run on different units, so only the decoder's own row counts it.
        total_work = Work(project.bytes, 0) + roofline.count_bin_pairs(visible_count, pairs, tiles)
        total_work += roofline.count_blend(pairs, pixels, reached, blended)
        viewport = crop_splats(splats, setup.crop).viewport
        expected = rasterize(exact, _cast(shading, torch.float64), viewport, implementation="reference")
        error = relative_error(join_color_and_transmittance(draw(viewport)), join_color_and_transmittance(expected))
        size = f"{len(model):,} Gaussians, {visible_count:,} visible, {pairs:,} pairs, {setup.width} x {setup.height}"
        row = _row(f"rasterize shaded, {precision}", "forward", size, ms, total_work, setup)
        yield row | {"value error": error} | make_bound_status(error, 3e-3 if shading.mixed else 1e-3)
        stages = group_kernels(profile_task(draw, 5, setup.torch_device).times, STAGE_KERNEL_WORDS, "bin")
        if stages["project"]:
            yield _row("- project and shade", "forward", size, stages["project"], project, setup)


@torch.no_grad()
def measure_background(setup: Setup) -> Iterator[Row]:
    """Measure the background's grid at the window for a frame; the error includes all rounding."""
    model, camera = _model(setup), make_cameras(setup.views, setup.width, setup.height)[0]
    splats, defaults = decode_splats(model, camera), RenderSettings()
    light = rasterize(splats.gaussians, splats.colors, splats.viewport).transmittance
    options = {"threshold": defaults.background_threshold, "stride": BACKGROUND_STRIDE}
    exact = copy.deepcopy(model).double()
    exact.precision = "float32"  # no factor of the reference's products is rounded to bfloat16
    expected = exact.background_grid(light.double(), splats.viewport, **options)
    on_gpu = setup.torch_device.type == "cuda"
    field, grid = model.radiance, model.radiance.grid.config
    widths = [field.weights[0].shape[1], *(weight.shape[0] for weight in field.weights)]
    nodes, needed = expected[..., 0].numel(), int((expected > 0).any(-1).sum())
    size = f"{needed:,} of {nodes:,} nodes, {setup.width} x {setup.height}"
    for precision in ("float32", "mixed") if on_gpu else ("mixed",):  # on a CPU both precisions are the same
        model.precision = precision  # "mixed" is the default, so the model ends in its initial precision
        mixed = on_gpu and precision == "mixed"
        actual = model.background_grid(light, splats.viewport, **options)
        task = {"grid": lambda: model.background_grid(light, splats.viewport, **options)}
        ms = measure_median_ms(task, setup.repeats, setup.torch_device)["grid"]
        work = roofline.count_background(light.numel(), nodes, needed, widths, grid.levels, grid.rows, mixed)
        error = relative_error(actual, expected)
        row = _row(f"background, {'mixed' if mixed else 'float32'}", "forward", size, ms, work, setup)
        yield row | {"value error": error} | make_bound_status(error, 1e-2 if mixed else 1e-3)


def measure_ssim(setup: Setup) -> Iterator[Row]:
    """Measure the photometric loss and its gradient for a whole picture."""
    generator = torch.Generator().manual_seed(0)
    small = torch.rand(1, 3, max(1, setup.height // 20), max(1, setup.width // 20), generator=generator)
    size = (setup.height, setup.width)
    smooth = torch.nn.functional.interpolate(small, size, mode="bilinear")[0].permute(1, 2, 0)
    noise = 0.05 * torch.randn(*size, 3, generator=generator)
    pictures = [tensor.contiguous().to(setup.device) for tensor in ((smooth + noise).clamp(0, 1), smooth)]

    call = make_loss_call(*pictures)
    ms = measure_median_ms(
        {"both": call.forward_backward_task(setup.implementation)}, setup.repeats, setup.torch_device
    )["both"]
    size_text = f"{setup.width} x {setup.height}"
    work = roofline.count_photometric_loss(setup.width * setup.height)
    yield _row("SSIM and L1 loss", "both", size_text, ms, work, setup) | check_call(call, setup.implementation)


def measure_adam(setup: Setup) -> Iterator[Row]:
    """Measure one Adam step for as many parameters as the Gaussians have."""
    count = 8 * setup.kernel_gaussians
    generator = torch.Generator().manual_seed(0)
    states = [0.1 * torch.randn(count, generator=generator) for _ in range(3)]
    states.append(0.01 * torch.rand(count, generator=generator))
    settings = {"step": 100, "rate": 1e-2, "betas": (0.9, 0.999), "eps": 1e-15}
    results = []
    for implementation, dtype in ((setup.implementation, torch.float32), ("reference", torch.float64)):
        part = [state[: setup.error_rows].to(setup.device, dtype, copy=True) for state in states]
        adam_step(*([state] for state in part), **settings, implementation=implementation)
        results.append(torch.cat((part[0], part[2], part[3])))
    error = relative_error(*results)
    groups = [[state.to(setup.device)] for state in states]
    task = {"step": lambda: adam_step(*groups, **settings, implementation=setup.implementation)}
    ms = measure_median_ms(task, setup.repeats, setup.torch_device)["step"]
    row = _row("Adam", "step", f"{count:,} numbers", ms, roofline.count_adam(count), setup)
    yield row | {"value error": error} | make_bound_status(error, 1e-5)


def _measure_passes(
    name: str, size: str, call: OperationCall, works: Works, setup: Setup, part: OperationCall
) -> Iterator[Row]:
    """Yield the rows of both passes of a call; the errors are those of `part`, a smaller call."""
    tasks = dict(zip(("forward", "backward"), call.separate_tasks(setup.implementation), strict=True))
    times = measure_median_ms(tasks, setup.repeats, setup.torch_device)
    for (pass_name, ms), work, cells in zip(
        times.items(), works, check_passes(part, setup.implementation), strict=True
    ):
        yield _row(name, pass_name, size, ms, work, setup) | cells


def _row(name: str, pass_name: str, size: str, ms: float, work: Work, setup: Setup) -> Row:
    rates = measure_rates(setup.torch_device)
    copy, arithmetic = work.shares(ms, rates)
    roofline_ms = work.min_ms(rates)
    return {
        "table": TABLE_NAME,
        "kernel": name,
        "pass": pass_name,
        "size": size,
        "ms": ms,
        "MB": work.bytes / 1e6,
        "GFLOP": work.flops / 1e9,
        "of copy rate": f"{copy:.0%}",
        "of matrix rate": f"{arithmetic:.0%} {work.unit}",
        "roofline ms": roofline_ms,
        "roofline / time": f"{roofline_ms / ms:.0%}",
    }


def crop_splats(splats: Splats, side: int) -> Splats:
    """Return the same Gaussians with a camera for the middle of the picture, at most side x side pixels."""
    viewport = splats.viewport
    width, height = min(side, viewport.width), min(side, viewport.height)
    fx, fy, cx, cy = viewport.intrinsics
    intrinsics = fx, fy, cx - (viewport.width - width) / 2, cy - (viewport.height - height) / 2
    return Splats(splats.inputs, Viewport(viewport.pose, intrinsics, width, height))


@cache
def _model(setup: Setup, look: Look = TIDY_LOOK) -> HybridModel:
    return make_model(setup.kernel_gaussians, setup.torch_device, look)


def _splats(setup: Setup, look: Look = TIDY_LOOK) -> Splats:
    return decode_splats(_model(setup, look), make_cameras(setup.views, setup.width, setup.height)[1])


def _sample(rows: Tensor, setup: Setup) -> Tensor:
    return rows[:: max(1, len(rows) // setup.error_rows)]


# The kernels that are expected to take most of a step come first: the backward passes of hash encoding, of decoders and
# of the rasteriser with its `sum_rows`.
ITEM_ROW_GENERATORS: dict[str, Callable[[Setup], Iterator[Row]]] = {
    "rates": measure_peak_rates,
    "hash encode": measure_hash_encode,
    "mlp mixed": lambda setup: measure_mlp(True, setup),
    "rasterize, as trained": partial(measure_rasterize, "rasterize, as trained", TRAINED_LOOK),
    "rasterize": partial(measure_rasterize, "rasterize", TIDY_LOOK),
    "rasterize shaded": measure_rasterize_shaded,
    "shade": measure_shade,
    "background": measure_background,
    "loss": measure_ssim,
    "adam": measure_adam,
    "decode": measure_decode,
    "mlp float32": lambda setup: measure_mlp(False, setup),
}
