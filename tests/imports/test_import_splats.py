from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from explicit_balls import TINY_IMPORT_CONFIG, ball_splats
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

import hyrfpack
from hyrfpack.compress import calibrate
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.imports import ImportConfig, import_loaded_splats, pack, prepare, run
from hyrfpack.imports.reference import ReferenceViews
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.formats import ply
from hyrfpack.splats.splats import MAX_ABS_HARMONIC, Splats
from hyrfpack.splats.viewpoints import WeightedSplats, sample_viewpoints

pytestmark = pytest.mark.usefixtures("quick_calibration", "quick_import")


def test_the_report_describes_the_file(tmp_path: Path) -> None:
    splats, target = ball_splats(200), tmp_path / "ball.hyrf"
    report = import_loaded_splats(splats, target, TINY_IMPORT_CONFIG)
    model = hyrfpack.load_model(target)
    weighted = WeightedSplats.from_splats(splats, "ball")
    original = Drawable.from_splats(splats, weighted.frame)
    held_out = sample_viewpoints(weighted, original, TINY_IMPORT_CONFIG.test_views, TINY_IMPORT_CONFIG.size, 1)
    scores = ReferenceViews.from_splats(original, held_out).psnr_per_view(model)
    assert (report.psnr, report.psnr_worst) == (np.mean(scores), min(scores))
    assert (report.gaussians_before, report.gaussians_after) == (200, len(model))
    assert report.bytes_after == target.stat().st_size
    assert report.bytes_ply == 200 * 4 * (3 + 3 + 3 + 9 + 1 + 3 + 4)
    assert hyrfpack.describe_file(target)["profile"] == "compact"


@pytest.mark.acceptance
def test_same_splats_and_seed_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.hyrf", "b.hyrf"):
        import_loaded_splats(ball_splats(60), tmp_path / name, TINY_IMPORT_CONFIG)
    assert (tmp_path / "a.hyrf").read_bytes() == (tmp_path / "b.hyrf").read_bytes()


@pytest.mark.acceptance
def test_a_gallery_shows_the_psnr_of_an_import_only_if_the_import_aimed_at_one(tmp_path: Path) -> None:
    reports = {}
    for name, change in (("psnr", {"psnr": 20}), ("size", {"target_bytes": 20_000})):
        target = tmp_path / f"{name}.hyrf"
        reports[name] = import_loaded_splats(ball_splats(40), target, replace(TINY_IMPORT_CONFIG, **change))
        assert reports[name].bytes_after == target.stat().st_size
        assert ("psnr" in hyrfpack.describe_file(target)["provenance"]) == (name == "psnr")
        hyrfpack.export_gallery([target], tmp_path / name)
    texts = {name: (tmp_path / name / "index.html").read_text("utf-8") for name in ("psnr", "size")}
    psnr = hyrfpack.describe_file(tmp_path / "psnr.hyrf")["provenance"]["psnr"]
    assert psnr == round(reports["psnr"].psnr, 2)
    assert f"{psnr:.1f} dB against the splats it was made of<" in texts["psnr"] and " dB" not in texts["size"]


@pytest.mark.acceptance
def test_a_gallery_says_that_a_psnr_was_measured_before_compression(tmp_path: Path) -> None:
    imported, raw, small = (tmp_path / f"{name}.hyrf" for name in ("imported", "raw", "small"))
    import_loaded_splats(ball_splats(40), imported, replace(TINY_IMPORT_CONFIG, psnr=20.0))
    hyrfpack.compress_model(imported, small, hyrfpack.CompressConfig(profile="paper"))
    hyrfpack.compress_model(small, raw, hyrfpack.CompressConfig(profile="raw"))
    hyrfpack.export_gallery([imported, small, raw], tmp_path / "gallery")
    text = (tmp_path / "gallery" / "index.html").read_text("utf-8")
    assert text.count("against the splats it was made of") == 3
    assert text.count("made of before compression<") == 2


def test_the_largest_seed_is_accepted(tmp_path: Path) -> None:
    report = import_loaded_splats(ball_splats(40), tmp_path / "x.hyrf", replace(TINY_IMPORT_CONFIG, seed=2**64 - 1))
    assert hyrfpack.describe_file(tmp_path / "x.hyrf")["provenance"]["seed"] == 2**64 - 1 and report.psnr > 10


@pytest.mark.acceptance
@pytest.mark.parametrize("unit, offset", [(1, 1e6), (1e-6, 0)])
def test_the_result_does_not_depend_on_origin_and_unit(tmp_path: Path, unit: float, offset: float) -> None:
    splats = ball_splats(100)
    moved = replace(splats, positions=splats.positions * unit + offset, scales=splats.scales * np.float32(unit))
    here, there = (import_loaded_splats(some, tmp_path / "x.hyrf", TINY_IMPORT_CONFIG) for some in (splats, moved))
    assert abs(here.psnr_unpacked - there.psnr_unpacked) < 0.05
    frame = hyrfpack.load_model(tmp_path / "x.hyrf").config.frame
    np.testing.assert_allclose(
        frame.to_local(moved.positions),
        WeightedSplats.from_splats(splats, "").frame.to_local(splats.positions),
        atol=1e-5,
    )


