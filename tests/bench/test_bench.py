from __future__ import annotations

import dataclasses
import json
import sys
from collections import defaultdict

import numpy as np
import pytest
import torch
from scenes import ball_points, ball_scene, ring, small_model

import hyrfpack
from hyrfpack.bench import operation_calls, rendering, subject
from hyrfpack.bench.codec import PROFILE_SETTING_VALUES, measure_codec, measure_parameter_errors
from hyrfpack.bench.operations import measure_hash_encode, measure_mlp, measure_rasterize
from hyrfpack.bench.rendering import EXACT_SETTINGS, RENDER_SETTING_VALUES, measure_renderer
from hyrfpack.bench.subject import Subject
from hyrfpack.bench.suite import ROW_FUNCTIONS_BY_GROUP, benchmark_model
from hyrfpack.config.compress import PaperSettings
from hyrfpack.errors import HyrfError
from hyrfpack.format import encode_model, save_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.codec import PROFILES
from hyrfpack.measure import timing
from hyrfpack.model import HybridModel
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.render import RenderSettings, render_view
from tools.safety.train_golden import DEMO_MODEL_FILE

pytestmark = pytest.mark.usefixtures("quick_calibration")
RING_CAMERAS = ring(3, width=24, height=24)
BENCH_DISTORTION = 1e-5


def make_model(count: int = 60, **settings):
    settings = {"background": True, "fields": 0.3, "scale_logits": -2.0, **settings}
    return small_model(ball_points(count)[0], **settings)


def make_subject(model, photos=None) -> Subject:
    return Subject("tiny", "raw", model, RING_CAMERAS, photos, ring(8, width=24, height=24), BENCH_DISTORTION)


def rows_by_setting(rows) -> dict[str, dict]:
    found = defaultdict(dict)
    for row in rows:
        found[row.setting][row.value] = row
    return dict(found)


def render_all(model, settings=RenderSettings()) -> torch.Tensor:  # noqa: B008 - frozen
    with torch.no_grad():
        return torch.stack([render_view(model, camera, settings).rgb for camera in RING_CAMERAS])


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values, np.float64)))))


@pytest.mark.acceptance
@pytest.mark.parametrize("measure", [measure_rasterize, measure_hash_encode, measure_mlp, measure_renderer])
def test_every_setting_has_one_reference_without_error_and_one_default(measure):
    for values in rows_by_setting(measure(make_subject(make_model()), 1, [])).values():
        (reference,) = [row for row in values.values() if row.is_reference]
        assert reference.error.max == reference.error.rms == 0 and reference.ratio.wall == 1
        assert sum(row.is_default for row in values.values()) == 1
        assert all(row.time.ms > 0 and row.time.repeats == 1 for row in values.values())


@pytest.mark.acceptance
@pytest.mark.parametrize("antialiased", [False, True])
def test_rasterize_errors_are_against_float64_with_the_same_antialiasing(antialiased):
    model = make_model()
    viewport = model.config.frame.local_viewport(RING_CAMERAS[1], torch.float64)
    pose = viewport.pose
    with torch.no_grad():
        geometry = model.decode_geometry()
        colors = model.decode_colors(-(pose[:3, :3].T @ pose[:3, 3]).float())
    tensors = (model.gaussians.positions.detach(), geometry.quats, geometry.scales, geometry.opacities, colors)
    found = []
    for dtype, implementation in ((torch.float32, "cpu"), (torch.float64, "reference")):
        *gaussians, colors = (tensor.to(dtype) for tensor in tensors)
        settings = RasterSettings(antialiased=antialiased)
        picture = rasterize(Gaussians3D(*gaussians), colors, viewport, settings, implementation=implementation)
        found.append(np.concatenate([picture.rgb.flatten(), picture.transmittance.flatten()]).astype(np.float64))

    rows = rows_by_setting(measure_rasterize(make_subject(model), 1, []))
    row = rows["antialiased, forward" if antialiased else "forward"]["cpu"]
    assert row.error.max == pytest.approx(np.abs(found[0] - found[1]).max()) and row.error.max > 0
    assert row.error.rms == pytest.approx(rms(found[0] - found[1]))


