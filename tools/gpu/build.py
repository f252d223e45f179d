"""Build every Triton kernel of hyrfpack.ops for several GPU types without a GPU, and report the kernels' resources.

    python -m tools.gpu.build                  a table for each kernel and target: registers per thread, shared memory
                                               in bytes per program, spills in bytes (NVIDIA) or registers (AMD)
    python -m tools.gpu.build --json           the same as JSON; tests/tools/test_gpu_build.py reads it
    python -m tools.gpu.build --compare DIR    registers and spills in a Markdown table, also those of the Triton in DIR

The operations run as usual on small CPU tensors, but a launch only builds its kernel, for a driver that names the
target. The build has the types, constants, alignment and options of the launch. So this file needs no list of kernels
and signatures. It reports kernels that no operation launches.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import multiprocessing
import os
import pkgutil
import re
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest import mock

os.environ.pop("TRITON_INTERPRET", None)  # Triton reads it when kernels are defined

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.overrides import TorchFunctionMode
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction

from tools.gpu import sass
from tools.gpu.build_tables import format_comparison, format_table

if TYPE_CHECKING:
    from hyrfpack.ops.viewport import Viewport

GPU_TARGETS = {
    "sm_90": GPUTarget("cuda", 90, 32),
    "sm_80": GPUTarget("cuda", 80, 32),
    "sm_86": GPUTarget("cuda", 86, 32),
    "sm_89": GPUTarget("cuda", 89, 32),
    "sm_120": GPUTarget("cuda", 120, 32),
    "sm_100": GPUTarget("cuda", 100, 32),
    "gfx942": GPUTarget("hip", "gfx942", 64),
}
SASS_TARGETS = ("sm_89", "sm_90")  # whose machine code is read
BUILD_PROCESSES = 2
Run = Callable[[], object]


@dataclass(frozen=True)
class Build:
    """One kernel built for one target.

    Attributes:
        kernel: the kernel's module and name.
        target: a key of GPU_TARGETS.
        constants: the specialisation: constexprs, arguments that are 1 or None, and multiples of 16.
        warps: number of warps in a program.
        registers: registers of a thread (AMD: vector registers).
        shared: shared memory of a program in bytes.
        spills: bytes of local memory per thread (NVIDIA), or spilled registers (AMD).
        error: why the build failed; empty if it succeeded.
        sass: fields of `SassFacts` on SASS_TARGETS, if Triton has the disassembler.
    """

    kernel: str
    target: str
    constants: str = ""
    warps: int = 0
    registers: int = 0
    shared: int = 0
    spills: int = 0
    error: str = ""
    sass: dict[str, int] | None = None


# The runs of each operation. Triton builds a kernel separately for sizes that are multiples of 16, for other sizes, and
# for size 1; and for rows of which only the device knows how many are in use, as in training.


def count_rows(rows: int) -> Tensor:
    """Return a number of rows in use."""
    return torch.tensor([rows])


def make_viewport(width: int, height: int) -> Viewport:
    from hyrfpack.ops.viewport import Viewport

    return Viewport(torch.eye(4), (50.0, 50.0, width / 2, height / 2), width, height)


def ssim_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.ssim import photometric_loss

    for mask in (None, torch.ones(height, width, dtype=torch.bool)):
        image = torch.rand(height, width, 3, requires_grad=True)
        yield lambda image=image, mask=mask: photometric_loss(image, image.detach(), mask).backward()


def hash_encode_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.model.hash_grid import HashGridConfig
    from hyrfpack.ops.hash_encode import hash_encode, level_offsets

    # On a level this coarse, even few points make the kernel use several copies of the gradient.
    resolutions, size = HashGridConfig(log2_table_size=10, base=4).resolutions, 10
    table = torch.rand(level_offsets(resolutions, size)[-1], 2, requires_grad=True)
    coords = torch.rand(count, 3, requires_grad=True)
    # The gradient is stored by columns, as `mlp` returns it in training, and by rows.
    by_columns, by_rows = torch.ones(2 * len(resolutions), count).T, torch.ones(count, 2 * len(resolutions))
    for grad, used in ((by_columns, count_rows(count)), (by_rows, None)):
        yield lambda grad=grad, used=used: hash_encode(coords, table, resolutions, size, used=used).backward(grad)


def mlp_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.mlp import mlp
    from hyrfpack.ops.shade import DIRECTION_FEATURES

    for inputs, outputs in ((32 + DIRECTION_FEATURES["frequency"], 3), (32, 8)):  # radiance, geometry
        widths = [inputs, 64, 64, outputs]
        shapes = list(zip(widths[1:], widths, strict=False))
        weights = [torch.rand(shape, requires_grad=True) for shape in shapes]
        biases = [torch.rand(shape[0], requires_grad=True) for shape in shapes]
        x = torch.rand(inputs, count).T.requires_grad_()
        for mixed in (False, True):
            run = partial(mlp, x, weights, biases, mixed=mixed)
            # In training an activation follows, whose gradient is stored by rows.
            yield lambda run=run: (run() + run(used=count_rows(count))).sigmoid().sum().backward()


def rasterize_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize

    def run(antialiased: bool, depth: bool, absgrad: bool) -> None:
        shapes = (count, 3), (count, 4), (count, 3), (count,), (count, 3)
        inputs = [torch.rand(shape, requires_grad=True) for shape in shapes]
        settings = RasterSettings(antialiased=antialiased, depth=depth)
        buffer = torch.zeros(count, 2)
        options = {"absgrad": buffer, "used": count_rows(count), "reserve": 4096} if absgrad else {}
        drawn = rasterize(Gaussians3D(*inputs[:4]), inputs[4], make_viewport(width, height), settings, **options)
        (drawn.rgb.sum() + drawn.transmittance.sum()).backward()

    for options in ((False, False, True), (False, True, False), (True, False, True), (True, True, False)):
        yield partial(run, *options)


def adam_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.adam import adam_step

    def run(start: int, *enabled: Tensor | None) -> None:
        lists = [[torch.rand(count + start)[start:]] for _ in range(4)]
        for flag in enabled:
            adam_step(*lists, step=1, rate=0.1, enabled=flag)

    yield partial(run, 0, torch.tensor(True), None)
    yield partial(run, 1, None)


def shade_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
    from hyrfpack.ops.shade import DIRECTION_FEATURES, Shading, shade

    def run(encoding: str, mixed: bool, antialiased: bool) -> None:
        first = torch.rand(count, 64, dtype=torch.bfloat16 if mixed else torch.float32)
        weights, biases = (torch.rand(64, 64), torch.rand(3, 64)), (torch.rand(64), torch.rand(3))
        directions = torch.rand(64, DIRECTION_FEATURES[encoding])
        shading = Shading(first, directions, weights, biases, torch.rand(count, 3), encoding, mixed)
        gaussians = Gaussians3D(*(torch.rand(count, *shape) for shape in ((3,), (4,), (3,), ())))
        shade(gaussians.means, torch.zeros(3), shading)
        settings = RasterSettings(antialiased=antialiased)
        rasterize(gaussians, shading, make_viewport(width, height), settings)

    for options in (("frequency", True, False), ("frequency", False, True), ("sh", True, True), ("sh", False, False)):
        yield partial(run, *options)


def background_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.model.hash_grid import HashGridConfig
    from hyrfpack.ops.background import BackgroundField, background_grid
    from hyrfpack.ops.shade import DIRECTION_FEATURES

    grid = HashGridConfig(log2_table_size=10)
    for encoding, mixed in (("frequency", True), ("frequency", False), ("sh", True), ("sh", False)):
        widths = [2 * grid.levels + DIRECTION_FEATURES[encoding], 64, 64, 3]
        field = BackgroundField(
            half_extent=(1.0, 1.0, 1.0),
            table=torch.rand(grid.rows, 2),
            resolutions=grid.resolutions,
            log2_table_size=grid.log2_table_size,
            weights=[torch.rand(shape) for shape in zip(widths[1:], widths, strict=False)],
            biases=[torch.rand(size) for size in widths[1:]],
            encoding=encoding,
            mixed=mixed,
        )
        draw = partial(background_grid, torch.rand(height, width), make_viewport(width, height))
        draw = partial(draw, threshold=0.1, stride=2 if mixed else 4)
        yield partial(draw, field)
        learnt = replace(field, table=torch.rand(grid.rows, 2, requires_grad=True))
        yield lambda draw=draw, field=learnt: draw(field).sum().backward()


def contraction_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.contraction import contract

    for used in (None, count_rows(count)):
        yield partial(contract, torch.rand(count, 3), (1.0, 0.5, 2.0), used=used)


def directions_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.shade import DIRECTION_FEATURES, encode_views

    for encoding in DIRECTION_FEATURES:
        used = count_rows(count) if encoding == "frequency" else None
        yield partial(encode_views, torch.rand(count, 3), torch.zeros(3), encoding, used=used)


def activate_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.activate import activate_geometry

    def run(rule: str, half_extent: tuple[float, float, float] | None) -> None:
        raw, logits = torch.rand(count, 8, requires_grad=True), torch.rand(count, 1)
        used = count_rows(count) if rule == "sum" else None
        parts = activate_geometry(
            raw, torch.rand(count, 3), logits, logits, half_extent=half_extent, rule=rule, used=used
        )
        sum(part.sum() for part in parts).backward()

    for options in (("sum", (1.0, 0.5, 2.0)), ("product", (1.0, 0.5, 2.0)), ("sum", None)):
        yield partial(run, *options)


def cull_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.rasterize.cull import frustum_cull, frustum_cull_into

    yield partial(frustum_cull, torch.rand(count, 3), make_viewport(width, height), 0.01, 0.3)
    yield partial(frustum_cull_into, torch.rand(count, 3), make_viewport(width, height), 0.01, 0.3, count)


def rows_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.rows import place_rows, take_rows

    for columns in (3, 1):
        values, index = torch.rand(count, columns, requires_grad=True), torch.arange(count)
        yield lambda v=values, i=index: take_rows(v, i, count_rows(count)).sum().backward()
        yield lambda v=values, i=index: place_rows(v, i, count_rows(count), count).sum().backward()


def composite_runs(count: int, width: int, height: int) -> Iterator[Run]:
    from hyrfpack.ops.background import grid_size
    from hyrfpack.ops.composite import composite

    def run(stride: int) -> None:
        light, grid = (torch.rand(*size, requires_grad=True) for size in ((height, width), (3, *nodes(stride))))
        composite(torch.rand(height, width, 3), light, grid.permute(1, 2, 0), stride).sum().backward()

    def nodes(stride: int) -> tuple[int, int]:
        return grid_size(height, width, stride)

    for stride in (2, 4):
        yield partial(run, stride)


OPERATION_RUNS = {
    "mlp": mlp_runs,
    "shade": shade_runs,
    "background": background_runs,
    "rasterize": rasterize_runs,
    "ssim": ssim_runs,
    "hash_encode": hash_encode_runs,
    "adam": adam_runs,
    "contraction": contraction_runs,
    "directions": directions_runs,
    "activate": activate_runs,
    "cull": cull_runs,
    "rows": rows_runs,
    "composite": composite_runs,
}
# (points, width, height). The first target builds for all sizes and runs. The others build for the first size and the
# first two runs of each operation, which take the most registers.
LAUNCH_SIZES = (1003, 101, 67), (1024, 128, 96), (1, 1, 1)
RUNS_ON_OTHER_TARGETS = 2


@triton.jit
def _spilling_kernel(numbers, COUNT: tl.constexpr):
    """Use more registers than a thread has, to test whether Triton builds for a target and reports spills."""
    at = tl.arange(0, COUNT)
    a = tl.load(numbers + at)
    b = tl.load(numbers + COUNT + at)
    total = tl.sum(a * b, 0)
    tl.store(numbers + at, a + total)
    tl.store(numbers + COUNT + at, b + total)


class _TargetDriver:
    """Stand-in for a GPU driver that only names its target."""

    def __init__(self, target: GPUTarget) -> None:
        self.get_current_target = lambda: target
        self.get_current_device = lambda: 0
        self.get_current_stream = lambda device: 0


class _FillNewTensors(TorchFunctionMode):
    """Fill new tensors with ones in place of a kernel's output, so that the host reads only small sizes from them."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        return result.fill_(1) if func in (torch.empty, torch.empty_like, Tensor.new_empty) else result


