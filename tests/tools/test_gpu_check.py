"""tools/gpu/check.py: work counted by hand, its page, its behaviour on errors, and a complete run."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hyrfpack import train
from hyrfpack.bench.operation_calls import OperationCall
from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError, needs_package
from hyrfpack.export.cameras import write_colmap
from hyrfpack.ops.dispatch import has_triton
from hyrfpack.ops.rasterize import RasterSettings, rasterize
from hyrfpack.ops.rasterize.reference import project
from hyrfpack.parallel.child_items import run_in_children
from tools.gpu import check as gpu_check
from tools.gpu import first_contact as gpu_first_contact
from tools.gpu import frames as gpu_frames
from tools.gpu import full_run as gpu_full_run
from tools.gpu import kernels as gpu_kernels
from tools.gpu import prepare as gpu_prepare
from tools.gpu import quality as gpu_quality
from tools.gpu import repeat as gpu_repeat
from tools.gpu import report as gpu_report
from tools.gpu import roofline as gpu_roofline
from tools.gpu import sanitizer as gpu_sanitizer
from tools.gpu import suite as gpu_suite
from tools.gpu import tests as gpu_tests
from tools.gpu import timing as gpu_timing
from tools.gpu.compare import check_call
from tools.gpu.process import SECONDS_TO_END, TimedProcess
from tools.gpu.rows import make_goal_row
from tools.gpu.scene import TIDY_LOOK, TRAINED_LOOK, Look, decode_splats, make_cameras, make_model
from tools.gpu.setup import Setup, find_dataset
from tools.gpu.worker import failure_row, find_missing_package

HAS_CUDA = torch.cuda.is_available()
KERNEL_IMPLEMENTATION = "gpu" if has_triton() else "cpu"
TINY_SETUP = Setup(
    device="cuda" if HAS_CUDA else "cpu",
    implementation=KERNEL_IMPLEMENTATION,
    width=16,
    height=16,
    kernel_gaussians=24,
    frame_gaussians=(200,),
    trained_gaussians=(200,),
    error_rows=32,
    crop=16,
    repeats=1,
    views=4,
    warm_steps=1,
    steps=2,
    demo_views=9,
    demo_size=16,
    quality_steps=4,
)
PEAK_RATES = gpu_timing.Rates(copy=1e12, bf16=4e14, fp32=2e13)

# A child of gpu_worker for tests. Its items print a row, raise, die, hang, or leave the device unusable.
CHILD_SCRIPT = f"""
import sys
sys.path.insert(0, {str(gpu_check.REPOSITORY_ROOT)!r})
import os, time
from tools.gpu import worker as gpu_worker
usable = True
def run(item):
    global usable
    yield {{"what": item}}
    if item == "raises":
        raise ValueError("one\\nline")
    if item == "breaks":
        usable = False
        raise RuntimeError("illegal access")
    if item == "lacks":
        import no_such_package
    if item == "dies":
        print("last words", flush=True)
        os._exit(9)
    if item == "hangs":
        time.sleep(60)
    if item == "hangs in a test":
        print("test_loop", flush=True)
        time.sleep(60)