def test_gradient_errors_are_given_for_each_input_and_as_their_maximum():
    rows = rows_by_setting(measure_rasterize(make_subject(make_model()), 1, []))
    row = rows["forward + backward"]["cpu"]
    assert set(row.parts) == {"means", "quats", "scales", "opacities", "colors"}
    assert row.error.max == max(part.max for part in row.parts.values())
    assert 0 < row.error.rms == max(part.rms for part in row.parts.values()) < 1e-3


def test_half_precision_errors_of_the_fields_are_relative_to_float64():
    model = make_model()
    coords = model.cube_coords(model.gaussians.positions).detach()
    grid, part = model.geometry.grid, model.geometry
    settings = grid.config.resolutions, grid.config.log2_table_size
    table = grid.table.detach()
    exact = hash_encode(coords.double(), table.double(), *settings)
    rounded = hash_encode(coords, table.bfloat16().float(), *settings)
    row = rows_by_setting(measure_hash_encode(make_subject(model), 1, []))["geometry, forward"]["cpu, bfloat16 table"]
    assert row.error.rms == pytest.approx(rms(rounded - exact) / rms(exact), rel=1e-4)
    assert 1e-4 < row.error.max == pytest.approx(float((rounded - exact).abs().max() / exact.abs().max()), rel=1e-4)

    features = hash_encode(coords, table, *settings)
    outputs = [
        mlp(features.to(dtype), [w.to(dtype) for w in part.weights], [b.to(dtype) for b in part.biases]).detach()
        for dtype in (torch.bfloat16, torch.float64)
    ]
    row = rows_by_setting(measure_mlp(make_subject(model), 1, []))["geometry, forward"]["bfloat16 reference"]
    assert row.error.rms == pytest.approx(rms(outputs[0].double() - outputs[1]) / rms(outputs[1]), rel=0.05)


def test_every_setting_that_trades_accuracy_for_speed_is_swept_but_near():
    assert set(RENDER_SETTING_VALUES) == {field.name for field in dataclasses.fields(RenderSettings)} - {
        "near",
        "exposure",
        "low_pass_variance",
    }
    assert (
        EXACT_SETTINGS.background_stride == 1
        and EXACT_SETTINGS.background_threshold == EXACT_SETTINGS.transmittance_min == 0
    )


def test_the_default_is_among_the_measured_values_of_each_setting():
    rows = rows_by_setting(measure_renderer(make_subject(make_model()), 1, []))
    for name, values in RENDER_SETTING_VALUES.items():
        assert len(rows[name]) == len({*values, getattr(RenderSettings(), name)})


def test_the_error_of_a_render_setting_isolates_that_setting():
    model = make_model()
    row = rows_by_setting(measure_renderer(make_subject(model), 1, []))["background_threshold"]["0.3"]
    exact, cut = (render_all(model, RenderSettings(background_threshold=tau)).double() for tau in (0, 0.3))
    assert row.error.max == pytest.approx(float((cut - exact).abs().max()), rel=1e-5) and row.error.max > 0.01
    assert row.error.rms == pytest.approx(rms(cut - exact), rel=1e-5)
    assert row.psnr is not None and row.psnr_drop is None


def test_all_defaults_together_are_compared_with_exact_settings():
    model = make_model()
    row = rows_by_setting(measure_renderer(make_subject(model), 1, []))["all"]["defaults"]
    assert row.error.rms == pytest.approx(
        rms(render_all(model).double() - render_all(model, EXACT_SETTINGS).double()), rel=1e-4
    )


def test_without_a_background_sphere_its_settings_are_left_out_and_named():
    notes = []
    rows = rows_by_setting(measure_renderer(make_subject(make_model(background=False)), 1, notes))
    assert "background_stride" not in rows and "cull_tolerance" in rows
    assert len(notes) == 2 and all("no background sphere" in sentence for sentence in notes)