def test_a_model_of_degree_0_splats_has_colours_without_direction(tmp_path: Path) -> None:
    import_loaded_splats(ball_splats(100, degree=0), tmp_path / "x.hyrf", TINY_IMPORT_CONFIG)
    assert {s["type"]: s["after"] for s in hyrfpack.describe_file(tmp_path / "x.hyrf")["sections"]}["RTAB"] < 32


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda s: s[:1], id="one"),
        pytest.param(lambda s: s[:2], id="two", marks=pytest.mark.acceptance),
        pytest.param(lambda s: replace(s, positions=s.positions * 0), id="coincident"),
        pytest.param(lambda s: replace(s, scales=s.scales * np.float32((1, 1, 0))), id="flat"),
        pytest.param(lambda s: replace(s, opacities=np.ones(len(s))), id="opaque", marks=pytest.mark.acceptance),
        pytest.param(
            lambda s: replace(s, opacities=np.where(np.arange(len(s)) % 2, s.opacities, 0)),
            id="clear",
            marks=pytest.mark.acceptance,
        ),
        pytest.param(
            lambda s: replace(s, positions=np.concatenate((np.full((1, 3), 1e12), s.positions[1:]))), id="outlier"
        ),
        pytest.param(lambda s: replace(s, antialiased=True), id="antialiased", marks=pytest.mark.acceptance),
    ],
)
def test_unusual_splats_can_be_imported(tmp_path: Path, change) -> None:
    report = import_loaded_splats(change(ball_splats(30)), tmp_path / "x.hyrf", TINY_IMPORT_CONFIG)
    assert report.gaussians_after >= 1
    assert report.psnr > 15


def change_harmonic(splats: Splats, value: float) -> Splats:
    """Return splats whose first Gaussian has another first harmonic, in red."""
    harmonics = splats.harmonics.copy()
    harmonics[0, 0, 0] = value
    return replace(splats, harmonics=harmonics)


@pytest.mark.parametrize("value", [pytest.param(1e20, marks=pytest.mark.acceptance), -3e38])
def test_a_huge_colour_is_clamped_with_a_warning(
    value: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    splats = change_harmonic(ball_splats(60), value)
    report = import_loaded_splats(splats, tmp_path / "x.hyrf", TINY_IMPORT_CONFIG, name="ball.ply")
    bounded = change_harmonic(splats, np.clip(value, -MAX_ABS_HARMONIC, MAX_ABS_HARMONIC))
    alike = import_loaded_splats(bounded, tmp_path / "y.hyrf", TINY_IMPORT_CONFIG, name="ball.ply")
    assert (tmp_path / "x.hyrf").read_bytes() == (tmp_path / "y.hyrf").read_bytes()
    assert report.psnr == alike.psnr > 30
    warnings = [record.getMessage() for record in caplog.records if "clamped" in record.getMessage()]
    assert len(warnings) == 1 and warnings[0].startswith("ball.ply: harmonics of 1 of 60 Gaussians are beyond 100,000")


def test_the_bound_of_harmonics_hardly_changes_a_picture() -> None:
    splats = ball_splats(60)
    weighted = WeightedSplats.from_splats(splats, "ball")
    cameras = sample_viewpoints(weighted, Drawable.from_splats(splats, weighted.frame), 4, 64, 0)
    before, after = (
        ReferenceViews.from_splats(Drawable.from_splats(change_harmonic(splats, value), weighted.frame), cameras)
        for value in (1e30, MAX_ABS_HARMONIC)
    )
    for one, other in zip(before.pictures, after.pictures, strict=True):
        assert (one - other).square().mean() < 1e-5  # 50 dB


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda s: s[:0], "there is no Gaussian in it"),
        (lambda s: replace(s, opacities=np.zeros(len(s))), "no Gaussian is visible"),
        (lambda s: replace(s, scales=s.scales * 0), "no Gaussian is visible"),
    ],
    ids=["none", "clear", "points"],
)
def test_splats_that_cannot_be_seen_are_a_clear_error(tmp_path: Path, change, problem: str) -> None:
    with pytest.raises(HyrfDataError, match=f"^ball.ply: {problem}"):
        import_loaded_splats(change(ball_splats(20)), tmp_path / "x.hyrf", TINY_IMPORT_CONFIG, name="ball.ply")


