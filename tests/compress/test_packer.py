"""Compress the golden model of the demo scene with its photos, and small models where a claim needs no trained one."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import ball_points, ball_scene, small_model

import hyrfpack
from hyrfpack.cameras.capture import MIN_COARSE_CAMERAS, provenance_cameras, quantized_provenance
from hyrfpack.compress import compress_model, limits, run
from hyrfpack.compress import packer as running
from hyrfpack.compress.calibrate import measure_calibrated_sensitivity
from hyrfpack.compress.distortion import default_distortion
from hyrfpack.config.compress import CompressConfig, PaperSettings
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format import describe_file, load_model, save_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.parallel.threads import thread_count
from hyrfpack.render import render_view
from hyrfpack.scene import Scene
from tools.safety.train_golden import DEMO_COMPACT_FILE, DEMO_MODEL_FILE

START_DISTORTION = default_distortion(describe_file(DEMO_MODEL_FILE)["provenance"])
RECORDED_SIZES_FILE = Path(__file__).parents[1] / "golden" / "trained_sizes.json"


@pytest.fixture(scope="module")
def scene(data) -> Scene:
    return hyrfpack.load_scene(data)


@pytest.fixture(scope="module")
def paper_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "paper.hyrf"
    compress_model(DEMO_MODEL_FILE, path, CompressConfig(profile="paper"))
    return path


@pytest.fixture(scope="module")
def compact_file_and_report(scene, tmp_path_factory) -> tuple[Path, object]:
    path = tmp_path_factory.mktemp("packed") / "compact.hyrf"
    return path, compress_model(DEMO_MODEL_FILE, path, data=scene)


@pytest.fixture(scope="module")
def demo_packer(scene, compact_file_and_report) -> running.Packer:
    """Return a packer of the golden model with the sensitivities that were measured for the compact file."""
    sensitivity = compact_file_and_report[1].sensitivity
    return running.Packer(load_model(DEMO_MODEL_FILE), {}, sensitivity, scene)


@pytest.fixture(scope="module")
def ball_file(tmp_path_factory) -> Path:
    """Write an untrained model of the balls with the cameras of `ball_scene`."""
    path = tmp_path_factory.mktemp("balls") / "balls.hyrf"
    model = small_model(ball_points(60)[0], fields=0.2, scale_logits=-2.0)
    cameras = provenance_cameras([view.camera for view in ball_scene().train])
    save_model(model, path, provenance={"cameras": cameras, "psnr": 20.0})
    return path


@pytest.fixture(scope="module")
def finetuned_file(scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "tuned.hyrf"
    compress_model(DEMO_MODEL_FILE, path, CompressConfig(finetune_steps=60), data=scene)
    return path


@pytest.fixture
def few_views(monkeypatch) -> None:
    """Measure sensitivities in few views and correct them once."""
    monkeypatch.setattr("hyrfpack.compress.sensitivity.MAX_SENSITIVITY_VIEWS", 8)
    monkeypatch.setattr("hyrfpack.compress.sensitivity.MIN_SENSITIVITY_VIEWS", 8)
    monkeypatch.setattr("hyrfpack.compress.calibrate.MAX_CORRECTION_ROUNDS", 1)


def psnr(path: Path, scene: Scene) -> float:
    return evaluate_model(load_model(path), scene.test).psnr


def mean_squared_error(first: Path, second: Path, cameras) -> float:
    """Return the mean squared error between the pictures of two files."""
    with torch.no_grad():
        pictures = [
            torch.cat([render_view(model, camera).rgb.flatten() for camera in cameras])
            for model in (load_model(first), load_model(second))
        ]
    return float((pictures[0] - pictures[1]).double().square().mean())


# -- size and loss --------------------------------------------------------------------------------------------------


def test_compact_is_much_smaller_than_paper_with_little_loss(paper_file, compact_file_and_report, scene):
    path, _ = compact_file_and_report

    assert path.stat().st_size < 0.4 * paper_file.stat().st_size
    assert psnr(path, scene) > psnr(DEMO_MODEL_FILE, scene) - 0.1


@pytest.mark.acceptance
def test_compact_with_the_loss_of_paper_is_smaller(demo_packer, paper_file, scene):
    allowed = max(psnr(DEMO_MODEL_FILE, scene) - psnr(paper_file, scene), 0.0) + 0.02

    candidate, found = demo_packer.encode_within_psnr_drop(allowed, START_DISTORTION)

    after = evaluate_model(demo_packer.decode(candidate), scene.test).psnr
    assert psnr(DEMO_MODEL_FILE, scene) - after <= allowed + 1e-6
    assert len(candidate.data) < 0.7 * paper_file.stat().st_size
    assert f"of {allowed:g} dB on {len(scene.test)} photos" in found


def test_the_report_matches_the_file_and_predicts_the_error(compact_file_and_report, scene):
    path, report = compact_file_and_report

    assert report.profile == "compact" == describe_file(path)["profile"]
    assert report.bytes_after == path.stat().st_size
    assert report.gaussians == len(load_model(path))
    assert sum(report.shares.values()) == pytest.approx(1) and min(report.shares.values()) >= 0
    assert set(report.shares) == {"pruned", "POSI", "COLO", "SCAL", "OPAC", "GTAB", "GMLP", "RTAB", "RMLP"}
    measured = mean_squared_error(DEMO_MODEL_FILE, path, [view.camera for view in scene.train])
    assert report.error / 1.5 < measured < 1.5 * report.error


@pytest.mark.acceptance
def test_the_measured_error_is_close_to_the_requested_distortion(scene, tmp_path):
    cameras = [view.camera for view in scene.train]
    sizes, errors = [], []
    for distortion in (1e-4, 1e-6):
        report = compress_model(
            DEMO_MODEL_FILE, tmp_path / "small.hyrf", CompressConfig(distortion=distortion), data=scene
        )
        errors.append(mean_squared_error(DEMO_MODEL_FILE, tmp_path / "small.hyrf", cameras))
        sizes.append(report.bytes_after)
        assert distortion / 1.75 < errors[-1] < 1.75 * distortion

    assert sizes == sorted(sizes) and errors == sorted(errors, reverse=True)


@pytest.mark.acceptance
@pytest.mark.parametrize("share", [0.4, 0.8, 1.5])
def test_a_target_size_is_met_and_nearly_reached(share, demo_packer, compact_file_and_report):
    target = int(share * compact_file_and_report[1].bytes_after)

    candidate, found = demo_packer.encode_within_bytes(target, START_DISTORTION)

    assert 0.9 * target < len(candidate.data) <= target
    assert f"of {target:,} bytes" in found


@pytest.mark.acceptance
def test_finetuning_raises_the_psnr_at_the_same_size(demo_packer, finetuned_file, scene):
    plain, _ = demo_packer.encode_within_bytes(finetuned_file.stat().st_size, START_DISTORTION)

    fits = [
        evaluate_model(model, scene.train).psnr for model in (load_model(finetuned_file), demo_packer.decode(plain))
    ]
    assert fits[0] > fits[1] + 0.1


@pytest.mark.acceptance
def test_sizes_after_packing_and_export_match_the_recorded_ones(
    paper_file, compact_file_and_report, finetuned_file, tmp_path
):
    """If a change is meant to change sizes, record the sizes in the message of this test as the new ones."""
    exported = tmp_path / "small.spz"
    hyrfpack.export_model(compact_file_and_report[0], exported, hyrfpack.ExportConfig(degree=1))
    files = {
        "raw": DEMO_MODEL_FILE,
        "paper": paper_file,
        "compact": compact_file_and_report[0],
        "fine-tuned": finetuned_file,
        "exported": exported,
    }

    sizes = {name: path.stat().st_size for name, path in files.items()}

    assert sizes == pytest.approx(json.loads(RECORDED_SIZES_FILE.read_text()), rel=0.01)


@pytest.mark.acceptance
@pytest.mark.usefixtures("few_views")
def test_results_do_not_depend_on_the_number_of_threads(ball_file, tmp_path, monkeypatch):
    packed = set()
    for threads in ("1", "3"):
        monkeypatch.setenv("HYRFPACK_THREADS", threads)
        compress_model(ball_file, tmp_path / f"{threads}.hyrf")
        packed.add((tmp_path / f"{threads}.hyrf").read_bytes())

    assert len(packed) == 1


@pytest.mark.acceptance
def test_the_bytes_of_a_trained_model_do_not_depend_on_the_number_of_threads(
    compact_file_and_report, scene, tmp_path, monkeypatch
):
    threads = 1 if thread_count() == 3 else 3
    monkeypatch.setenv("HYRFPACK_THREADS", str(threads))
    compress_model(DEMO_MODEL_FILE, tmp_path / "small.hyrf", data=scene)

    assert (tmp_path / "small.hyrf").read_bytes() == compact_file_and_report[0].read_bytes()


@pytest.mark.acceptance
@pytest.mark.parametrize(
    "limit",
    [pytest.param({"target_bytes": 9000}, id="size"), pytest.param({"max_psnr_drop": 0.3}, id="loss")],
)
@pytest.mark.usefixtures("few_views")
def test_finetuning_respects_limits(limit, scene, tmp_path):
    config = CompressConfig(finetune_steps=5, **limit)
    report = compress_model(DEMO_MODEL_FILE, tmp_path / "small.hyrf", config, data=scene)

    if "target_bytes" in limit:
        assert 0.6 * 9000 < report.bytes_after <= 9000
    else:
        assert psnr(DEMO_MODEL_FILE, scene) - psnr(tmp_path / "small.hyrf", scene) <= 0.3 + 1e-6


@pytest.mark.usefixtures("few_views")
def test_pruning_removes_gaussians_and_bytes_and_can_be_disabled(ball_file, tmp_path):
    model, provenance = load_with_provenance(ball_file)
    every = len(model)
    with torch.no_grad():
        model.gaussians.opacity_logits[: every // 3] -= 20  # makes them almost invisible
    save_model(model, tmp_path / "some.hyrf", provenance=provenance)

    kept = compress_model(tmp_path / "some.hyrf", tmp_path / "all.hyrf", CompressConfig(distortion=1e-4, prune=False))
    pruned = compress_model(tmp_path / "some.hyrf", tmp_path / "fewer.hyrf", CompressConfig(distortion=1e-4))

    assert kept.gaussians == every > every - every // 3 >= pruned.gaussians > every / 4
    assert pruned.bytes_after < kept.bytes_after


# -- search and inputs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("picture_error", "expected_trials", "expected"),
    [
        (lambda distortion: 1.1 * distortion, [1e-3], 1e-3),  # the error is close enough to the requested one
        (lambda distortion: 4 * distortion, [1e-3, 1e-3 / 4], 1e-3 / 4),
        (lambda distortion: distortion / 1.9, [1e-3, 1.9e-3], 1.9e-3),
        (lambda distortion: 100 * distortion, [1e-3, 1e-3 / 16, 1e-3 / 100], 1e-3 / 100),
        # At a jump of the error the finer candidate is taken.
        (lambda distortion: 5e-4 if distortion < 2e-3 else 1e-1, [1e-3, 2e-3], 1e-3),
        (lambda distortion: 0.0, [1e-3], 1e-3),  # the error is not visible
    ],
)
def test_the_distortion_is_adjusted_until_the_measured_error_matches(
    picture_error, expected_trials, expected, monkeypatch
):
    """The fake packer's candidates are distortions, whose measured error is `picture_error`."""
    tried: list[float] = []
    packer = running.Packer(None, {}, None)
    monkeypatch.setattr(
        packer,
        "encode",
        lambda distortion, progress: tried.append(distortion) or running.EncodedCandidate(distortion, {}),
    )
    monkeypatch.setattr(running.Packer, "decode", lambda packer, trial: trial.data)

    trial = packer.encode_to_distortion(1e-3, SimpleNamespace(measure_error=picture_error))

    assert tried == pytest.approx(expected_trials)
    assert trial.data == pytest.approx(expected) and trial.measured_error == picture_error(trial.data)