sys.exit(gpu_worker.run_child(run, sys.argv[1:], lambda: usable))
"""


def run_children(*items: str, seconds: float = 20.0, **limits: Any) -> dict[str, list[str]]:
    """Return by item what its rows say: "fine", or the status and its reason."""
    rows = run_in_children(lambda left: [sys.executable, "-c", CHILD_SCRIPT, *left], items, seconds, **limits)
    results: dict[str, list[str]] = {}
    for row in rows:
        results.setdefault(row["item"], []).append(f"{row['status']}: {row['note']}" if "status" in row else "fine")
    return results


def test_work_of_the_rasteriser_matches_a_count_by_hand() -> None:
    assert gpu_roofline.count_project(10).bytes == 10 * 4 * (3 + 4 + 3 + 1 + 2 + 3 + 1 + 1)
    # 3 Gaussians are sorted by 4 bytes, and 5 pairs by the 13 bits of 8,160 tiles: 4 and 2 passes of 8 bytes each way.
    sorting = 3 * 4 * 16 + 5 * 2 * 16
    assert gpu_roofline.count_bin_pairs(3, 5, 8160).bytes == 3 * 28 + 5 * 8 + sorting
    work = gpu_roofline.count_blend(pairs=6, pixels=512, reached=0.5, blended=2.0)
    assert work.bytes == 3 * 40 + 512 * 16
    assert work.flops == 3 * 256 * 12 + 2 * 512 * 10
    work = gpu_roofline.count_blend_backward(pairs=6, pixels=512, reached=0.5, blended=2.0)
    assert work.bytes == 3 * (40 + 44) + 512 * 20
    assert work.flops == 3 * 256 * 12 + 2 * 512 * 40


def test_work_of_the_fields_matches_a_count_by_hand() -> None:
    # 100 points, 16 levels of 2 features; 12,800 corners may need all of the 5,000 rows.
    assert gpu_roofline.count_hash_encode(100, 16, 5000).bytes == 100 * 3 * 4 + 100 * 32 * 4 + 5000 * 8
    assert gpu_roofline.count_hash_encode(100, 16, 50_000).bytes == 100 * 3 * 4 + 100 * 32 * 4 + 12_800 * 8
    assert gpu_roofline.count_hash_encode_backward(100, 16, 50_000).bytes == 100 * 3 * 4 + 100 * 32 * 4 + 50_000 * 8
    weights = 32 * 64 + 64 * 64 + 64 * 8
    work = gpu_roofline.count_decode(100, (32, 64, 64, 8), 16, 5000, mixed=True)
    assert work.bytes == 100 * 3 * 4 + 5000 * 8 + 100 * 8 * (4 + 4) and work.unit == "bf16"
    assert work.flops == 100 * (16 * (49 + 32) + 2 * weights + 10 * 8)
    work = gpu_roofline.count_mlp(100, (32, 64, 64, 8), mixed=True)
    assert (work.bytes, work.flops, work.unit) == (100 * 40 * 4 + weights * 4, 100 * weights * 2, "bf16")
    work = gpu_roofline.count_shade(100, (24, 64, 64, 3), mixed=True)
    assert work.bytes == 100 * ((3 + 3 + 3) * 4 + 64 * 2)
    assert work.flops == 100 * (2 * (24 * 64 + 64 * 64 + 64 * 3) + 60)
    # Of 500 Gaussians 100 are drawn; positions are read once.
    fused = gpu_roofline.count_project_shaded(500, 100, (24, 64, 64, 3), mixed=True)
    assert fused.bytes == 500 * 72 + 100 * ((3 + 3) * 4 + 64 * 2)
    assert (fused.flops, fused.unit) == (work.flops, "bf16")
    # 100 of 180 nodes are needed; their 12,800 corners may need all of the 5,000 rows.
    work = gpu_roofline.count_background(700, 180, 100, (56, 64, 64, 3), 16, 5000, mixed=False)
    assert work.bytes == 700 * 4 + 180 * 3 * 4 + 5000 * 8 and work.unit == "fp32"
    assert work.flops == 100 * (16 * (49 + 32) + 2 * (56 * 64 + 64 * 64 + 64 * 3) + 130)
    work = gpu_roofline.count_mlp_backward(100, (32, 64, 64, 8), mixed=False)
    assert work.flops == 2 * 100 * (2 * weights + 32 * 64 + 64 * 64) and work.unit == "fp32"


def test_work_of_loss_and_optimiser_matches_a_count_by_hand() -> None:
    assert gpu_roofline.count_photometric_loss(10).bytes == 10 * 3 * 3 * 4
    assert gpu_roofline.count_photometric_loss(10).flops == 10 * 3 * (8 * 2 * 11 * 2 + 40)
    assert gpu_roofline.count_adam(10).bytes == 10 * (4 + 3) * 4


def test_the_roofline_is_the_slower_of_memory_and_arithmetic() -> None:
    memory, arithmetic = gpu_roofline.Work(2e9, 2e10), gpu_roofline.Work(2e9, 8e11, "bf16")
    assert memory.min_ms(PEAK_RATES) == pytest.approx(2.0)
    assert arithmetic.min_ms(PEAK_RATES) == pytest.approx(2.0)
    assert memory.shares(4.0, PEAK_RATES) == pytest.approx((0.5, 0.25))
    assert gpu_roofline.Work(1e9, 8e12, "bf16").min_ms(PEAK_RATES) == pytest.approx(20.0)


def test_kernels_of_the_profiler_are_added_up_and_grouped_by_stage() -> None:
    class Event:
        def __init__(self, key: str, microseconds: float, count: int, device: str = "DeviceType.CUDA") -> None:
            self.key, self.self_device_time_total, self.device_type = key, microseconds, device
            self.count = count

    events = [
        Event("project_kernel", 2000, 2),
        Event("blend_kernel", 6000, 2),
        Event("aten::sort", 5000, 2, "DeviceType.CPU"),
        Event("cudaStreamSynchronize", 0, 6, "DeviceType.CPU"),
        Event("cudaDeviceSynchronize", 0, 1, "DeviceType.CPU"),  # an event of the profiler itself
        Event("DeviceRadixSortKernel", 1000, 8),
        Event("memset", 500, 2),
    ]
    profile = gpu_timing.summarize_events(events, runs=2)
    assert list(profile.times) == ["blend_kernel", "project_kernel", "DeviceRadixSortKernel", "memset"]
    assert (profile.launches, profile.waits) == (7, 3)
    stages = gpu_timing.group_kernels(profile.times, gpu_kernels.STAGE_KERNEL_WORDS, "bin")
    assert stages == {"project": 1.0, "blend": 3.0, "bin": 0.75}


def test_the_count_of_blended_gaussians_matches_a_count_pixel_by_pixel() -> None:
    whole = decode_splats(make_model(2000, torch.device("cpu")), make_cameras(4, 128, 128)[1])
    splats = gpu_kernels.crop_splats(whole, 16)
    splats.inputs["opacities"].fill_(0.97)  # so that all pixels are finished before the last Gaussian
    seen = project(splats.gaussians, splats.viewport, RasterSettings())
    order = torch.argsort(seen.depths).tolist()
    pixels = torch.cartesian_prod(torch.arange(16), torch.arange(16)) + 0.5
    offsets = pixels[:, None] - seen.means2d
    matrices = seen.conics[:, [0, 1, 1, 2]].view(-1, 2, 2)
    distances = torch.einsum("pgi,gij,pgj->pg", offsets, matrices, offsets)
    alphas = (seen.opacities * torch.exp(-0.5 * distances)).tolist()
    touching = [i for i in order if any(row[i] >= 1 / 255 for row in alphas)]
    added, needed = 0, set()
    for row in alphas:
        light = 1.0
        for i in touching:
            if light <= 1 / 512:
                break
            needed.add(i)
            if row[i] >= 1 / 255:
                added += 1
                light *= 1 - min(0.99, row[i])
    blended, reached = gpu_kernels.count_blended(splats)
    assert len(needed) < len(touching)  # otherwise the count would prove nothing
    assert (blended, reached) == pytest.approx((added / 256, len(needed) / len(touching)), rel=1e-3)


def test_errors_beyond_their_bounds_fail_a_row() -> None:
    def double(implementation: str, x: torch.Tensor) -> torch.Tensor:
        return x * (2.0 if implementation == "reference" else 2.001)

    call = OperationCall(double, {"x": torch.linspace(1, 2, 5)}, ("x",), (1e-2, 1e-4))
    row = check_call(call, "gpu")
    assert row["value error"] == pytest.approx(5e-4, rel=1e-2)
    assert row["status"] == "failed" and "beyond 1e-04" in row["note"]


def test_wrong_gradients_fail_the_backward_row_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def scale(implementation: str, x: torch.Tensor) -> torch.Tensor:
        return x if implementation == "reference" else 2 * x - x.detach()  # right values, gradients of 2 in place of 1

    call = OperationCall(scale, {"x": torch.linspace(1, 2, 5)}, ("x",), (1e-2, 1e-2))
    monkeypatch.setattr(gpu_kernels, "measure_median_ms", lambda *_: {"forward": 1.0, "backward": 1.0})
    works = (gpu_roofline.Work(1.0, 1.0),) * 2
    forward, backward = gpu_kernels._measure_passes("scale", "5 numbers", call, works, TINY_SETUP, call)
    assert "status" not in forward and forward["value error"] == 0.0
    assert backward["status"] == "failed" and backward["gradient error"] == 1.0


@pytest.mark.parametrize("quantity", ["scales", "quats", "opacities"])
def test_wrong_geometry_of_any_kind_fails_the_row_of_decoding(quantity: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model = gpu_kernels._model(TINY_SETUP)
    decode = type(model).decode_geometry

    def decode_wrongly(self, index=None, used=None):
        geometry = decode(self, index, used)
        return replace(geometry, **{quantity: 2 * getattr(geometry, quantity)}) if self is model else geometry

    monkeypatch.setattr(type(model), "decode_geometry", decode_wrongly)
    geometry, radiance = gpu_kernels.measure_decode(TINY_SETUP)
    assert geometry["status"] == "failed" and geometry["value error"] == pytest.approx(1.0, abs=0.01)
    assert "status" not in radiance


def test_numbers_that_are_not_finite_fail_a_row() -> None:
    call = OperationCall(lambda implementation, x: x if implementation == "reference" else x * float("nan"), {}, ())
    call = OperationCall(call.run, {"x": torch.ones(3)}, ("x",))
    assert check_call(call, "gpu")["status"] == "failed"


def test_an_item_that_raises_dies_or_breaks_the_device_does_not_stop_the_others() -> None:
    results = run_children("one", "raises", "breaks", "dies", "lacks", "two")
    assert results["one"] == results["two"] == ["fine"]
    assert results["raises"] == ["fine", "failed: ValueError: one line"]
    assert results["breaks"] == ["fine", "failed: RuntimeError: illegal access"]
    assert results["dies"] == ["fine", "failed: its process ended: last words"]
    assert results["lacks"][1] == "left out: it needs no_such_package, which is not installed here"


def test_an_item_that_hangs_is_killed_at_the_time_limit_and_the_rest_is_named() -> None:
    results = run_children("one", "hangs", "two", seconds=1.5)
    assert results["one"] == ["fine"]
    assert results["hangs"][-1] == results["two"][-1] == "failed: not done within the part's 2 s"


def test_a_hanging_item_is_reported_with_its_last_output() -> None:
    results = run_children("hangs in a test", "two", seconds=1.5)
    assert results["hangs in a test"][-1] == "failed: not done within the part's 2 s; last output: test_loop"
    assert results["two"] == ["failed: not done within the part's 2 s"]


def test_the_limit_of_an_item_leaves_time_for_the_others_and_spares_items_with_their_own() -> None:
    results = run_children("hangs", "two", "hangs in a test", seconds=9, item_seconds=3, self_timed=["hangs in a test"])
    assert results["hangs"] == ["fine", "failed: not done within 3 s"]
    assert results["two"] == ["fine"]
    assert results["hangs in a test"][-1] == "failed: not done within the part's 9 s; last output: test_loop"


def test_items_of_parts_with_many_items_have_limits_below_that_of_their_part(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {}
    monkeypatch.setattr(
        gpu_check, "run_in_children", lambda command, items, *limits: calls.update({part: limits}) or ()
    )
    for part in gpu_check.DEFAULT_PARTS:
        gpu_check.check([part], TINY_SETUP, scale=3.0)
    assert calls["self-test"] == (420.0, 120.0, ("hyrfpack doctor",))
    assert calls["tests"] == (450.0, 60.0, ("pytest",))
    assert calls["repeat"] == (60.0, math.inf, ())
    assert all(calls[part][1] < calls[part][0] / 1.9 for part in gpu_check.ITEM_SECONDS)


def test_missing_packages_are_distinguished_from_internal_modules() -> None:
    lacks = ModuleNotFoundError("in /tmp/hyrfpack-gpu-1/", name="trimesh.path")
    assert find_missing_package(lacks) == "trimesh"
    assert find_missing_package(ModuleNotFoundError(name="PIL.Image")) == "pillow"
    assert find_missing_package(ModuleNotFoundError("trimesh", name="hyrfpack.made_up")) is None
    assert (
        find_missing_package(ModuleNotFoundError("no name")) is find_missing_package(ImportError(name="scipy")) is None
    )
    with pytest.raises(HyrfError) as caught, needs_package("hyrfpack/a.ply: reading points"):
        raise lacks
    assert failure_row(caught.value) == {"status": "left out", "note": "it needs trimesh, which is not installed here"}


@pytest.mark.parametrize(("module", "package"), [("PIL", "pillow"), ("scipy", "scipy")])
def test_training_is_omitted_with_the_name_of_a_missing_package(module: str, package: str) -> None:
    code = f"""