def test_cameras_of_another_scene_are_a_clear_error(tmp_path: Path) -> None:
    splats = ball_splats(301)
    far = replace(splats, positions=splats.positions + np.where(np.arange(301) < 300, 1000.0, 0.0)[:, None])
    pose = np.eye(4)
    pose[2, 3] = 3
    with pytest.raises(HyrfDataError, match="show only 1 of 301 Gaussians, as if they belonged to another scene"):
        import_loaded_splats(
            far, tmp_path / "x.hyrf", TINY_IMPORT_CONFIG, cameras=[Camera(32, 32, 32, 32, 16, 16, pose)]
        )


def test_cameras_that_see_no_splats_are_a_clear_error(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[2, 3] = -100  # moves all splats behind the camera
    with pytest.raises(HyrfDataError, match="no view shows anything"):
        import_loaded_splats(
            ball_splats(20), tmp_path / "x.hyrf", TINY_IMPORT_CONFIG, cameras=[Camera(32, 32, 32, 32, 16, 16, pose)]
        )


def test_folder_that_cannot_be_made_is_reported_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr(prepare, "_choose_cameras", lambda *arguments: pytest.fail("the work began"))
    with pytest.raises(HyrfError, match="file is a file, not a folder"):
        import_loaded_splats(ball_splats(20), tmp_path / "file" / "x.hyrf", TINY_IMPORT_CONFIG)


def test_an_interrupt_while_packing_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "x.hyrf"
    target.write_bytes(b"before")
    monkeypatch.setattr(pack, "PLANNED_ERROR_SHARE", 100.0)  # makes the first attempt miss the target
    monkeypatch.setattr(pack.Packer, "encode", _interrupt_second_call(pack.Packer.encode))
    with pytest.raises(KeyboardInterrupt):
        import_loaded_splats(ball_splats(20), target, TINY_IMPORT_CONFIG)
    assert [path.name for path in tmp_path.iterdir()] == ["x.hyrf"]
    assert target.read_bytes() == b"before"


@pytest.mark.parametrize(
    ("error", "raised"),
    [(MemoryError("no room"), "memory ran out .*; reduce `size`"), (HyrfError("a bug", fix="x"), "a bug")],
)
def test_a_file_that_cannot_be_scored_is_kept(
    error, raised: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(run, "decode_model", fail)
    target = tmp_path / "x.hyrf"
    with pytest.raises(HyrfError, match=raised):
        import_loaded_splats(ball_splats(20), target, TINY_IMPORT_CONFIG)
    assert len(hyrfpack.load_model(target)) > 0
    assert f"{target}: the file is complete, but it could not be scored" in caplog.messages


def test_no_negative_share_of_the_allowed_error_is_printed(caplog: pytest.LogCaptureFixture) -> None:
    class FakePacker:
        def encode(self, distortion: float, progress: object) -> pack.EncodedCandidate:
            return pack.EncodedCandidate(b"data", {})

    with caplog.at_level("INFO", "hyrfpack"):
        pack._search(FakePacker(), 1e-4, lambda candidate: -0.3, lambda event: None)
    assert caplog.messages and all(message.endswith(", 0.00 of the allowed error") for message in caplog.messages)


def _interrupt_second_call(compress):
    calls = []

    def wrapped(*args, **options):
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return compress(*args, **options)

    return wrapped


def record_calls(monkeypatch: pytest.MonkeyPatch, place, name: str) -> list:
    """Record the arguments of each call of a function from now on."""
    calls, whole = [], getattr(place, name)
    monkeypatch.setattr(place, name, lambda *args, **options: calls.append(args) or whole(*args, **options))
    return calls


def test_repeated_packing_attempts_measure_and_draw_only_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pack, "mse_from_psnr", lambda psnr: 2.0**-psnr)  # makes packing seem to add a large error
    measured = record_calls(monkeypatch, calibrate, "measure_sensitivity")
    tried = record_calls(monkeypatch, pack.Packer, "encode")

    import_loaded_splats(ball_splats(60), tmp_path / "x.hyrf", TINY_IMPORT_CONFIG)

    assert len(tried) > 1 and len(measured) == 1
    assert len({noise for _, noise, *_ in tried}) == len(tried)


def test_a_psnr_below_the_target_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pack, "MAX_TRIALS", 1)
    monkeypatch.setattr(pack, "PLANNED_ERROR_SHARE", 4.0)  # makes the only file miss the target
    caplog.set_level("INFO")
    report = import_loaded_splats(ball_splats(60), tmp_path / "x.hyrf", replace(TINY_IMPORT_CONFIG, psnr=37.9))
    assert report.psnr_asked == 37.9
    assert caplog.messages[-1].startswith(
        f"the target PSNR is 37.9 dB, but the file reaches {report.psnr:.1f} dB at held-out viewpoints"
    )
    assert caplog.messages[-1].endswith("set a higher target with `psnr`")

    caplog.clear()
    import_loaded_splats(ball_splats(60), tmp_path / "x.hyrf", replace(TINY_IMPORT_CONFIG, psnr=10))
    assert not any("target PSNR" in sentence for sentence in caplog.messages)


