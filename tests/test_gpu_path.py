"""Training and rendering on a GPU from end to end; on a fake one where there is none (see `fake_gpu`).

Wrong devices and hidden copies fail as on a real GPU, and the values agree with the CPU's.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from contextlib import nullcontext

import pytest
import torch
from commands import succeeded
from explicit_balls import ball_splats
from fake_gpu import use_fake_gpu
from ops.device import needs_triton
from scenes import ball_points, ball_scene, camera_at, small_model

import hyrfpack
from hyrfpack.context import RunContext
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.imports import ImportConfig, import_loaded_splats
from hyrfpack.imports.pack import pack
from hyrfpack.model import HashGridConfig
from hyrfpack.ops.dispatch import GPU_OPERATIONS
from hyrfpack.render import render_view
from hyrfpack.train import DensityConfig, TrainConfig, Trainer

pytestmark = needs_triton

# Density control acts after steps 1 and 3.
DENSITY_CONFIG = DensityConfig(start=0.1, stop=1.0, rounds=2, gradient=1e-5, resets=1)
TRAIN_CONFIG = TrainConfig(steps=3, max_gaussians=30, density=DENSITY_CONFIG, precision="float32", log2_table_size=5)


@pytest.fixture(autouse=True)
def quick_steps(monkeypatch):
    """Models have 2 levels, and no runs of points are summed in their gradients, because the interpreter is slow."""
    if not torch.cuda.is_available():
        monkeypatch.setattr("hyrfpack.ops.hash_encode.gpu._POINTS_PER_THREAD", 1)
    monkeypatch.setattr(
        "hyrfpack.train.setup.HashGridConfig",
        lambda log2_table_size, **sizes: HashGridConfig(log2_table_size, levels=2, **sizes),
    )


@pytest.fixture
def gpu():
    """A CUDA device for the duration of a test."""
    with nullcontext(torch.device("cuda", 0)) if torch.cuda.is_available() else use_fake_gpu() as device:
        yield device


def make_scene():
    scene = ball_scene(views=3, points=20, side=16)
    return dataclasses.replace(scene, test=scene.train[:1])


def record_curve(trainer: Trainer) -> list[tuple[float, float, int]]:
    """Return loss, mean squared error and number of Gaussians of each step."""
    found = []
    trainer.run(progress=lambda event: found.append((event.loss, event.mse, event.gaussians)))
    return found


def parameter_values(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: p.detach().cpu() for name, p in trainer.model.named_parameters()}


def test_training_agrees_with_the_cpu(gpu):
    here, there = Trainer(make_scene(), TRAIN_CONFIG), Trainer(make_scene(), TRAIN_CONFIG, device=gpu)

    torch.testing.assert_close(record_curve(there), record_curve(here), rtol=1e-4, atol=1e-6)

    assert all(p.device == gpu for p in there.model.parameters())
    for (name, value), expected in zip(parameter_values(there).items(), parameter_values(here).values(), strict=True):
        # Adam's first steps are as long for a rounded gradient as for a large one.
        assert (value - expected).abs().median() < 1e-4, name


@pytest.mark.acceptance
def test_recorded_steps_train_as_launched_ones(gpu, caplog):
    config = dataclasses.replace(TRAIN_CONFIG, steps=12, density=DensityConfig(start=1.0, stop=1.0, rounds=1))
    recorded, launched = (Trainer(make_scene(), config, device=gpu) for _ in range(2))
    launched.renderer.replays_steps = False
    with caplog.at_level(logging.WARNING):
        found = record_curve(recorded)
    assert recorded.seconds["replay"] > 0 and not caplog.records
    torch.testing.assert_close(found, record_curve(launched), rtol=1e-4, atol=1e-6)
    assert "replay" not in launched.seconds


def test_training_with_replaced_kernels_agrees_with_the_cpu(gpu, monkeypatch):
    # The gradient of torch's cumprod, in the rasteriser, allocates memory that is not on the fake GPU.
    replaced = frozenset(GPU_OPERATIONS) - {"rasterize"}
    monkeypatch.setattr("hyrfpack.ops.dispatch._replaced_operations", replaced)
    config = dataclasses.replace(TRAIN_CONFIG, steps=2)
    here, there = Trainer(make_scene(), config), Trainer(make_scene(), config, device=gpu)
    torch.testing.assert_close(record_curve(there), record_curve(here), rtol=1e-4, atol=1e-6)
    assert all(p.device == gpu for p in there.model.parameters())


@pytest.mark.parametrize("kept", [False, True])
def test_renders_with_all_kernels_replaced_launch_none_and_agree_with_the_cpu(gpu, kept, monkeypatch):
    monkeypatch.setattr("hyrfpack.ops.dispatch._replaced_operations", frozenset(GPU_OPERATIONS))
    camera = camera_at((0.3, -2.2, 0.6), (0.2, 0, 0), width=30, height=20)
    model = make_model(background=True)
    model.precision = "float32"
    with torch.no_grad():
        expected = render_view(model, camera)
        monkeypatch.setattr("triton.runtime.jit.KernelInterface.__getitem__", lambda *_: pytest.fail("a launch"))
        model = model.to(gpu)
        found = render_view(model, camera, decoded=model.decode() if kept else None)
    assert found.rgb.device == gpu
    torch.testing.assert_close(found.rgb.cpu(), expected.rgb, rtol=0, atol=1e-4)


def test_mixed_precision_starts_near_the_loss_of_float32(gpu):
    config = dataclasses.replace(TRAIN_CONFIG, steps=1)
    mixed = record_curve(Trainer(make_scene(), dataclasses.replace(config, precision="mixed"), device=gpu))
    ((loss, *_),), ((expected, *_),) = mixed, record_curve(Trainer(make_scene(), config))
    assert loss == pytest.approx(expected, rel=1e-2) and loss != expected


@pytest.mark.acceptance
def test_a_run_resumes_on_another_device(gpu, tmp_path):
    first = Trainer(make_scene(), TRAIN_CONFIG, device=gpu)
    assert not first.run(checkpoint=tmp_path / "c.pt", stop=lambda: first.step == 2)
    second, whole = Trainer(make_scene(), TRAIN_CONFIG), Trainer(make_scene(), TRAIN_CONFIG)

    second.load(tmp_path / "c.pt")

    assert second.step == 2
    torch.testing.assert_close(record_curve(second), record_curve(whole)[2:], rtol=1e-4, atol=1e-6)


def test_a_gradient_that_is_not_finite_is_named(gpu):
    trainer = Trainer(make_scene(), TRAIN_CONFIG, device=gpu)
    trainer.model.gaussians.scale_logits.register_hook(lambda grad: grad * float("nan"))
    with pytest.raises(hyrfpack.HyrfTrainingError, match="gradient is not finite.*: scale_logits"):
        trainer.run()


def make_model(**settings):
    points, colors = ball_points(40)
    colors = torch.from_numpy(colors) * 4 - 2
    return small_model(points, color_logits=colors, scale_logits=-2.0, fields=1.0, **settings)


@pytest.mark.parametrize(
    ("encoding", "kept"),
    [
        ("frequency", False),
        ("sh", True),
        *(pytest.param(*case, marks=pytest.mark.acceptance) for case in (("frequency", True), ("sh", False))),
    ],
)
def test_renders_agree_with_the_cpu(gpu, kept, encoding):
    camera = camera_at((0.3, -2.2, 0.6), (0.2, 0, 0), width=30, height=20)
    model = make_model(background=True, direction_encoding=encoding)
    model.precision = "float32"
    with torch.no_grad():
        expected = render_view(model, camera, depth=True)
        model = model.to(gpu)
        found = render_view(model, camera, decoded=model.decode() if kept else None, depth=True)

    torch.testing.assert_close(found.rgb.cpu(), expected.rgb, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.alpha.cpu(), expected.alpha, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.depth.cpu(), expected.depth, rtol=1e-3, atol=1e-3)
    assert found.pairs >= expected.pairs


@pytest.mark.parametrize("kept", [False, pytest.param(True, marks=pytest.mark.acceptance)])
@pytest.mark.parametrize("part", ["positions", "color_logits", "opacity_logits", "table", "background"])
def test_numbers_that_are_not_finite_are_rejected(gpu, part, kept):
    model = make_model(background=part == "background")
    with torch.no_grad():
        if part == "table":
            model.geometry.grid.table.fill_(float("nan"))
        elif part == "background":
            model.gaussians.positions.mul_(1e-3)  # it then uses cells that the background sphere does not
            model.radiance.grid.table[model.config.radiance.offsets[-2] :: 2] = float("inf")
        else:
            getattr(model.gaussians, part)[3, 0] = float("nan")
        model = model.to(gpu)
        decoded = model.decode() if kept else None
        with pytest.raises(hyrfpack.HyrfError, match="NaN or infinite"):
            render_view(model, camera_at((0.3, -2.2, 0.6), width=16, height=16), decoded=decoded)


@pytest.mark.acceptance
def test_the_command_line_trains_and_renders_on_a_gpu(gpu, tmp_path):
    data, run, options = write_demo_scene(tmp_path / "data", views=2, size=16), tmp_path / "run", ["--device", "cuda"]
    succeeded("train", data, "-o", run, "--steps", 1, "--max-gaussians", 20, "--log2-table-size", 5, *options)
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["device"].startswith("cuda:0 (") and metrics["evaluation"]["psnr"] > 5
    succeeded("render", run / "model.hyrf", "-o", tmp_path / "out", "--orbit", 1, "--precision", "float32", *options)
    assert (tmp_path / "out" / "0000.png").is_file()


@pytest.fixture
def few_pictures(monkeypatch):
    """Calibration compares as few views as possible."""
    monkeypatch.setattr("hyrfpack.compress.calibrate.MAX_CORRECTION_ROUNDS", 1)
    for name in ("MIN_COMPARISON_VIEWS", "MAX_COMPARISON_VIEWS"):
        monkeypatch.setattr(f"hyrfpack.compress.reference_renders.{name}", 2)


@pytest.mark.acceptance
def test_a_model_is_measured_packed_and_fine_tuned_on_a_gpu(gpu, few_pictures, tmp_path):
    scene = ball_scene(views=2, points=12, side=8)
    config = TrainConfig(steps=1, max_gaussians=12, log2_table_size=4, background=False)
    model = hyrfpack.train_model(scene, tmp_path / "run", config, context=RunContext(device="cpu", progress=None)).model
    sizes = {}
    for device in ("cpu", "cuda"):
        target = tmp_path / f"{device}.hyrf"
        sizes[device] = hyrfpack.compress_model(
            model, target, hyrfpack.CompressConfig(finetune_steps=1), data=scene, context=hyrfpack.RunContext(device)
        ).bytes_after
    assert sizes["cuda"] == pytest.approx(sizes["cpu"], rel=0.02)


@pytest.mark.acceptance
def test_splats_of_other_programs_are_imported_on_a_gpu(gpu, few_pictures, tmp_path, monkeypatch):
    monkeypatch.setattr("hyrfpack.imports.pack.MAX_TRIALS", 1)
    packed = []
    monkeypatch.setattr(
        "hyrfpack.imports.run.pack", lambda made, *rest, **limits: packed.append(made) or pack(made, *rest, **limits)
    )
    cameras = [camera_at(place, width=12, height=12) for place in ((0.0, -3, 0.5), (0.0, 3, 0.5), (3.0, 0, -0.5))]
    quick = ImportConfig(test_views=2, psnr=12)
    reports = [
        import_loaded_splats(
            ball_splats(12), tmp_path / f"{device}.hyrf", quick, cameras=cameras, context=RunContext(device=device)
        )
        for device in ("cpu", "cuda")
    ]
    places = [(t.model.gaussians.positions.device, t.test.pictures[0].device) for t in packed]
    assert places == [2 * (torch.device("cpu"),), 2 * (gpu,)]
    here, there = (report.psnr_unpacked for report in reports)
    assert there == pytest.approx(here, abs=0.05)
    assert reports[1].bytes_after == pytest.approx(reports[0].bytes_after, rel=0.05)
