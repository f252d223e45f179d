"""Whole frames and whole training steps of a made-up room, beside gsplat where that is installed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.model.operation_calls import OperationCall
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.render import render
from hyrfpack.scene import Camera
from tools.gpu.rows import Row, goal, kernel_rows
from tools.gpu.scene import (
    TIDY,
    TRAINED,
    Splats,
    count_blended,
    disturb,
    make_cameras,
    make_model,
    make_scene,
    splats_of,
)
from tools.gpu.setup import GOAL_ROOM, Setup
from tools.gpu.timing import median_ms, peak_mb, profiled, reset_peak, synchronize
from tools.gpu.worker import failure

GOAL_FRAMES, GOAL_SPEED = 300.0, 0.8
AS_TRAINED = ", as trained"  # what ends the name of a room of that look
GSPLAT_TRANSMITTANCE_MIN = 1e-4  # where gsplat finishes a pixel; ours goes on as far when the two are compared


def items(setup: Setup) -> list[str]:
    """One for each number of Gaussians, and those of rooms that are as training leaves them."""
    return [f"{count:,}" for count in setup.frame_gaussians] + [
        f"{count:,}{AS_TRAINED}" for count in setup.trained_gaussians
    ]


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Statistics, frames, rasteriser and training of that many Gaussians, trained a little first."""
    number, look = item.removesuffix(AS_TRAINED), TRAINED if item.endswith(AS_TRAINED) else TIDY
    count, device = int(number.replace(",", "")), setup.torch_device
    cameras = make_cameras(setup.views, setup.width, setup.height)
    truth = make_model(count, device, look)
    scene = make_scene(truth, cameras)
    model, training = truth, None
    try:
        from tools.gpu.training import timed_training

        training = timed_training(item, scene, disturb(truth), setup)
        model = training.model
    except ModuleNotFoundError as error:  # the trainer needs more packages than rendering
        reason = failure(error)
        if reason["status"] == "failed":
            raise
        yield {"table": "Training", "Gaussians": item, **reason}
    splats = splats_of(model, cameras[1])
    yield _statistics(item, splats, model)
    if training:
        yield from training.rows()
    yield from _frames(item, model, cameras, setup)
    yield from _rasterizer(item, splats, setup)  # last: gsplat may build an extension first, and take all the time


def _statistics(room: str, splats: Splats, model: HybridModel) -> Row:
    with torch.no_grad():
        drawn = rasterize(*splats.inputs.values(), *splats.view)
    pixels = drawn.transmittance.numel()
    blended, reached = count_blended(splats)
    return {
        "table": "The room",
        "Gaussians": room,
        "visible": f"{int(drawn.visible.sum()):,}",
        "pairs": f"{int(drawn.pairs):,}",
        "pairs a pixel": 256 * int(drawn.pairs) / pixels,
        "blended a pixel": blended,
        "of a tile's pairs reached": f"{reached:.0%}",
        "light from the background": f"{float(drawn.transmittance.mean()):.1%}",
        "median opacity": float(splats.inputs["opacities"].median()),
        "hash rows a level": f"2^{model.config.radiance.log2_table_size}",
    }


def _frames(room: str, model: HybridModel, cameras: list[Camera], setup: Setup) -> Iterator[Row]:
    """Frames a second over all cameras, by the wall clock with the device waited for at the end."""
    device = setup.torch_device
    reset_peak(device)
    with torch.no_grad():
        decoded = model.decode()
        ways: dict[str, Callable[[Camera], object]] = {
            "decoded once": lambda camera: render(model, camera, decoded=decoded),
            "decoded each frame": lambda camera: render(model, camera),
        }
        for name, draw in ways.items():
            ms = _frame_ms(draw, cameras, setup)
            yield {
                "table": f"Frames, {setup.width} x {setup.height}",
                "Gaussians": room,
                "model": name,
                "frames/s": 1e3 / ms,
                "ms": ms,
                "peak MB": peak_mb(device),
            }
            if name == "decoded once" and room == GOAL_ROOM:
                yield goal(f"frames of {room} Gaussians", 1e3 / ms, GOAL_FRAMES, "frames/s", at_least=True)
        times = profiled(lambda: render(model, cameras[1], decoded=decoded), 5, device).times
    yield from kernel_rows(times, f"A frame of {room} Gaussians: kernels on the device")


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


def _rasterizer(room: str, splats: Splats, setup: Setup) -> Iterator[Row]:
    """The rasteriser alone, and gsplat's on the same Gaussians; forward alone and with all gradients."""
    draws = {"hyrfpack": partial(_ours, splats)}
    row = {"table": "Rasterising against gsplat", "Gaussians": room}
    try:
        draws["gsplat"] = _gsplat(splats)
    except Exception as error:  # not there, or not for this torch: whatever it is, ours is measured
        yield {**row, "status": "left out", "note": f"gsplat's rasteriser cannot be compared: {str(error)[:200]}"}
    calls = {name: OperationCall(draw, splats.inputs, tuple(splats.inputs)) for name, draw in draws.items()}
    tasks = {f"{name} forward": call.forward_task("auto") for name, call in calls.items()}
    tasks |= {f"{name} forward and backward": call.forward_backward_task("auto") for name, call in calls.items()}
    times = median_ms(tasks, setup.repeats, setup.torch_device)
    for way in ("forward", "forward and backward"):
        ours, theirs = times[f"hyrfpack {way}"], times.get(f"gsplat {way}")
        cells = {"pass": way, "ms": ours, "gsplat ms": theirs}
        yield row | cells | ({"speed over gsplat's": theirs / ours} if theirs else {})
        if theirs and room == GOAL_ROOM:
            yield goal(f"rasterising {room}, {way}", theirs / ours, GOAL_SPEED, "of gsplat's speed", at_least=True)


def _ours(splats: Splats, implementation: str, **inputs: Tensor) -> Tensor:
    how = {"transmittance_min": GSPLAT_TRANSMITTANCE_MIN, "implementation": implementation}
    return rasterize(*inputs.values(), *splats.view, **how).rgb


def _gsplat(splats: Splats) -> Callable[..., Tensor]:
    """gsplat's rasteriser with the rules of ours, as far as it has them."""
    from gsplat import rasterization

    fx, fy, cx, cy = splats.camera.intrinsics
    view = splats.pose.to(splats.inputs["means"])[None]
    intrinsics = view.new_tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]])
    size = splats.camera.width, splats.camera.height

    def draw(implementation: str, **inputs: Tensor) -> Tensor:
        return rasterization(*inputs.values(), view, intrinsics, *size, near_plane=0.01, packed=False)[0]

    draw("auto", **splats.inputs)  # builds its extension, or fails here
    return draw