def test_after_a_rejected_coarser_file_the_distortion_is_that_of_the_file(monkeypatch):
    """The drop on training photos is then lowered from the distortion that the file was planned for."""
    tried: list[float] = []
    errors = {1e-3: 2e-2, 6.25e-5: 5e-4, 1.25e-4: 1e-1}
    packer = running.Packer(None, {}, None, SimpleNamespace(train=["a photo"]))
    monkeypatch.setattr(
        packer, "encode", lambda distortion, *_: tried.append(distortion) or running.EncodedCandidate(distortion, {})
    )
    monkeypatch.setattr(running.Packer, "decode", lambda packer, trial: trial.data)
    drops = iter([0.2, 0.1])
    monkeypatch.setattr(
        running,
        "evaluate_model",
        lambda shown, views, progress: SimpleNamespace(psnr=30.0 if shown is None else 30.0 - next(drops)),
    )
    references = SimpleNamespace(measure_error=lambda distortion: errors.get(round(distortion, 9), 1e-4))

    packer.encode_to_distortion(1e-3, references, 0.1)

    assert tried == pytest.approx([1e-3, 6.25e-5, 1.25e-4, 6.25e-5 / 2])


@pytest.mark.parametrize(
    ("psnr_drop", "expected_trials", "expected"),
    [
        (lambda distortion: 140 * distortion, [1e-3], 1e-3),  # 0.14 dB is close enough to the target of 0.1 dB
        (lambda distortion: -0.3, [1e-3], 1e-3),  # the PSNR on photos rises
        (lambda distortion: 400 * distortion, [1e-3, 1e-3 / 4], 1e-3 / 4),
        (lambda distortion: 10 * distortion**0.5, [1e-3, 10**-3.5, 10**-3.75], 10**-3.75),  # correlated errors
    ],
)
def test_the_distortion_is_lowered_until_the_drop_on_training_photos_is_met(
    psnr_drop, expected_trials, expected, monkeypatch
):
    """The fake packer's candidates lower the PSNR on training photos from 30 dB by `psnr_drop`."""
    tried: list[float] = []
    scene = SimpleNamespace(train=["a photo"])
    packer = running.Packer(None, {}, None, scene)
    monkeypatch.setattr(
        packer, "encode", lambda distortion, *_: tried.append(distortion) or running.EncodedCandidate(distortion, {})
    )
    monkeypatch.setattr(running.Packer, "decode", lambda packer, trial: trial.data)
    monkeypatch.setattr(
        running,
        "evaluate_model",
        lambda shown, views, progress: SimpleNamespace(psnr=30.0 if shown is None else 30.0 - psnr_drop(shown)),
    )

    trial = packer.encode_to_distortion(1e-3, SimpleNamespace(measure_error=lambda distortion: distortion), 0.1)

    assert tried == pytest.approx(expected_trials, rel=1e-3)
    assert trial.data == trial.measured_error == pytest.approx(expected, rel=1e-3)


