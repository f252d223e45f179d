"""Each operation by itself: time against the roofline, and error against the float64 reference."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial

import torch
from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.model.operation_calls import (
    OperationCall,
    decoder_inputs,
    hash_encode_call,
    join_color_and_transmittance,
    loss_call,
    mlp_call,
    named_fields,
    rasterize_call,
)
from hyrfpack.ops.adam import adam_step
from hyrfpack.ops.rasterize import Rasterization, rasterize
from hyrfpack.ops.rasterize.shaded import rasterize_shaded
from hyrfpack.ops.shade import Shading, shade
from hyrfpack.render import RenderSettings
from tools.gpu import roofline
from tools.gpu.compare import checked, relative_error, within
from tools.gpu.roofline import Work
from tools.gpu.rows import Row
from tools.gpu.scene import TIDY, TRAINED, Look, Splats, count_blended, make_cameras, make_model, splats_of
from tools.gpu.setup import Setup
from tools.gpu.timing import group_kernels, measure_rates, median_ms, profiled

TABLE = "Kernels"
# Words in the names of the GPU's kernels that tell which stage of the rasteriser they are; the rest of a forward pass,
# with torch's own sorts and prefix sums, is binning.
STAGES = {"project": ("project",), "blend": ("blend", "sum_rows")}
Works = tuple[Work, Work]  # forward, backward


def items(setup: Setup) -> list[str]:
    """The operations, in the order in which they are measured."""
    return list(ITEMS)


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Rows of one operation."""
    yield from ITEMS[item](setup)


def rates_rows(setup: Setup) -> Iterator[Row]:
    """What the others' shares are of."""
    rates = measure_rates(setup.torch_device)
    yield {"table": "Measured rates", "rate": "copy, bytes read and written", "value": f"{rates.copy / 1e12:.3f} TB/s"}
    yield {"table": "Measured rates", "rate": "bf16 matrix product", "value": f"{rates.bf16 / 1e12:.1f} TFLOP/s"}
    yield {"table": "Measured rates", "rate": "fp32 matrix product", "value": f"{rates.fp32 / 1e12:.1f} TFLOP/s"}


def rasterize_rows(name: str, look: Look, setup: Setup) -> Iterator[Row]:
    """The whole rasteriser, forward and backward; the error is that of a part of the picture."""
    splats = _splats(setup, look)
    call, crop = (rasterize_call(some.inputs, *some.view) for some in (splats, cropped(splats, setup.crop)))
    drawn = rasterize(*splats.inputs.values(), *splats.view, implementation=setup.implementation)
    pairs, pixels, count = int(drawn.pairs), setup.width * setup.height, len(splats.inputs["means"])
    blended, reached = count_blended(splats)
    tiles = -(-setup.width // 16) * -(-setup.height // 16)
    seen = int(drawn.visible.sum())
    size = f"{count:,} Gaussians, {seen:,} visible, {pairs:,} pairs, {setup.width} x {setup.height}"
    works = {
        "project": roofline.project(count),
        "bin": roofline.bin_pairs(seen, pairs, tiles),
        "blend": roofline.blend(pairs, pixels, reached, blended),
    }
    back = {
        "project": roofline.project_backward(seen),
        "blend": roofline.blend_backward(pairs, pixels, reached, blended),
    }
    totals = (sum(works.values(), Work(0, 0)), sum(back.values(), Work(0, 0)))
    yield from _timed(name, size, call, totals, setup, crop)
    forward, backward = call.separate_tasks(setup.implementation)
    for way, task, parts in (("forward", forward, works), ("backward", backward, back)):
        measured = profiled(task, 5, setup.torch_device).times
        for stage, ms in group_kernels(measured, STAGES, "bin" if way == "forward" else "other").items():
            if stage in parts and ms:
                yield _row(f"- {stage}", way, size, ms, parts[stage], setup)
            elif ms:
                yield {"table": TABLE, "kernel": f"- {stage}", "pass": way, "size": size, "ms": ms}
        for kernel, ms in list(measured.items())[:12]:
            yield {
                "table": "Rasteriser's kernels on the device",
                "call": name,
                "pass": way,
                "name": kernel[:90],
                "ms": ms,
            }


def hash_encode_rows(setup: Setup) -> Iterator[Row]:
    """Both fields' features of all Gaussians; gradients reach the table, as in training."""
    model = _model(setup)
    coords = model.cube_coords(model.gaussians.positions).detach()
    for name, field in named_fields(model):
        grid = field.grid.config
        # The table as trained ones are: numbers about 0.1, not the 1e-4 that training starts from.
        numbers = 1e3 * field.grid.table.detach(), grid.resolutions, grid.log2_table_size
        call, part = (hash_encode_call(points, *numbers) for points in (coords, _sample(coords, setup)))
        sizes = len(coords), grid.levels, grid.rows
        works = roofline.hash_encode(*sizes), roofline.hash_encode_backward(*sizes)
        size = f"{len(coords):,} points, {grid.levels} levels, {grid.rows:,} rows"
        yield from _timed(f"hash encode, {name}", size, call, works, setup, part)


def mlp_rows(mixed: bool, setup: Setup) -> Iterator[Row]:
    """Both fields' decoders on all Gaussians."""
    for name, field, x in decoder_inputs(_model(setup), torch.zeros(3)):
        x += 0.5 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0)).to(x.device)
        call, part = (mlp_call(rows, field.weights, field.biases, mixed) for rows in (x, _sample(x, setup)))
        widths = [x.shape[1], *(weight.shape[0] for weight in field.weights)]
        works = roofline.mlp(len(x), widths, mixed), roofline.mlp_backward(len(x), widths, mixed)
        precision = "mixed" if mixed else "float32"
        size = f"{len(x):,} rows, {'-'.join(map(str, widths))}"
        yield from _timed(f"mlp, {name}, {precision}", size, call, works, setup, part)