def build(task: tuple[str, str]) -> list[Build]:
    """Run one operation as if on one target; return its builds, including the failed ones."""
    operation, name = task
    target, builds = GPU_TARGETS[name], {}
    launch = JITFunction.run

    def record(kernel: JITFunction, *args: object, grid: object, warmup: bool, **options: object) -> None:
        try:
            built = launch(kernel, *args, grid=grid, warmup=True, **options)
            if built.hash not in builds:
                builds[built.hash] = _describe_build(kernel, name, built)
        except Exception as error:  # the compilers raise exceptions of many types
            builds[str(error)] = Build(_kernel_name(kernel), name, error=_format_error(error))

    with ExitStack() as stack:
        for change in _patches_for(name):
            stack.enter_context(change)
        triton.runtime.driver.set_active(_TargetDriver(target))
        stack.enter_context(mock.patch.object(JITFunction, "run", record))
        try:
            if operation == "probe":
                numbers = 256 * target.warp_size
                _spilling_kernel[(1,)](torch.empty(2 * numbers), COUNT=numbers, num_warps=1)
            else:
                is_main_target = name == next(iter(GPU_TARGETS))
                for sizes in LAUNCH_SIZES if is_main_target else LAUNCH_SIZES[:1]:
                    for run in islice(
                        OPERATION_RUNS[operation](*sizes), None if is_main_target else RUNS_ON_OTHER_TARGETS
                    ):
                        run()
        except Exception as error:  # if the host code fails, the other operations still run
            last = traceback.extract_tb(error.__traceback__)[-1]
            builds[""] = Build(operation, name, error=f"{_format_error(error)} ({last.filename}:{last.lineno})")
    return list(builds.values())