@pytest.mark.acceptance
@pytest.mark.usefixtures("few_views")
def test_a_file_that_grows_is_reported(ball_file, tmp_path, caplog):
    coarse, fine = tmp_path / "coarse.hyrf", tmp_path / "fine.hyrf"
    compress_model(ball_file, coarse, CompressConfig(distortion=1e-2))
    assert not any("more than" in message for message in caplog.messages)
    compress_model(coarse, fine, CompressConfig(distortion=1e-9))
    assert fine.stat().st_size > coarse.stat().st_size
    warning = f"more than the {coarse.stat().st_size:,} of {coarse}"
    assert any(warning in message for message in caplog.messages)


def test_unreadable_photos_do_not_stop_packing(monkeypatch, caplog):
    packer = running.Packer(None, {}, None, SimpleNamespace(train=["a photo"]))
    monkeypatch.setattr(packer, "encode", lambda distortion, *_: running.EncodedCandidate(distortion, {}))
    monkeypatch.setattr(running.Packer, "decode", lambda packer, trial: trial.data)

    def fail(shown, views, progress):
        raise HyrfError("a.png: the file is gone", fix="copy it again")

    monkeypatch.setattr(running, "evaluate_model", fail)
    assert (
        packer.encode_to_distortion(1e-3, SimpleNamespace(measure_error=lambda distortion: distortion), 0.1).data
        == 1e-3
    )
    assert caplog.messages == ["a.png: the file is gone; copy it again; the loss on training photos is not measured"]