@torch.no_grad()
def decode_rows(setup: Setup) -> Iterator[Row]:
    """All Gaussians' geometry and colours, as a frame asks for them; the error is of what rounding comes to in all."""
    model, camera = _model(setup), make_cameras(1, setup.width, setup.height)[0]
    viewpoint = torch.as_tensor(camera.position, dtype=torch.float32, device=setup.torch_device)
    some = _sample(torch.arange(len(model), device=setup.torch_device), setup)
    exact = copy.deepcopy(model).double()
    exact.precision = "float32"  # no factor of the reference's products is rounded to bfloat16
    colors = (model.decode_colors(viewpoint, some), exact.decode_colors(viewpoint.double(), some))
    geometry = [
        torch.cat((part.scales, part.quats, part.opacities[:, None]), 1)
        for part in (model.decode_geometry(some), exact.decode_geometry(some))
    ]
    tasks = {
        "geometry": lambda: model.decode_geometry(),
        "radiance": lambda: model.decode_colors(viewpoint),
    }
    times = median_ms(tasks, setup.repeats, setup.torch_device)
    for (name, field), (values, reference) in zip(named_fields(model), (geometry, colors), strict=True):
        widths = [field.weights[0].shape[1], *(weight.shape[0] for weight in field.weights)]
        mixed = model.precision == "mixed"
        work = roofline.decode(len(model), widths, field.grid.config.levels, field.grid.config.rows, mixed)
        row = _row(f"decode {name}", "forward", f"{len(model):,} Gaussians", times[name], work, setup)
        error = relative_error(values, reference)
        yield row | {"value error": error} | within(error, 1e-2)


@torch.no_grad()
def shade_rows(setup: Setup) -> Iterator[Row]:
    """Colours of all Gaussians for a view, with what does not depend on it worked out before."""
    model, camera = _model(setup), make_cameras(1, setup.width, setup.height)[0]
    positions = model.gaussians.positions.detach()
    viewpoint = torch.as_tensor(camera.position, dtype=torch.float32, device=setup.torch_device)
    ours = setup.implementation
    for precision, shading in _shadings(model).items():
        task = {"shade": lambda shading=shading: shade(positions, viewpoint, shading, implementation=ours)}
        ms = median_ms(task, setup.repeats, setup.torch_device)["shade"]
        part, exact = _shading_sample(shading, setup), _shading_sample(shading, setup, torch.float64)
        some = _sample(positions, setup)
        error = relative_error(
            shade(some, viewpoint, part, implementation=ours),
            shade(some.double(), viewpoint.double(), exact, implementation="reference"),
        )
        work = roofline.shade(len(positions), _widths(shading), shading.mixed)
        row = _row(f"shade, {precision}", "forward", f"{len(positions):,} Gaussians", ms, work, setup)
        yield row | {"value error": error} | within(error, 3e-3 if shading.mixed else 1e-4)


def _shadings(model: HybridModel) -> dict[str, Shading]:
    """The model's shading by its precision; on a CPU the two are one."""
    shadings = {}
    for precision in ("float32", "mixed"):  # the second is the default: the model is left as it was
        model.precision = precision
        shading = model.shading()
        shadings["mixed" if shading.mixed else "float32"] = shading
    return shadings


