"""Time each stage of the rasteriser, compare its speed with the torch reference, and measure its error.

    python -m tools.bench --only rasterize

Workload A has 50,000 Gaussians at 320 x 240 pixels, B has 200,000 at 800 x 800; both come from a fixed seed. Times are
medians in ms over alternating repeats. The reference runs only on A and on one thread. The speed ratio compares CPU
time summed over threads, because other load on the machine affects it least.
"""

from __future__ import annotations

from statistics import median
from time import perf_counter, process_time

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import make_random_cotangent, make_rasterize_call
from hyrfpack.measure.error import largest_error, measure_error, measure_relative_error
from hyrfpack.ops.rasterize import INPUT_SHAPES, Gaussians3D, rasterize
from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel.threads import thread_count

# Number of Gaussians, width and height in pixels, and standard deviation of a Gaussian in pixels.
WORKLOAD_SIZES = {"A": (50_000, 320, 240, 1.75), "B": (200_000, 800, 800, 2.6)}
TIMING_REPEATS = 7
REFERENCE_REPEATS = (1, 4)  # the reference runs in two of the repeats only, because it takes seconds
TIMED_STAGES = ("project", "sort", "bin", "blend", "forward", "backward")


def make_workload(name: str) -> tuple[dict[str, Tensor], Viewport]:
    """Return the tensors of `rasterize` by name, spread over the picture at depths 2 to 8, and the camera."""
    count, width, height, sigma = WORKLOAD_SIZES[name]
    generator = torch.Generator().manual_seed(0)
    focal = 1.2 * width
    size = torch.tensor([width, height])
    z = 2 + 6 * torch.rand(count, 1, generator=generator)
    pixels = (1.1 * torch.rand(count, 2, generator=generator) - 0.05) * size
    means = torch.cat([(pixels - size / 2) / focal * z, z], 1)
    quats = torch.randn(count, 4, generator=generator)
    scales = sigma * torch.exp(0.6 * torch.randn(count, 3, generator=generator)) * z / focal
    opacities = torch.sigmoid(1.5 * torch.randn(count, generator=generator) - 1)
    colors = torch.rand(count, 3, generator=generator)
    viewport = Viewport(torch.eye(4, dtype=torch.float64), (focal, focal, width / 2, height / 2), width, height)
    return dict(zip(INPUT_SHAPES, (means, quats, scales, opacities, colors), strict=True)), viewport


def time_stages(inputs: dict[str, Tensor], viewport: Viewport, implementation: str) -> dict[str, float]:
    """Run one forward and one backward pass; return the pairs, and the ms of each stage and of CPU time ("_work")."""
    *gaussians, colors = (tensor.detach().clone().requires_grad_() for tensor in inputs.values())
    absgrad, size = torch.zeros(len(colors), 2), (viewport.height, viewport.width)
    upstream = make_random_cotangent(torch.empty(*size, 3)), make_random_cotangent(torch.empty(size))
    started, work = perf_counter(), process_time()
    picture = rasterize(Gaussians3D(*gaussians), colors, viewport, absgrad=absgrad, implementation=implementation)
    forward_end, forward_end_work = perf_counter(), process_time()
    torch.autograd.backward([picture.rgb, picture.transmittance], upstream)
    times = {**picture.seconds, "forward": forward_end - started, "backward": perf_counter() - forward_end}
    times |= {"forward_work": forward_end_work - work, "backward_work": process_time() - forward_end_work}
    return {"pairs": picture.pairs, **{stage: 1e3 * seconds for stage, seconds in times.items()}}


def bench() -> list[dict]:
    """Return one row for each workload: medians in ms, ns per pair, and for A the speed ratio and the errors."""
    calls = {(name, "cpu"): make_workload(name) for name in WORKLOAD_SIZES}
    calls["A", "reference"] = make_workload("A")
    time_stages(*calls["B", "cpu"], "cpu")  # the first call compiles the kernels
    times = {key: [] for key in calls}
    for repeat in range(TIMING_REPEATS):
        for key, call in calls.items():
            if key[1] == "cpu":
                times[key].append(time_stages(*call, "cpu"))
            elif repeat in REFERENCE_REPEATS:
                threads = torch.get_num_threads()
                torch.set_num_threads(1)
                times[key].append(time_stages(*call, "reference"))
                torch.set_num_threads(threads)

    rows = []
    for name in WORKLOAD_SIZES:
        cpu_times = times[name, "cpu"]
        row = {"workload": name, "threads": thread_count(), "pairs": cpu_times[0]["pairs"]}
        row |= {f"{stage}_ms": median(time[stage] for time in cpu_times) for stage in TIMED_STAGES}
        row |= {
            f"{pass_name}_ns_a_pair": 1e6 * row[f"{pass_name}_ms"] / row["pairs"]
            for pass_name in ("forward", "backward")
        }
        rows.append(row)
    for pass_name in ("forward", "backward"):
        ours, slow = (
            median(time[f"{pass_name}_work"] for time in times["A", implementation])
            for implementation in ("cpu", "reference")
        )
        rows[0][f"{pass_name}_times_faster"] = slow / ours
    return [rows[0] | measure_errors(*calls["A", "cpu"]), *rows[1:]]


def measure_errors(inputs: dict[str, Tensor], viewport: Viewport) -> dict[str, float]:
    """Return the errors against the float64 reference.

    `value_error` is the largest error of picture and transmittance. `gradient_error` is the largest rms error of the
    five gradients, relative to each gradient's rms. Where alpha or T falls on the other side of its threshold, a few
    pixels differ by more than rounding; `share_beyond_1e-5` is the share of values that differ by more than 1e-5.
    """
    call = make_rasterize_call(inputs, viewport)
    (values, gradients), (exact, slopes) = (
        call.forward_backward_task("cpu")(),
        call.forward_backward_task("reference", torch.float64)(),
    )
    pairs = zip(call.gradient_inputs, gradients, slopes, strict=True)
    return {
        "value_error": measure_error(values, exact, "picture").max,
        "share_beyond_1e-5": float(((values - exact).abs() > 1e-5).double().mean()),
        "gradient_error": largest_error(
            [measure_relative_error(found, right, name) for name, found, right in pairs]
        ).rms,
    }