def test_without_photos_the_stored_cameras_and_the_stored_psnr_are_used(ball_file, tmp_path, monkeypatch):
    """The stored cameras equal those of the photos to nine digits."""
    poses, distortions = [], []

    def measure_and_record(model, cameras, distortion, *rest, **settings):
        poses.append([camera.camera_from_world for camera in cameras])
        distortions.append(distortion)
        return measure_calibrated_sensitivity(model, cameras, distortion, *rest, **settings)

    monkeypatch.setattr(run, "measure_calibrated_sensitivity", measure_and_record)
    compress_model(ball_file, tmp_path / "small.hyrf")

    assert distortions == pytest.approx([2.33e-4], rel=0.01)
    np.testing.assert_allclose(poses, [[view.camera.camera_from_world for view in ball_scene().train]], atol=1e-8)


@pytest.mark.usefixtures("few_views")
def test_without_photos_and_cameras_an_orbit_is_used(compact_file_and_report, scene, tmp_path):
    provenance = describe_file(DEMO_MODEL_FILE)["provenance"]
    del provenance["cameras"]
    save_model(load_model(DEMO_MODEL_FILE), tmp_path / "bare.hyrf", "raw", provenance)

    report = compress_model(tmp_path / "bare.hyrf", tmp_path / "small.hyrf")

    assert report.bytes_after < 2 * compact_file_and_report[1].bytes_after
    assert psnr(tmp_path / "small.hyrf", scene) > psnr(DEMO_MODEL_FILE, scene) - 1