import sys
sys.modules[{module!r}] = None
from tools.gpu import quality
from tools.gpu.setup import Setup
from tools.gpu.worker import run_child
run_child(lambda item: quality.run(item, Setup.from_json({TINY_SETUP.to_json()!r})), ["demo"], lambda: True)
"""
    (row,) = run_in_children(lambda left: [sys.executable, "-c", code], ["demo"], 60.0)
    assert row == {"item": "demo", "status": "left out", "note": f"it needs {package}, which is not installed here"}


def test_the_comparison_with_the_cpu_is_omitted_without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_quality, "has_numba", lambda: False)
    (row,) = gpu_quality.run("demo", TINY_SETUP)
    assert row["status"] == "left out" and "needs Numba" in row["note"]


def test_frames_are_drawn_when_training_lacks_a_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tools.gpu.training", None)
    with pytest.raises(ModuleNotFoundError):  # a module of the package itself is not a missing package
        list(gpu_frames.run("200", TINY_SETUP))
    monkeypatch.setattr(gpu_frames, "failure_row", lambda error: {"status": "left out", "note": "it needs rich"})
    rows = list(gpu_frames.run("200", TINY_SETUP))
    assert [row["table"] for row in rows if row.get("note") == "it needs rich"] == ["Training"]
    assert "Frames, 16 x 16" in {row["table"] for row in rows}


def test_a_part_that_lacks_a_package_is_omitted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gpu_check.CHECK_PARTS, "poor", ("no_such_package.part", 5.0))
    rows = gpu_check.check(["poor"], TINY_SETUP)
    assert rows[0]["status"] == "left out" and "no_such_package" in rows[0]["note"]


def test_a_child_that_cannot_start_fails_each_item_once() -> None:
    rows = list(run_in_children(lambda left: [sys.executable, "-c", "raise SystemExit('no')"], ["a", "b"], 20.0))
    assert [row["item"] for row in rows] == ["a", "b"]
    assert all("its process ended: no" in row["note"] for row in rows)


def test_a_part_whose_module_is_broken_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gpu_check.CHECK_PARTS, "broken", ("tools.gpu.no_such_module", 5.0))
    rows = gpu_check.check(["broken"], TINY_SETUP)
    assert rows[0]["status"] == "failed" and "tools.gpu.no_such_module" in rows[0]["note"]


def test_the_page_has_goals_failures_and_a_table_for_each_kind(tmp_path: Path) -> None:
    rows = [
        {"part": "kernels", "item": "a", "table": "Kernels", "kernel": "a|b", "ms": 0.5, "pairs": 1_234_567},
        {"part": "kernels", "item": "b", "status": "failed", "note": "RuntimeError: no"},
        {"part": "frames", "item": "1", **make_goal_row("frames", 312.0, 300.0, "frames/s", at_least=True)},
        {"part": "frames", "item": "1", **make_goal_row("steps", 12.0, 10.0, "min", at_least=False)},
    ]
    page = tmp_path / "new" / "nvidia-h200.md"
    gpu_report.write_report(page, {"device": "NVIDIA H200", "torch": "2.11"}, {"width": 1920}, rows)
    text = page.read_text()
    assert "# NVIDIA H200\n" in text and "torch 2.11" in text
    assert "| kernel | ms | pairs |\n| --- | --: | --: |\n| a\\|b | 0.5 | 1,234,567 |" in text
    assert "| frames: at least 300 frames/s | 312 frames/s | yes |" in text
    assert "| steps: at most 10 min | 12 min | no |" in text
    assert "| kernels: b |  | failed | RuntimeError: no |" in text
    assert text.index("## Goals") < text.index("## Failed and left out") < text.index("## Kernels")
    assert json.loads(page.with_suffix(".json").read_text())["rows"] == rows


def test_settings_are_passed_to_a_child_unchanged() -> None:
    assert Setup.from_json(TINY_SETUP.to_json()) == TINY_SETUP


def test_the_set_is_the_requested_one_or_from_the_data_folder(tmp_path: Path) -> None:
    for name in ("b", "a"):
        (tmp_path / name / "sparse").mkdir(parents=True)
    assert find_dataset(tmp_path / "b", None, tmp_path) == tmp_path / "b"
    assert find_dataset(None, str(tmp_path), Path("/nowhere")) == tmp_path / "a"
    assert find_dataset(None, None, tmp_path / "nowhere") is None


@pytest.mark.skipif(HAS_CUDA, reason="there is a GPU")
def test_without_a_gpu_it_ends_with_a_clear_error_and_code_2(capsys: pytest.CaptureFixture) -> None:
    assert gpu_check.main([]) == 2
    assert capsys.readouterr().err == f"tools.gpu.check: {gpu_check.NO_GPU}\n"


def test_a_named_folder_without_data_is_not_replaced_by_another_set(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with pytest.raises(SystemExit) as exit_info:
        gpu_check.main(["--data", str(tmp_path)])
    assert exit_info.value.code == 2 and f"--data {tmp_path}: there is no data set" in capsys.readouterr().err


def test_it_starts_from_the_repository_root_without_an_installed_hyrfpack() -> None:
    # -S excludes the environment's packages, and with them an installed hyrfpack; torch is found where it is.
    environment = {**os.environ, "PYTHONPATH": str(Path(torch.__file__).parents[1])}
    command = [sys.executable, "-S", "-m", "tools.gpu.check", "--help"]
    done = subprocess.run(command, cwd=gpu_check.REPOSITORY_ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "--parts" in done.stdout, done.stderr


def test_the_default_parts_end_within_nine_minutes_and_leave_out_long_training() -> None:
    assert sum(gpu_check.CHECK_PARTS[part][1] for part in gpu_check.DEFAULT_PARTS) <= gpu_check.MAX_DEFAULT_SECONDS
    assert set(gpu_check.CHECK_PARTS) - set(gpu_check.DEFAULT_PARTS) == {"quality", "ranks", "full-run"}


def test_rooms_of_the_goals_size_come_first_as_trained_before_tidy() -> None:
    assert gpu_frames.items(Setup())[:2] == ["1,000,000, as trained", "1,000,000"]
    assert sorted(gpu_frames.items(Setup())[2:]) == ["100,000", "3,000,000"]


def test_a_check_of_some_parts_leaves_the_full_report_as_it_is() -> None:
    names = [
        gpu_check.choose_report_path(Path("out"), "NVIDIA H200", parts).as_posix()
        for parts in (gpu_check.DEFAULT_PARTS, gpu_check.DEFAULT_PARTS[::-1], ["ranks", "quality"], ["quality"])
    ]
    full = "out/nvidia-h200.md"
    assert names == [full, full, "out/nvidia-h200-quality-ranks.md", "out/nvidia-h200-quality.md"]


def test_the_probe_of_a_cpu_times_its_steps_without_the_set_up(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter(range(100))
    made = []

    class SlowTrainer(train.Trainer):
        def __init__(self, *arguments: object, **options: object) -> None:
            super().__init__(*arguments, **options)
            made.append(next(seconds))

    monkeypatch.setattr(train, "Trainer", SlowTrainer)
    monkeypatch.setattr(gpu_quality.time, "perf_counter", lambda: next(seconds))
    monkeypatch.setattr(SlowTrainer, "run", lambda self: None)
    _, row = gpu_quality._train(load_scene(data), 2, "float32", torch.device("cpu"))
    assert made and row["seconds"] == 1


def test_the_report_is_written_after_every_row(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = []
    monkeypatch.setattr(gpu_check, "run_part", lambda part, *_: iter([{"item": part}, {"item": part}]))
    gpu_check.check(["tests", "kernels"], TINY_SETUP, report=lambda rows: lengths.append(len(rows)))
    assert lengths == [1, 2, 3, 4, 5, 6]  # two rows of each part, and the time that it took


@pytest.mark.parametrize("item", gpu_repeat.items(TINY_SETUP))
def test_a_repeated_frame_and_step_have_the_same_bits(item: str) -> None:
    rows = list(gpu_repeat.run(item, TINY_SETUP))
    assert rows and {row["same bits"] for row in rows} == {"yes"}


def test_different_bits_fail_a_row_unless_a_hash_table_was_added_to_in_any_order() -> None:
    one, other = torch.tensor([1.0, 2.0]), torch.tensor([1.0, 2.5])
    assert gpu_repeat.compare("gaussians.positions", one, other)["status"] == "failed"
    table = gpu_repeat.compare("radiance.grid.table", one, other)
    assert "status" not in table and table["same bits"] == "no" and table["largest difference"] == 0.5


SANITIZER_OUTPUT = """========= COMPUTE-SANITIZER
@begun mlp
@done mlp
{lines}========= {summary}
"""


@pytest.mark.parametrize(
    ("lines", "summary", "found", "note"),
    [
        ("", "ERROR SUMMARY: 0 errors", "0 errors", None),
        ("", "RACECHECK SUMMARY: 0 hazards displayed (0 errors, 0 warnings)", "0 hazards displayed", None),
        (
            "========= Invalid __global__ read of size 4 bytes\n",
            "ERROR SUMMARY: 3 errors",
            "3 errors",
            "Invalid __global",
        ),
        ("", "Target application terminated", None, "no summary"),
    ],
)
def test_errors_that_the_sanitizer_counts_fail_its_row(
    lines: str, summary: str, found: str | None, note: str | None
) -> None:
    row = gpu_sanitizer.describe_output(SANITIZER_OUTPUT.format(lines=lines, summary=summary), 0, 1)
    assert found is None or str(row["found"]).startswith(found)
    assert ("status" in row) == (note is not None) and (note is None or note in str(row["note"]))


@pytest.mark.parametrize(
    ("output", "exit_code", "cases", "note"),
    [
        ("ModuleNotFoundError: No module named 'triton'\n", 1, 25, "exit code 1 after 0 of 25 cases"),
        ("", 0, 2, "exit code 0 after 1 of 2 cases"),
        ("", 1, 1, "exit code 1 after 1 of 1 cases"),
    ],
)
def test_a_sanitizer_without_errors_fails_unless_all_cases_were_checked(
    output: str, exit_code: int, cases: int, note: str
) -> None:
    output = output or "@begun mlp\n@done mlp\n"
    row = gpu_sanitizer.describe_output(f"{output}========= ERROR SUMMARY: 0 errors\n", exit_code, cases)
    assert row["found"] == "0 errors" and row["status"] == "failed" and note in str(row["note"])


# Stands in for compute-sanitizer: it reports an error, ends one case of the self-test, and does not end by itself.
SLOW_SANITIZER = """#!/bin/sh
echo "========= COMPUTE-SANITIZER"
echo "@begun mlp"
echo "========= Invalid __global__ read of size 4 bytes"
echo "@done mlp"
exec sleep 60
"""


def test_a_slow_sanitizer_keeps_what_it_found_and_leaves_time_for_the_next_tool(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "compute-sanitizer"
    program.write_text(SLOW_SANITIZER)
    program.chmod(0o755)
    monkeypatch.setattr(gpu_sanitizer.shutil, "which", lambda name: str(program))
    monkeypatch.setattr(gpu_sanitizer, "TOOL_SECONDS", {"memcheck": 1.0, "racecheck": 1.0})
    setup = replace(TINY_SETUP, logs=str(tmp_path / "logs"))
    for tool in gpu_sanitizer.items(setup):
        (row,) = gpu_sanitizer.run(tool, setup)
        assert row["status"] == "failed" and row["cases"].startswith("1 of ")
        assert "not done within 1 s" in row["note"] and "Invalid __global__ read" in row["note"]
        assert "@done mlp" in (tmp_path / "logs" / f"{tool}.txt").read_text()


def test_races_are_checked_in_all_operations_whose_kernels_multiply_matrices() -> None:
    assert gpu_sanitizer.list_product_operations() == {"mlp", "shade", "background_grid", "rasterize_shaded"}


def test_the_sanitizers_tools_and_pytest_keep_their_own_limits_within_those_of_their_parts() -> None:
    tools = sum(seconds + SECONDS_TO_END for seconds in gpu_sanitizer.TOOL_SECONDS.values())
    assert tools < gpu_check.CHECK_PARTS["sanitizer"][1]
    assert gpu_suite.MAX_SECONDS + SECONDS_TO_END < gpu_check.CHECK_PARTS["tests"][1]
    assert gpu_tests.items(Setup())[0] == gpu_tests.PYTEST_ITEM


def test_a_program_that_ignores_the_interrupt_is_killed_and_its_lines_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tools.gpu.process.SECONDS_TO_END", 1.0)
    script = (
        "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); print('begun', flush=True); time.sleep(60)"
    )
    process = TimedProcess([sys.executable, "-c", script], 3.0, tmp_path / "log.txt")
    assert list(process.lines()) == ["begun\n"] and (tmp_path / "log.txt").read_text() == "begun\n"
    assert process.is_out_of_time and process.exit_code < 0


def test_a_program_that_takes_too_long_is_killed_with_the_processes_it_has_started() -> None:
    sleeping_child = "(trap '' INT; echo begun; exec sleep 60)"
    start = time.monotonic()
    process = TimedProcess(["bash", "-c", f"{sleeping_child} & exit 3"], 1.0, None)
    assert list(process.lines()) == ["begun\n"] and process.exit_code == 3
    assert time.monotonic() - start < 50, "the sleeping child has kept the output open"


@pytest.mark.parametrize("folder", ["docs", "build", "../elsewhere", "build/../docs"])
def test_only_a_folder_below_build_is_replaced_by_a_prepared_set(
    folder: str, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "repository"
    for name in ("repository/docs", "repository/build", "elsewhere"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "kept").touch()
    monkeypatch.setattr(gpu_prepare, "REPOSITORY_ROOT", root)
    monkeypatch.setattr(gpu_prepare, "BUILD_FOLDER", root / "build")
    with pytest.raises(SystemExit):
        gpu_prepare.main(["--data", str(data), "--folder", folder])
    assert len(list(tmp_path.rglob("kept"))) == 3


def test_a_prepared_set_stays_if_the_next_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_prepare, "REPOSITORY_ROOT", tmp_path)
    monkeypatch.setattr(gpu_prepare, "BUILD_FOLDER", tmp_path / "build")
    (tmp_path / "build" / "gpu" / "bonsai").mkdir(parents=True)
    with pytest.raises(HyrfError):
        gpu_prepare.main(["--data", str(tmp_path / "missing")])
    assert [path.name for path in (tmp_path / "build").rglob("*")] == ["gpu", "bonsai"]


def test_the_first_part_runs_each_case_of_the_self_test_and_then_the_doctor(tmp_path: Path) -> None:
    setup = replace(TINY_SETUP, device="cpu", implementation="cpu", doctor_seconds=500.0, logs=str(tmp_path))
    *cases, command = gpu_first_contact.items(setup)
    assert gpu_check.DEFAULT_PARTS[0] == "self-test" and "rasterize" in cases
    (row,) = gpu_first_contact.run("contract" if "contract" in cases else cases[0], setup)
    assert "status" not in row and row["seconds"] >= 0
    (row,) = gpu_first_contact.run(command, setup)
    assert "status" not in row, row
    assert re.fullmatch(r"\d+ of \d+ cases of the cpu kernels passed in [\d.]+ s", row["result"])
    assert "torch" in (tmp_path / "doctor.txt").read_text()


def test_a_doctor_that_finds_a_problem_fails_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hyrfpack").mkdir()
    (tmp_path / "hyrfpack" / "__init__.py").touch()
    (tmp_path / "hyrfpack" / "__main__.py").write_text("print('problem: the kernels are broken')")
    monkeypatch.setattr("tools.gpu.process.REPOSITORY_ROOT", tmp_path)
    (row,) = gpu_first_contact.run(gpu_first_contact.DOCTOR_ITEM, TINY_SETUP)
    assert row["status"] == "failed" and row["note"] == "exit code 0: the kernels are broken"


def test_the_sanitizer_is_left_out_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_sanitizer.shutil, "which", lambda name: None)
    monkeypatch.setattr(gpu_sanitizer, "DEFAULT_PROGRAM", Path("/nowhere"))
    rows = [row for item in gpu_sanitizer.items(TINY_SETUP) for row in gpu_sanitizer.run(item, TINY_SETUP)]
    assert [row["status"] for row in rows] == ["left out", "left out"]


def test_prepared_commands_run_the_default_parts_and_both_kinds_of_training() -> None:
    first, second, third = gpu_prepare.list_check_commands(Path("build/gpu/bonsai"), "abc123", "$OUT")
    assert all("--commit abc123 --out $OUT" in command for command in (first, second, third))
    assert "--parts" not in first
    assert "--parts quality ranks --data build/gpu/bonsai" in second
    assert "--parts full-run --data build/gpu/bonsai" in third


@pytest.fixture
def colmap_set(data: Path, tmp_path: Path) -> Path:
    """The small photos of the demo scene with poses and points as a COLMAP model."""
    pytest.importorskip("pycolmap")
    folder, scene = tmp_path / "set", load_scene(data)
    shutil.copytree(data / "images", folder / "images")
    write_colmap([(view.name, view.camera) for view in scene.train + scene.test], folder, points=None)
    return folder


def test_a_prepared_set_is_the_same_scene_without_pycolmap(
    colmap_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = load_scene(colmap_set)
    scene = replace(scene, points=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), point_colors=np.eye(3)[:2])
    monkeypatch.setattr(gpu_prepare, "load_scene", lambda path: scene if path == colmap_set else load_scene(path))
    gpu_prepare.copy_dataset(colmap_set, tmp_path / "copy")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    copied = load_scene(tmp_path / "copy")
    assert [view.name for view in copied.test] == [view.name for view in scene.test]
    np.testing.assert_allclose(copied.points, scene.points)
    np.testing.assert_allclose(copied.point_colors, scene.point_colors)
    for view, other in zip(copied.train, scene.train, strict=True):
        np.testing.assert_allclose(view.camera.camera_from_world, other.camera.camera_from_world, atol=1e-12)
        assert np.array_equal(view.load().rgb, other.load().rgb)


def test_a_set_whose_copy_would_differ_is_refused(
    colmap_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = load_scene(colmap_set)
    camera = replace(scene.train[0].camera, fx=2 * scene.train[0].camera.fx)
    changed = replace(scene, train=[replace(scene.train[0], camera=camera), *scene.train[1:]])
    assert gpu_prepare.is_same_scene(scene, scene) and not gpu_prepare.is_same_scene(scene, changed)
    monkeypatch.setattr(gpu_prepare, "is_same_scene", lambda first, second: False)
    with pytest.raises(HyrfError, match="the copy differs"):
        gpu_prepare.copy_dataset(colmap_set, tmp_path / "copy")


def test_a_full_run_reports_at_intervals_and_resumes_from_its_checkpoint(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    setup = replace(TINY_SETUP, device="cpu", data=str(data), full_run_steps=6, full_run_interval=0.0)
    (first,) = gpu_full_run.run(str(data), replace(setup, full_run_seconds=0.0))
    assert first["step"] == "1 of 6" and float(first["PSNR of held-out photos"].split()[0]) > 0
    rows = list(gpu_full_run.run(str(data), replace(setup, full_run_seconds=600.0)))
    assert [row["step"] for row in rows] == [f"{step} of 6" for step in range(2, 7)]
    assert list(tmp_path.glob("*.checkpoint")) == []


def test_a_full_run_does_not_resume_the_checkpoint_of_another_commit(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    setup = replace(TINY_SETUP, device="cpu", data=str(data), full_run_steps=6, full_run_seconds=0.0)
    steps = []
    for commit in ("a", "b", "a"):
        (row,) = gpu_full_run.run(str(data), replace(setup, full_run_interval=0.0, commit=commit))
        steps.append(row["step"])
    assert steps == ["1 of 6", "1 of 6", "2 of 6"]


def test_a_full_run_needs_a_data_set() -> None:
    (item,) = gpu_full_run.items(TINY_SETUP)
    (row,) = gpu_full_run.run(item, TINY_SETUP)
    assert row["status"] == "left out" and "--data" in row["note"]
    seconds = gpu_check.choose_time_limit("full-run", replace(TINY_SETUP, full_run_seconds=100.0))
    assert seconds == 100.0 + gpu_check.FULL_RUN_OVERHEAD_SECONDS


def test_the_command_writes_its_page_and_fails_where_a_check_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(
        gpu_check, "Setup", lambda data: replace(TINY_SETUP, device="cpu", data=str(tmp_path / "no set"))
    )
    assert gpu_check.main(["--parts", "quality", "--out", str(tmp_path), "--commit", "abc123"]) == 1
    (page,) = tmp_path.glob("*.md")
    assert all(f"| {run} | " in page.read_text() for run in ("CPU", "GPU, float32", "GPU, mixed"))
    assert "| quality: " + str(tmp_path / "no set") in page.read_text()
    assert "commit abc123" in page.read_text()
    assert capsys.readouterr().out.endswith("1 failed\n")


@pytest.mark.parametrize("item", gpu_kernels.items(TINY_SETUP))
def test_kernels_part_runs_through(item: str) -> None:
    rows = list(gpu_kernels.run(item, TINY_SETUP))
    assert rows and not [row for row in rows if "status" in row]


def test_matrix_case_runs_through() -> None:
    (row,) = gpu_tests.run("rasterize, one large Gaussian", TINY_SETUP)
    assert "status" not in row, row


def test_gpu_tests_are_omitted_without_pytest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pytest", None)
    with pytest.raises(ModuleNotFoundError) as caught:
        list(gpu_tests.run("pytest", TINY_SETUP))
    assert failure_row(caught.value)["status"] == "left out"


def test_a_model_like_a_trained_room_has_three_to_five_times_the_pairs() -> None:
    @torch.no_grad()
    def pairs(look: Look) -> int:
        splats = decode_splats(make_model(60_000, torch.device("cpu"), look), make_cameras(4, 480, 270)[1])
        return int(rasterize(splats.gaussians, splats.colors, splats.viewport).pairs)

    assert 3 <= pairs(TRAINED_LOOK) / pairs(TIDY_LOOK) <= 5


@pytest.mark.parametrize("item", gpu_frames.items(TINY_SETUP))
def test_frames_part_runs_through(item: str) -> None:
    rows = list(gpu_frames.run(item, TINY_SETUP))
    assert all(row["Gaussians"] == item for row in rows if row["table"] in ("The room", "Frames, 16 x 16", "Training"))
    tables = {row["table"] for row in rows}
    assert {"The room", "Frames, 16 x 16", "Rasterising against gsplat", "Training"} <= tables
    assert not [row for row in rows if row.get("status") == "failed"]
