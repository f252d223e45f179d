"""Time whole frames and training steps of a synthetic room, and compare the rasteriser with gsplat's if installed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import OperationCall
from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.render import render_view
from hyrfpack.scene import Camera
from tools.gpu.rows import Row, make_goal_row, make_kernel_rows
from tools.gpu.scene import (
    TIDY_LOOK,
    TRAINED_LOOK,
    Splats,
    count_blended,
    decode_splats,
    make_cameras,
    make_model,
    make_scene,
    perturb,
)
from tools.gpu.setup import GOAL_ROOM_NAME, Setup
from tools.gpu.timing import measure_median_ms, profile_task, read_peak_memory_mb, reset_peak_memory, synchronize
from tools.gpu.worker import failure_row

GOAL_FRAMES_PER_SECOND, GOAL_GSPLAT_SPEED_RATIO = 300.0, 0.8
AS_TRAINED_SUFFIX = ", as trained"  # the end of the names of rooms with TRAINED_LOOK
# gsplat finishes a pixel at this transmittance; for the comparison our rasteriser uses the same value.
GSPLAT_TRANSMITTANCE_MIN = 1e-4


def items(setup: Setup) -> list[str]:
    """Return one item for each room, the most useful first: those of the goals' size, as trained before tidy."""
    rooms = [f"{count:,}{AS_TRAINED_SUFFIX}" for count in setup.trained_gaussians]
    rooms += [f"{count:,}" for count in setup.frame_gaussians]
    return sorted(rooms, key=lambda room: room.removesuffix(AS_TRAINED_SUFFIX) != GOAL_ROOM_NAME)


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield the rows of one room: statistics, training, frames and rasteriser, measured after a short training."""
    number, look = item.removesuffix(AS_TRAINED_SUFFIX), TRAINED_LOOK if item.endswith(AS_TRAINED_SUFFIX) else TIDY_LOOK
    count, device = int(number.replace(",", "")), setup.torch_device
    cameras = make_cameras(setup.views, setup.width, setup.height)
    truth = make_model(count, device, look)
    scene = make_scene(truth, cameras)
    model, training = truth, None
    try:
        from tools.gpu.training import time_training

        training = time_training(item, scene, perturb(truth), setup)
        model = training.model
    except ModuleNotFoundError as error:  # the trainer needs more packages than rendering
        reason = failure_row(error)
        if reason["status"] == "failed":
            raise
        yield {"table": "Training", "Gaussians": item, **reason}
    splats = decode_splats(model, cameras[1])
    yield _statistics_row(item, splats, model)
    if training:
        yield from training.rows()
    yield from _frame_rows(item, model, cameras, setup)
    # gsplat may build an extension first, which can use up the time limit, so this comes last.
    yield from _rasterizer_rows(item, splats, setup)


def _statistics_row(room: str, splats: Splats, model: HybridModel) -> Row:
    with torch.no_grad():
        rasterization = rasterize(splats.gaussians, splats.colors, splats.viewport)
    pixels = rasterization.transmittance.numel()
    blended, reached = count_blended(splats)
    return {
        "table": "The room",
        "Gaussians": room,
        "visible": f"{int(rasterization.visible.sum()):,}",
        "pairs": f"{int(rasterization.pairs):,}",
        "pairs a pixel": 256 * int(rasterization.pairs) / pixels,
        "blended a pixel": blended,
        "of a tile's pairs reached": f"{reached:.0%}",
        "light from the background": f"{float(rasterization.transmittance.mean()):.1%}",
        "median opacity": float(splats.inputs["opacities"].median()),
        "hash rows a level": f"2^{model.config.radiance.log2_table_size}",
    }


def _frame_rows(room: str, model: HybridModel, cameras: list[Camera], setup: Setup) -> Iterator[Row]:
    """Yield the frames per second over all cameras; the wall-clock time includes a final wait for the device."""
    device = setup.torch_device
    with torch.no_grad():
        for name in ("decoded once", "decoded each frame"):
            decoded = None  # frees what the other row has decoded
            reset_peak_memory(device)
            if name == "decoded once":
                decoded = model.decode()
            ms = _frame_ms(partial(render_view, model, decoded=decoded), cameras, setup)
            yield {
                "table": f"Frames, {setup.width} x {setup.height}",
                "Gaussians": room,
                "model": name,
                "frames/s": 1e3 / ms,
                "ms": ms,
                "peak MB": read_peak_memory_mb(device),
            }
            if name == "decoded once" and room == GOAL_ROOM_NAME:
                yield make_goal_row(
                    f"frames of {room} Gaussians", 1e3 / ms, GOAL_FRAMES_PER_SECOND, "frames/s", at_least=True
                )
        decoded = model.decode()
        times = profile_task(lambda: render_view(model, cameras[1], decoded=decoded), 5, device).times
    yield from make_kernel_rows(times, f"A frame of {room} Gaussians: kernels on the device")


def _frame_ms(draw: Callable[[Camera], object], cameras: list[Camera], setup: Setup) -> float:
    for camera in cameras[:3]:
        draw(camera)
    synchronize(setup.torch_device)
    start, frames = time.perf_counter(), 0
    for _ in range(setup.repeats):
        for camera in cameras:
            draw(camera)
            frames += 1
        synchronize(setup.torch_device)
        if time.perf_counter() - start > 3:
            break
    return 1e3 * (time.perf_counter() - start) / frames


def _rasterizer_rows(room: str, splats: Splats, setup: Setup) -> Iterator[Row]:
    """Time our rasteriser and gsplat's on the same Gaussians, forward only and with all gradients."""
    draws = {"hyrfpack": partial(_draw_with_hyrfpack, splats)}
    row = {"table": "Rasterising against gsplat", "Gaussians": room}
    try:
        draws["gsplat"] = _make_gsplat_draw(splats)
    except Exception as error:  # gsplat may be missing or not fit this torch; our rasteriser is still measured
        yield {**row, "status": "left out", "note": f"gsplat's rasteriser cannot be compared: {str(error)[:200]}"}
    calls = {name: OperationCall(draw, splats.inputs, tuple(splats.inputs)) for name, draw in draws.items()}
    tasks = {f"{name} forward": call.forward_task("auto") for name, call in calls.items()}
    tasks |= {f"{name} forward and backward": call.forward_backward_task("auto") for name, call in calls.items()}
    times = measure_median_ms(tasks, setup.repeats, setup.torch_device)
    for pass_name in ("forward", "forward and backward"):
        hyrfpack_ms, gsplat_ms = times[f"hyrfpack {pass_name}"], times.get(f"gsplat {pass_name}")
        cells = {"pass": pass_name, "ms": hyrfpack_ms, "gsplat ms": gsplat_ms}
        yield row | cells | ({"speed over gsplat's": gsplat_ms / hyrfpack_ms} if gsplat_ms else {})
        if gsplat_ms and room == GOAL_ROOM_NAME:
            yield make_goal_row(
                f"rasterising {room}, {pass_name}",
                gsplat_ms / hyrfpack_ms,
                GOAL_GSPLAT_SPEED_RATIO,
                "of gsplat's speed",
                at_least=True,
            )


def _draw_with_hyrfpack(splats: Splats, implementation: str, **inputs: Tensor) -> Tensor:
    *gaussians, colors = inputs.values()
    settings = RasterSettings(transmittance_min=GSPLAT_TRANSMITTANCE_MIN)
    return rasterize(Gaussians3D(*gaussians), colors, splats.viewport, settings, implementation=implementation).rgb


def _make_gsplat_draw(splats: Splats) -> Callable[..., Tensor]:
    """Return gsplat's rasteriser as a draw function, with settings as close to ours as it allows."""
    from gsplat import rasterization

    fx, fy, cx, cy = splats.viewport.intrinsics
    view = splats.viewport.pose.to(splats.inputs["means"])[None]
    intrinsics = view.new_tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]])
    size = splats.viewport.width, splats.viewport.height

    def draw(implementation: str, **inputs: Tensor) -> Tensor:
        return rasterization(*inputs.values(), view, intrinsics, *size, near_plane=0.01, packed=False)[0]

    draw("auto", **splats.inputs)  # the first call builds gsplat's extension, or raises
    return draw