def test_provenance_is_kept_with_a_sample_of_cameras(compact_file_and_report, paper_file):
    raw = describe_file(DEMO_MODEL_FILE)
    before, after = raw["provenance"], describe_file(compact_file_and_report[0])["provenance"]

    expected = quantized_provenance(before, raw["config"]["frame"]["scale"])
    assert after == describe_file(paper_file)["provenance"] == expected
    assert 0 < len(after["coarse_cameras"]) <= MIN_COARSE_CAMERAS and "cameras" in before and "cameras" not in after


@pytest.mark.acceptance
@pytest.mark.usefixtures("few_views")
def test_a_compressed_file_can_be_recompressed_and_unpacked_exactly(paper_file, scene, tmp_path):
    from_paper = compress_model(paper_file, tmp_path / "small.hyrf", data=scene)
    compress_model(DEMO_COMPACT_FILE, tmp_path / "back.hyrf", CompressConfig(profile="raw"))

    assert from_paper.bytes_after < paper_file.stat().st_size
    models = load_model(DEMO_COMPACT_FILE), load_model(tmp_path / "back.hyrf")
    pairs = zip(*(model.parameters() for model in models), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(
    ("recorded_psnr", "expected"),
    [(30.0, 2.33e-5), (20.0, 2.33e-4), (None, 2.33e-5), ("good", 2.33e-5), (0.0, 2.33e-5), (1e400, 2.33e-5)],
)
def test_the_default_distortion_costs_a_tenth_of_a_db(recorded_psnr, expected):
    """Mean squared errors add up: 10 lg((e + distortion) / e) = 0.1 with e = 10^(-psnr / 10)."""
    assert default_distortion({} if recorded_psnr is None else {"psnr": recorded_psnr}) == pytest.approx(
        expected, rel=0.01
    )


# -- refused options ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"finetune_steps": 5}, "need photos"),
        ({"max_psnr_drop": 0.1}, "need photos"),
        ({"target_bytes": 10_000, "distortion": 1e-5}, "give one of them"),
        (
            {"paper": PaperSettings(color=(2, 64))},
            "none of the settings of 'paper'; leave them out",
        ),
        ({"profile": "paper", "distortion": 1e-5}, "profile 'paper' cannot be fitted"),
        ({"profile": "raw", "finetune_steps": 5}, "profile 'raw' cannot be fitted"),
        ({"target_bytes": 500}, "500 bytes is below the smallest possible file"),
    ],
)
def test_invalid_combinations_of_options_are_refused_and_nothing_is_written(options, words, tmp_path):
    with pytest.raises(HyrfError, match=words):
        compress_model(DEMO_MODEL_FILE, tmp_path / "small.hyrf", CompressConfig(**options))

    assert not list(tmp_path.iterdir())