def _widths(shading: Shading) -> list[int]:
    """Of the encoded direction, the hidden layers and the colours."""
    return [shading.direction_weight.shape[1], *(len(bias) for bias in (shading.first_layer[0], *shading.biases))]


def _shading_sample(shading: Shading, setup: Setup, dtype: torch.dtype | None = None) -> Shading:
    """The rows whose error is measured; numbers as they are, or all of one precision."""
    rows = {name: _sample(getattr(shading, name), setup) for name in ("first_layer", "color_logits")}
    return _cast(replace(shading, **rows), dtype)


def _cast(shading: Shading, dtype: torch.dtype | None) -> Shading:
    """The same shading, contiguous and in one precision, or in those it has."""

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
def rasterize_shaded_rows(setup: Setup) -> Iterator[Row]:
    """Culling, shading and rasterising in one, as a frame of a model that does not change asks for it; the error is
    that of a part of the picture."""
    model, splats = _model(setup), _splats(setup)
    explicit = [splats.inputs[name] for name in ("means", "quats", "scales", "opacities")]
    exact = [tensor.double() for tensor in explicit]
    blended, reached = count_blended(splats)
    tiles = -(-setup.width // 16) * -(-setup.height // 16)
    pixels = setup.width * setup.height
    for precision, shading in _shadings(model).items():

        def draw(view: tuple = splats.view, shading: Shading = shading) -> Rasterization:
            return rasterize_shaded(*explicit, shading, *view, implementation=setup.implementation)

        drawn = draw()
        pairs, seen = int(drawn.pairs), int(drawn.visible.sum())
        ms = median_ms({"draw": draw}, setup.repeats, setup.torch_device)["draw"]
        project = roofline.project_shaded(len(model), seen, _widths(shading), shading.mixed)
        # The decoder's arithmetic is left to the row of its stage: it is of other units than the blending's.
        whole = Work(project.bytes, 0) + roofline.bin_pairs(seen, pairs, tiles)
        whole += roofline.blend(pairs, pixels, reached, blended)
        view = cropped(splats, setup.crop).view
        wanted = rasterize_shaded(*exact, _cast(shading, torch.float64), *view, implementation="reference")
        error = relative_error(join_color_and_transmittance(draw(view)), join_color_and_transmittance(wanted))
        size = f"{len(model):,} Gaussians, {seen:,} visible, {pairs:,} pairs, {setup.width} x {setup.height}"
        row = _row(f"rasterize shaded, {precision}", "forward", size, ms, whole, setup)
        yield row | {"value error": error} | within(error, 3e-3 if shading.mixed else 1e-3)
        stages = group_kernels(profiled(draw, 5, setup.torch_device).times, STAGES, "bin")
        if stages["project"]:
            yield _row("- project and shade", "forward", size, stages["project"], project, setup)


@torch.no_grad()
def background_rows(setup: Setup) -> Iterator[Row]:
    """The background's grid at the window, as a frame asks for it; the error is of what rounding comes to in all."""
    model, camera = _model(setup), make_cameras(setup.views, setup.width, setup.height)[0]
    splats, defaults = splats_of(model, camera), RenderSettings()
    light = rasterize(*splats.inputs.values(), *splats.view).transmittance
    how = {"threshold": defaults.background_threshold, "stride": defaults.background_stride}
    view = camera.intrinsics, splats.pose
    exact = copy.deepcopy(model).double()
    exact.precision = "float32"  # no factor of the reference's products is rounded to bfloat16
    wanted = exact.background_grid(light.double(), *view, **how)
    on_gpu = setup.torch_device.type == "cuda"
    field, grid = model.radiance, model.radiance.grid.config
    widths = [field.weights[0].shape[1], *(weight.shape[0] for weight in field.weights)]
    nodes, needed = wanted[..., 0].numel(), int((wanted > 0).any(-1).sum())
    size = f"{needed:,} of {nodes:,} nodes, {setup.width} x {setup.height}"
    for precision in ("float32", "mixed") if on_gpu else ("mixed",):  # on a CPU they are one
        model.precision = precision  # the second is the default: the model is left as it was
        mixed = on_gpu and precision == "mixed"
        found = model.background_grid(light, *view, **how)
        task = {"grid": lambda: model.background_grid(light, *view, **how)}
        ms = median_ms(task, setup.repeats, setup.torch_device)["grid"]
        work = roofline.background(light.numel(), nodes, needed, widths, grid.levels, grid.rows, mixed)
        error = relative_error(found, wanted)
        row = _row(f"background, {'mixed' if mixed else 'float32'}", "forward", size, ms, work, setup)
        yield row | {"value error": error} | within(error, 1e-2 if mixed else 1e-3)


def ssim_rows(setup: Setup) -> Iterator[Row]:
    """Loss and gradient of a whole picture."""
    generator = torch.Generator().manual_seed(0)
    small = torch.rand(1, 3, max(1, setup.height // 20), max(1, setup.width // 20), generator=generator)
    size = (setup.height, setup.width)
    smooth = torch.nn.functional.interpolate(small, size, mode="bilinear")[0].permute(1, 2, 0)
    noise = 0.05 * torch.randn(*size, 3, generator=generator)
    pictures = [tensor.contiguous().to(setup.device) for tensor in ((smooth + noise).clamp(0, 1), smooth)]

    call = loss_call(*pictures)
    ms = median_ms({"both": call.forward_backward_task(setup.implementation)}, setup.repeats, setup.torch_device)[
        "both"
    ]
    words = f"{setup.width} x {setup.height}"
    work = roofline.photometric_loss(setup.width * setup.height)
    yield _row("SSIM and L1 loss", "both", words, ms, work, setup) | checked(call, setup.implementation)


def adam_rows(setup: Setup) -> Iterator[Row]:
    """One step of as many numbers as the Gaussians have."""
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
    ms = median_ms(task, setup.repeats, setup.torch_device)["step"]
    row = _row("Adam", "step", f"{count:,} numbers", ms, roofline.adam(count), setup)
    yield row | {"value error": error} | within(error, 1e-5)


def _timed(name: str, size: str, call: OperationCall, works: Works, setup: Setup, part: OperationCall) -> Iterator[Row]:
    """Rows of both passes of a call; the error is that of `part`."""
    tasks = dict(zip(("forward", "backward"), call.separate_tasks(setup.implementation), strict=True))
    times = median_ms(tasks, setup.repeats, setup.torch_device)
    found = checked(part, setup.implementation)
    values, gradients = found.pop("value error"), found.pop("gradient error")
    yield _row(name, "forward", size, times["forward"], works[0], setup) | {"value error": values} | found
    yield _row(name, "backward", size, times["backward"], works[1], setup) | {"gradient error": gradients} | found


def _row(name: str, way: str, size: str, ms: float, work: Work, setup: Setup) -> Row:
    rates = measure_rates(setup.torch_device)
    copy, arithmetic = work.shares(ms, rates)
    least = work.least_ms(rates)
    return {
        "table": TABLE,
        "kernel": name,
        "pass": way,
        "size": size,
        "ms": ms,
        "MB": work.bytes / 1e6,
        "GFLOP": work.flops / 1e9,
        "of copy rate": f"{copy:.0%}",
        "of matrix rate": f"{arithmetic:.0%} {work.unit}",
        "roofline ms": least,
        "roofline / time": f"{least / ms:.0%}",
    }


def cropped(splats: Splats, side: int) -> Splats:
    """The middle of the picture, at most side x side pixels."""
    camera = splats.camera
    width, height = min(side, camera.width), min(side, camera.height)
    middle = (camera.width - width) / 2, (camera.height - height) / 2
    part = type(camera)(
        width, height, camera.fx, camera.fy, camera.cx - middle[0], camera.cy - middle[1], camera.camera_from_world
    )
    return Splats(splats.inputs, splats.pose, part)


@cache
def _model(setup: Setup, look: Look = TIDY) -> HybridModel:
    return make_model(setup.kernel_gaussians, setup.torch_device, look)


def _splats(setup: Setup, look: Look = TIDY) -> Splats:
    return splats_of(_model(setup, look), make_cameras(setup.views, setup.width, setup.height)[1])


def _sample(rows: Tensor, setup: Setup) -> Tensor:
    return rows[:: max(1, len(rows) // setup.error_rows)]


ITEMS: dict[str, Callable[[Setup], Iterator[Row]]] = {
    "rates": rates_rows,
    "rasterize": partial(rasterize_rows, "rasterize", TIDY),
    "rasterize, as trained": partial(rasterize_rows, "rasterize, as trained", TRAINED),
    "hash encode": hash_encode_rows,
    "mlp mixed": lambda setup: mlp_rows(True, setup),
    "mlp float32": lambda setup: mlp_rows(False, setup),
    "decode": decode_rows,
    "shade": shade_rows,
    "rasterize shaded": rasterize_shaded_rows,
    "background": background_rows,
    "loss": ssim_rows,
    "adam": adam_rows,
}