def test_a_missed_target_advises_another_psnr() -> None:
    messages = run._shortfall(36.5, 38.6, ImportConfig(psnr=37), has_cameras=False)
    assert "reaches 36.5" in messages and messages.endswith("set a higher target with `psnr`")
    assert "set a lower `psnr`" in run._shortfall(55, 56, ImportConfig(psnr=60), has_cameras=False)
    assert "(34.1 dB before compression); set a higher `worst`" in run._worst_shortfall(31.2, 34.1, 33)
    assert "(32.5 dB before compression); set a lower `worst`" in run._worst_shortfall(31.2, 32.5, 33)
    assert not run._falls_short(36.96, 37) and run._falls_short(36.94, 37)
    assert not run._falls_short(37.04, 37.04)


def test_a_missed_target_that_is_the_highest_advises_more_cameras() -> None:
    given = run._shortfall(58, 80, ImportConfig(psnr=60), has_cameras=True)
    sampled = run._worst_shortfall(58, 80, 60, has_cameras=False)
    for sentence, remedy in ((given, "give more `cameras`"), (sampled, "name many viewpoints with `cameras`")):
        assert "set a higher" not in sentence and f"60 dB is the highest target, so {remedy}" in sentence


def test_a_target_missed_with_few_cameras_advises_more_cameras(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pose = np.eye(4)
    pose[2, 3] = 4
    # The first camera is held out, and the others see only the middle of the ball.
    cameras = [Camera(32, 32, focal, focal, 16, 16, pose) for focal in (32, 200, 200)]
    import_loaded_splats(ball_splats(60), tmp_path / "x.hyrf", replace(TINY_IMPORT_CONFIG, psnr=60), cameras=cameras)
    assert "the given cameras hardly show" in caplog.text
    assert caplog.messages[-1].endswith("give more `cameras` or set a lower `psnr`")


@pytest.mark.parametrize("name", ["x", "x.ply", "x.hyrf.bak"])
def test_a_target_that_is_not_named_hyrf_is_rejected_before_the_work(name: str, tmp_path: Path) -> None:
    (tmp_path / "ball.ply").write_bytes(ply.encode(ball_splats(20)))
    with pytest.raises(HyrfError, match="the file extension must be .hyrf"):
        hyrfpack.import_splats(tmp_path / "ball.ply", tmp_path / name, TINY_IMPORT_CONFIG)
    with pytest.raises(HyrfError, match="the file extension must be .hyrf"):
        import_loaded_splats(ball_splats(20), tmp_path / name, TINY_IMPORT_CONFIG)
    assert [path.name for path in tmp_path.iterdir()] == ["ball.ply"]


def test_settings_out_of_range_are_rejected() -> None:
    for wrong in (
        *({"size": 0}, {"views": True}, {"test_views": "3"}),
        *(
            {"psnr": float("nan")},
            {"psnr": 61},
            {"worst": 61},
            {"target_bytes": 0},
            {"psnr": "high"},
            {"seed": -1},
            {"seed": 2**64},
        ),
    ):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            ImportConfig(**wrong)


@pytest.mark.parametrize("name", ["psnr", "worst"])
def test_a_target_size_excludes_targets_of_psnr(name: str) -> None:
    with pytest.raises(HyrfError, match=f"decide how large the file is; give one of `target_bytes` and `{name}`"):
        ImportConfig(target_bytes=20_000, **{name: 37.0})


def test_reference_views_hold_the_drawn_pictures() -> None:
    splats = ball_splats(40)
    weighted = WeightedSplats.from_splats(splats, "ball")
    original = Drawable.from_splats(splats, weighted.frame)
    (camera,) = sample_viewpoints(weighted, original, 1, 32, 0)

    (picture,) = ReferenceViews.from_splats(original, [camera]).pictures

    assert torch.equal(picture, draw(original, camera).rgb.clamp(0, 1))


@given(st.lists(st.floats(1e-8, 1e-2), min_size=1, max_size=48), st.floats(1.001, 50.0))
@examples(60)
def test_the_distortion_added_to_each_view_gives_the_target_mean_psnr(errors, factor):
    errors = np.array(errors)
    own = np.exp(np.log(errors).mean())

    added = pack.solve_added_error(errors, factor * own)

    # Where views differ, the nearly perfect ones lose most, and less distortion is available.
    assert 0 < added <= (factor - 1) * own * (1 + 1e-6)
    if added > 2e-6 * factor * own:
        assert np.exp(np.log(errors + added).mean()) == pytest.approx(factor * own, rel=1e-6)


def test_views_without_error_receive_the_whole_distortion():
    assert pack.solve_added_error(np.zeros(3), 1e-4) == pytest.approx(1e-4)