def _patches_for(name: str) -> Iterator[object]:
    """Yield the patches that make operations on CPU tensors launch the same kernels as on a target."""
    from hyrfpack.ops import dispatch

    def choose(operation: str, implementation: str, available: tuple[str, ...], *tensors: Tensor) -> str:
        return "gpu" if "gpu" in available else "reference"

    target = GPU_TARGETS[name]
    capability = (9, 4) if target.backend == "hip" else divmod(target.arch, 10)
    properties = SimpleNamespace(multi_processor_count=132, name=name)
    yield mock.patch.object(dispatch, "choose_implementation", choose)  # must precede the import of an operation
    yield mock.patch.object(torch.version, "hip", "6.4" if target.backend == "hip" else None)
    yield mock.patch.object(torch.cuda, "get_device_properties", lambda *_: properties)
    yield mock.patch.object(torch.cuda, "get_device_capability", lambda *_: capability)
    yield _FillNewTensors()


def _format_error(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _describe_build(kernel: JITFunction, target: str, built: object) -> Build:
    source = built.src
    constants = [f"{_argument_name(kernel, path)}={value}" for path, value in source.constants.items()]
    aligned = [_argument_name(kernel, path) for path in source.attrs]
    registers, spills = _read_resources(built)
    metadata = built.metadata
    described = " ".join(constants) + " /16: " + " ".join(aligned)
    name, facts = _kernel_name(kernel), None
    if target in SASS_TARGETS and sass.has_disassembler():
        facts = asdict(sass.read_facts(built.asm["cubin"]))
    return Build(name, target, described, metadata.num_warps, registers, metadata.shared, spills, sass=facts)


def _argument_name(kernel: JITFunction, path: tuple[int, ...]) -> str:
    """Return the name of an argument, with its place if it is an element of a tuple, such as "biases.1"."""
    return ".".join((kernel.arg_names[path[0]], *map(str, path[1:])))


def _read_resources(built: object) -> tuple[int, int]:
    """Return the registers and spills of a built kernel."""
    if "amdgcn" in built.asm:
        counts = dict(re.findall(r"\.(\w+_count):\s*(\d+)", built.asm["amdgcn"]))
        return int(counts["vgpr_count"]), int(counts["vgpr_spill_count"]) + int(counts["sgpr_spill_count"])
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(built.asm["cubin"])
        file.flush()
        command = [tool, "--dump-resource-usage", file.name]
        listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    usage = {key: int(value) for key, value in re.findall(r"(REG|STACK|LOCAL):(\d+)", listed)}
    return usage["REG"], usage["STACK"] + usage["LOCAL"]


def list_kernels(_: object = None) -> list[str]:
    """Return the names of the kernels of hyrfpack.ops: Triton functions without result that no other function calls."""
    import hyrfpack.ops

    for module in pkgutil.walk_packages(hyrfpack.ops.__path__, "hyrfpack.ops."):
        if module.name.rpartition(".")[2].startswith("gpu"):
            importlib.import_module(module.name)
    modules = [module for name, module in sys.modules.items() if name.startswith("hyrfpack.ops.")]
    functions = {value for module in modules for value in vars(module).values() if isinstance(value, JITFunction)}
    called = {callee for function in functions for callee in _iterate_called_functions(function)}
    return sorted(_kernel_name(function) for function in functions - called if not _returns_value(function))


def _kernel_name(function: JITFunction) -> str:
    return f"{function.module.removeprefix('hyrfpack.ops.')}.{function.fn.__name__}"


def _returns_value(function: JITFunction) -> bool:
    return any(isinstance(node, ast.Return) and node.value is not None for node in ast.walk(function.parse()))


def _iterate_called_functions(function: JITFunction) -> Iterator[object]:
    """Yield the Triton functions and module members that a function's code can name."""
    names = function.fn.__code__.co_names
    for value in (function.fn.__globals__.get(name) for name in names):
        if isinstance(value, ModuleType):
            yield from (getattr(value, name) for name in names if hasattr(value, name))
        elif isinstance(value, JITFunction):
            yield value


def build_all() -> dict[str, Any]:
    """Build all kernels for all targets.

    Returns:
        "triton": its version. "builds": one row for each build. "probes": for each target, one row of a kernel that
        must spill. "left_out": the kernels that no operation launched.
    """
    # Each task runs in its own process, because operations make choices at import that depend on the target. Processes
    # inherit Triton's digest of its own sources, because computing it takes longer than most tasks.
    importlib.import_module("triton.experimental.gluon")
    getattr(triton.runtime.cache, "triton_key", lambda: None)()
    with multiprocessing.get_context("fork").Pool(BUILD_PROCESSES, maxtasksperchild=1) as pool:
        kernels = pool.apply_async(list_kernels)
        probes = sum(pool.map(build, [("probe", name) for name in GPU_TARGETS], chunksize=1), [])
        buildable = [probe.target for probe in probes if not probe.error]
        tasks = [(operation, name) for operation in OPERATION_RUNS for name in buildable]
        builds = sum(pool.map(build, tasks, chunksize=1), [])
        launched = {build.kernel for build in builds}
        left_out = [kernel for kernel in kernels.get() if kernel not in launched]
    return {
        "triton": triton.__version__,
        "builds": list(map(asdict, builds)),
        "probes": list(map(asdict, probes)),
        "left_out": left_out,
    }


def build_all_with(folder: str) -> dict[str, Any]:
    """Return what `build_all` returns with the Triton that is installed in a folder."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((folder, os.environ.get("PYTHONPATH", "")))}
    command = [sys.executable, "-m", "tools.gpu.build", "--json"]
    process = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(process.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--compare", metavar="DIR", help="folder with another version of Triton")
    arguments = parser.parse_args()
    if arguments.compare and not Path(arguments.compare, "triton").is_dir():
        parser.error(f"--compare {arguments.compare}: there is no Triton; install one with pip install --target")
    reports = [build_all()]
    if arguments.compare:
        reports.insert(0, build_all_with(arguments.compare))
        print(f"Triton {' / '.join(report['triton'] for report in reports)}\n", *format_comparison(reports), sep="\n")
    else:
        print(json.dumps(reports[0]) if arguments.json else "\n".join(format_table(reports[0])))


if __name__ == "__main__":
    main()