def test_quality_drops_are_differences_of_scores_by_evaluate():
    model, scene = make_model(), ball_scene(views=3, side=24)
    views = scene.train
    photos = [(torch.from_numpy(view.load().composite()), None) for view in views]
    tested = dataclasses.replace(make_subject(model, photos), cameras=[view.camera for view in views])
    row = rows_by_setting(measure_renderer(tested, 1, []))["background_threshold"]["0.3"]
    exact, cut = (
        hyrfpack.evaluate_model(model, views, settings=RenderSettings(background_threshold=tau)) for tau in (0, 0.3)
    )
    assert row.psnr == pytest.approx(cut.psnr, abs=1e-4)
    assert abs(row.psnr_drop) > 0.001 and row.psnr_drop == pytest.approx(exact.psnr - cut.psnr, abs=1e-4)
    assert row.ssim_drop == pytest.approx(exact.ssim - cut.ssim, abs=1e-5)


@pytest.fixture(scope="module")
def coded_model(quick_calibration: None) -> tuple[HybridModel, dict[str, dict]]:
    """A model and the measurements of its coding. Tests must not change them."""
    model = make_model()
    return model, rows_by_setting(measure_codec(make_subject(model), 1, []))


@pytest.mark.acceptance
def test_raw_is_the_exact_codec_and_bytes_are_those_of_the_file(coded_model):
    model, rows = coded_model
    raw, paper = rows["profile"]["raw"], rows["profile"]["paper"]
    assert raw.is_reference and raw.error.max == 0 and all(part.max == 0 for part in raw.parts.values())
    assert raw.bytes == len(encode_model(model)) and paper.bytes == len(encode_model(model, "paper"))
    assert rows["profile"]["compact"].is_default and not paper.is_default
    assert paper.error.rms > 0 and paper.decode.ms > 0
    assert paper.decode_ratio.wall == pytest.approx(paper.decode.ms / raw.decode.ms)


def test_parameter_errors_of_the_paper_profile_follow_its_precision(coded_model):
    model, rows = coded_model
    row = rows["profile"]["paper"]
    arrays = to_arrays(model)
    halves = arrays["POSI"].astype(np.float16).astype(np.float64)
    assert row.parts["positions"].max == pytest.approx(np.abs(halves - arrays["POSI"]).max(), rel=1e-6)
    step = np.ptp(arrays["GTAB"]) / 255  # 8 bits between the extremes
    assert 0.2 * step < row.parts["geometry hash table"].rms < row.parts["geometry hash table"].max <= 0.51 * step
    assert len(row.parts) == 8


def test_every_setting_of_the_paper_profile_is_measured_with_its_default_marked(coded_model):
    assert set(PROFILE_SETTING_VALUES["paper"]) == {field.name for field in dataclasses.fields(PaperSettings)} - {
        "seed"
    }
    model, rows = coded_model
    for knob in PROFILE_SETTING_VALUES["paper"]:
        (default,) = [row for row in rows[f"paper, {knob}"].values() if row.is_default]
        assert default.bytes == rows["profile"]["paper"].bytes
    few = rows["paper, color"]["1 x 64"]
    assert few.bytes == len(encode_model(model, "paper", color=(1, 64)))
    assert few.parts["scale logits"] == rows["profile"]["paper"].parts["scale logits"]