def test_progress_grows_and_the_work_ends_when_it_is_stopped(ball_file, tmp_path):
    events = []
    context = RunContext(progress=events.append, stop=lambda: len(events) > 3)

    with pytest.raises(KeyboardInterrupt):
        compress_model(ball_file, tmp_path / "small.hyrf", context=context)

    shares = [event.share for event in events]
    assert len(events) == 4 and shares == sorted(shares)
    assert not list(tmp_path.iterdir())


@pytest.mark.acceptance
@pytest.mark.usefixtures("few_views")
def test_an_unreachable_max_psnr_drop_is_refused(ball_file, tmp_path, monkeypatch):
    scored = limits.evaluate_model

    def worse_each_time(model, views, **options):
        worse_each_time.calls += 1
        return dataclasses.replace(scored(model, views, **options), psnr=30.0 - worse_each_time.calls)

    worse_each_time.calls = 0
    monkeypatch.setattr(limits, "evaluate_model", worse_each_time)

    with pytest.raises(HyrfError, match="even the finest file loses more than 0.5 dB of PSNR"):
        compress_model(ball_file, tmp_path / "small.hyrf", CompressConfig(max_psnr_drop=0.5), data=ball_scene())

    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("options", [{}, {"finetune_steps": 5}, {"max_psnr_drop": 0.1}], ids=["plain", "tune", "limit"])
def test_a_scene_without_training_photos_is_refused(options, scene, tmp_path):
    """Packing needs training photos to measure and to fine-tune on."""
    held_out = dataclasses.replace(scene, train=[], test=scene.train)

    with pytest.raises(HyrfError):
        compress_model(DEMO_MODEL_FILE, tmp_path / "small.hyrf", CompressConfig(**options), data=held_out)


@pytest.mark.parametrize("background", [False, True])
def test_a_model_that_no_camera_sees_is_refused(tmp_path, scene, background):
    positions = ball_points(30)[0] * 0.1 + np.array([0.0, 0.0, 500.0])
    save_model(small_model(positions, background=background), tmp_path / "behind.hyrf", "raw")

    with pytest.raises(HyrfError, match=r"behind.hyrf: none of its \d+ cameras sees a Gaussian.*`data`"):
        compress_model(tmp_path / "behind.hyrf", tmp_path / "small.hyrf", data=scene)
    assert not (tmp_path / "small.hyrf").exists()


@pytest.mark.usefixtures("few_views")
def test_no_distortion_removes_every_gaussian(tmp_path):
    compress_model(DEMO_MODEL_FILE, tmp_path / "small.hyrf", CompressConfig(distortion=1.0))
    assert len(load_model(tmp_path / "small.hyrf")) >= 1