@pytest.mark.acceptance
def test_every_setting_of_the_compact_profile_is_measured_with_its_default_marked():
    rows = rows_by_setting(measure_codec(make_subject(make_model(300, scale_logits=-4.0)), 1, []))
    itself = rows["profile"]["compact"]
    for knob, count in (("distortion", 5), ("prune", 2)):
        values = rows[f"compact, {knob}"]
        (default,) = [row for row in values.values() if row.is_default]
        assert len(values) == count and default.bytes == itself.bytes
    assert list(rows["compact, distortion"]) == ["1e-06", "3e-06", "1e-05", "3e-05", "0.0001"]
    distortions = list(rows["compact, distortion"].values())
    assert [row.bytes for row in distortions] == sorted((row.bytes for row in distortions), reverse=True)
    assert [row.error.rms for row in distortions] == sorted(row.error.rms for row in distortions)
    assert rows["compact, prune"]["no"].bytes >= rows["compact, prune"]["yes"].bytes
    assert 0 < itself.decode.ms and itself.decode_ratio.wall > 0
    assert itself.bytes < rows["profile"]["paper"].bytes


@pytest.mark.acceptance
@pytest.mark.parametrize("with_photos", [False, True])
def test_the_default_file_has_the_bytes_of_the_command(with_photos, data, tmp_path, monkeypatch):
    monkeypatch.setattr("hyrfpack.bench.codec.PROFILES", dict.fromkeys(("raw", "compact")))
    monkeypatch.setattr("hyrfpack.bench.codec.PROFILE_SETTING_VALUES", {})
    scene = hyrfpack.load_scene(data) if with_photos else None
    rows = rows_by_setting(measure_codec(subject.read_subject(DEMO_MODEL_FILE, scene), 1, []))
    quiet = hyrfpack.RunContext("cpu", progress=None)
    report = hyrfpack.compress_model(DEMO_MODEL_FILE, tmp_path / "compact.hyrf", data=scene, context=quiet)
    assert rows["profile"]["compact"].is_default and rows["profile"]["compact"].bytes == report.bytes_after


@pytest.mark.acceptance
def test_a_new_profile_is_measured_automatically_and_may_reorder_gaussians(monkeypatch):
    def shuffled(model):
        order = torch.from_numpy(np.random.default_rng(0).permutation(len(model)))
        other = make_model()
        other.load_state_dict(model.state_dict())
        for name in other.gaussians.PARAMETER_NAMES:
            getattr(other.gaussians, name).data = getattr(model.gaussians, name)[order]
        return PROFILES["raw"](other)

    monkeypatch.setitem(PROFILES, "shuffled", shuffled)
    generator = torch.Generator().manual_seed(5)
    model = make_model(color_logits=torch.randn(60, 3, generator=generator))
    row = rows_by_setting(measure_codec(make_subject(model), 1, []))["profile"]["shuffled"]
    assert all(part.max == 0 for part in row.parts.values())
    assert row.error.max < 1e-5


def test_parameters_of_another_number_of_gaussians_are_not_compared():
    errors = measure_parameter_errors(make_model(60), make_model(50))
    assert set(errors) == {
        "geometry hash table",
        "geometry decoder",
        "radiance hash table",
        "radiance decoder",
    }


@pytest.mark.acceptance
def test_a_profile_that_cannot_write_the_model_is_omitted_with_the_reason():
    model = make_model()
    with torch.no_grad():
        model.gaussians.positions[0, 0] = 1e6  # beyond the range of half precision
    notes = []
    rows = rows_by_setting(measure_codec(make_subject(model), 1, notes))
    assert set(rows["profile"]) == set(PROFILES) - {"paper"} and "paper, color" not in rows
    assert any("'paper' is left out" in sentence and "half precision" in sentence for sentence in notes)


def test_a_result_that_is_not_finite_stops_the_measurement():
    model = make_model()
    with torch.no_grad():
        model.geometry.biases[-1][0] = torch.nan
    with pytest.raises(HyrfError, match="mlp, geometry, forward"):
        list(measure_mlp(make_subject(model), 1, []))


@pytest.mark.parametrize(
    ("measure", "module", "operation"),
    [
        (measure_hash_encode, operation_calls, "hash_encode"),
        pytest.param(measure_renderer, rendering, "render_view", marks=pytest.mark.acceptance),
    ],
)
def test_the_time_to_compile_kernels_is_not_measured(monkeypatch, measure, module, operation):
    now, compiled, run = [0.0], [], getattr(module, operation)

    def slow_at_first(*arguments, **settings):
        compiles = settings.get("implementation", "cpu") == "cpu" and torch.is_grad_enabled() not in compiled
        if compiles:
            compiled.append(torch.is_grad_enabled())
        now[0] += 60.0 if compiles else 0.001
        return run(*arguments, **settings)

    monkeypatch.setattr(timing, "perf_counter", lambda: now[0])
    monkeypatch.setattr(module, operation, slow_at_first)
    rows = list(measure(make_subject(make_model()), 2, []))
    assert compiled and all(row.time.ms < 10 and row.time.repeats == 2 for row in rows)


def test_without_numba_there_is_a_clear_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(HyrfError, match="pip install numba"):
        benchmark_model()


def test_a_file_is_measured_from_an_orbit_and_the_report_survives_json(tmp_path, caplog):
    save_model(make_model(), tmp_path / "tiny.hyrf")
    report = benchmark_model(tmp_path / "tiny.hyrf", repeats=1, only=["mlp"])
    assert {row.group for row in report.rows} == {"mlp"} and caplog.messages == ["measuring mlp"]
    assert "60 Gaussians" in report.subject and "6 viewpoints" in report.subject
    assert {"cpu", "cores", "torch"} <= set(report.machine)
    values = report.to_dict()
    assert json.loads(json.dumps(values, allow_nan=False)) == values


def test_the_built_in_model_is_measured_on_its_own_photos(monkeypatch, caplog):
    monkeypatch.setattr(subject, "BUILT_IN_STEPS", 2)
    monkeypatch.setattr(subject, "BUILT_IN_PHOTOS", 9)
    monkeypatch.setattr(subject, "BUILT_IN_PHOTO_SIDE_PIXELS", 32)
    devices = []
    train = subject.train_model

    def record_device(*arguments, context):
        devices.append(context.device)
        return train(*arguments, context=context)

    monkeypatch.setattr(subject, "train_model", record_device)
    report = benchmark_model(only=["mlp"], repeats=1)
    assert devices == ["cpu"]
    assert "built-in" in report.subject and "2 held-out photos" in report.subject
    assert "2 steps" in caplog.messages[0] and "minute" in caplog.messages[0]


@pytest.mark.acceptance
def test_coding_a_quantised_model_again_gives_a_note(tmp_path):
    save_model(make_model(), tmp_path / "tiny.hyrf", "paper")
    read = subject.read_subject(tmp_path / "tiny.hyrf", None)
    notes = []
    next(iter(measure_codec(dataclasses.replace(read, cameras=RING_CAMERAS, capture=RING_CAMERAS), 1, notes)))
    assert any("quantised already" in sentence for sentence in notes)


def test_a_model_without_gaussians_is_rejected(tmp_path):
    save_model(small_model(np.zeros((0, 3))), tmp_path / "empty.hyrf")
    with pytest.raises(HyrfError, match="no Gaussians"):
        benchmark_model(tmp_path / "empty.hyrf")


def test_a_scene_without_held_out_photos_is_rejected(tmp_path):
    save_model(make_model(), tmp_path / "tiny.hyrf")
    with pytest.raises(HyrfError, match="balls: no held-out photo"):
        benchmark_model(tmp_path / "tiny.hyrf", ball_scene(views=2))


def test_wrong_calls_are_value_errors():
    with pytest.raises(ValueError, match="no group 'nothing'.*rasterize"):
        benchmark_model(only=["nothing"])
    with pytest.raises(ValueError, match="repeats is 0"):
        benchmark_model(repeats=0)
    with pytest.raises(ValueError, match="without the model"):
        benchmark_model(scene=ball_scene(views=2))
    assert callable(hyrfpack.benchmark_model) and tuple(ROW_FUNCTIONS_BY_GROUP) == (
        "rasterize",
        "hash_encode",
        "mlp",
        "render",
        "codec",
    )
