"""The choice of frames from synthetic videos with known motion, blur and repetitions."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from layers import only_in_acceptance
from made_up_photos import arc_pose, render_panorama, wall_textures
from PIL import Image
from scipy import ndimage

import hyrfpack
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.poses.frames import RECORD_NAME, choose_frames, frame_times, survey_frames
from hyrfpack.poses.hdr import HLG_TRANSFER, PQ_TRANSFER, tone_map_to_srgb
from hyrfpack.poses.motion import motion_distances, track_windows
from hyrfpack.poses.video import Video
from hyrfpack.progress import TaskEvent, ignore_progress

av = pytest.importorskip("av")

FRAME_WIDTH = 240
FRAME_HEIGHT = 136


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """A (H, W, 3) uint8 picture of rectangles of many sizes and colours, larger than a frame."""
    generator = np.random.default_rng(1)
    picture = np.full((400, 1600, 3), 128, np.uint8)
    for _ in range(1500):
        top, left = generator.integers(0, 400), generator.integers(0, 1600)
        height, width = generator.integers(4, 60, 2)
        picture[top : top + height, left : left + width] = generator.integers(10, 245, 3)
    return picture


def crop_wall(wall: np.ndarray, x: float, y: int = 100) -> np.ndarray:
    """Return the part of the wall that begins at (x, y), interpolated horizontally."""
    left = int(x)
    pair = wall[y : y + FRAME_HEIGHT, left : left + FRAME_WIDTH + 1].astype(np.float32)
    return (pair[:, :-1] + (x - left) * (pair[:, 1:] - pair[:, :-1])).round().astype(np.uint8)


def blur(picture: np.ndarray, length: int = 7) -> np.ndarray:
    return ndimage.uniform_filter1d(picture.astype(np.float32), length, axis=1).round().astype(np.uint8)


def write_video(
    path: Path,
    frames: list[np.ndarray],
    *,
    codec: str = "libx264",
    times: list[int] | None = None,
    set_up: Callable = lambda stream: None,
) -> Path:
    """Write a video of frames at 30 a second, or at `times` in milliseconds."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options={"crf": "16"} if codec == "libx264" else {})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        if times:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        set_up(stream)
        for number, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), "rgb24")
            if times:
                frame.pts, frame.time_base = times[number], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def mean_luma_difference(folder: Path, number: int, pixels: np.ndarray) -> float:
    """Return the mean luma difference between a frame on disk and a picture; video has half the colour resolution."""
    with Image.open(folder / f"frame_{number:06d}.jpg") as picture:
        found = np.asarray(picture.convert("L"), np.float64)
    expected = np.asarray(Image.fromarray(np.ascontiguousarray(pixels)).convert("L"))
    assert found.shape == expected.shape
    return float(np.abs(found - expected).mean())


def frame_numbers(folder: Path) -> list[int]:
    """Return the numbers of the frames on disk."""
    return sorted(int(path.stem.removeprefix("frame_")) for path in folder.glob("*.jpg"))


@pytest.mark.acceptance
def test_blurred_and_repeated_frames_are_never_chosen(wall, tmp_path):
    """Every third frame is blurred and every fourth repeated; the camera moves by 1.5 % of the width per frame."""
    frames, kinds, places = [], [], []
    for number in range(80):
        x = 3.6 * number
        frames.append(crop_wall(wall, x))
        kinds.append("sharp")
        places.append(x)
        for other, every in (("blurred", 3), ("repeated", 4)):
            if number % every == 1:
                frames.append(blur(crop_wall(wall, x)) if other == "blurred" else frames[-1])
                kinds.append("blurred" if kinds[-1] == "blurred" else other)
                places.append(x)
    video = write_video(tmp_path / "clip.mp4", frames)
    report = choose_frames(video, tmp_path / "frames")
    numbers = frame_numbers(tmp_path / "frames")
    assert report.taken == len(numbers) > 40 and report.of == len(frames)
    assert "blurred" not in [kinds[number] for number in numbers]
    assert (
        np.diff([places[number] for number in numbers]).min() > 0
    )  # of several frames with the same content only one is chosen
    assert report.blurred == len(range(1, 80, 3))
    assert mean_luma_difference(tmp_path / "frames", numbers[3], frames[numbers[3]]) < 4
    assert json.loads((tmp_path / "frames" / RECORD_NAME).read_text())["frames"] == numbers


@pytest.mark.acceptance
def test_frames_are_spread_by_motion_and_not_by_time(wall, tmp_path):
    """The camera moves twice as fast in the second half; both parts of the path give the same number of frames."""
    places = np.concatenate((np.arange(0, 300, 2.0), np.arange(300, 900, 6.0)))
    video = write_video(tmp_path / "clip.mp4", [crop_wall(wall, x) for x in places])
    report = choose_frames(video, tmp_path / "frames", max_frames=40)
    numbers = frame_numbers(tmp_path / "frames")
    assert 30 <= len(numbers) <= 40
    steps = np.diff(places[numbers]) / FRAME_WIDTH
    assert np.median(steps) == pytest.approx(report.spacing, rel=0.15)
    slow, fast = (np.median(steps[part]) for part in (places[numbers[1:]] < 300, places[numbers[1:]] > 310))
    assert fast == pytest.approx(slow, rel=0.5)


def test_measured_motion_is_right_and_ignores_a_shaking_camera(wall):
    small = [crop_wall(wall, x)[:, :160].mean(axis=2).astype(np.uint8) for x in (10, 12, 15, 21, 35, 45, 33, 20, 10)]
    found = track_windows(small)
    expected = np.array([0, 2, 5, 11, 25, 35, 23, 10, 0]) / 160
    assert motion_distances(found, 0, slice(0, 9)) == pytest.approx(expected, abs=0.006)


def test_a_repeated_call_does_nothing_and_an_interrupted_call_resumes(wall, tmp_path):
    video = write_video(tmp_path / "clip.mp4", [crop_wall(wall, 4.0 * number) for number in range(60)])
    folder = tmp_path / "frames"
    first = choose_frames(video, folder)
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    removed = sorted(folder.glob("*.jpg"))[5]
    content = removed.read_bytes()
    removed.unlink()
    events: list[TaskEvent] = []
    assert choose_frames(video, folder, progress=events.append) == first
    assert removed.read_bytes() == content
    assert all(path.stat().st_mtime_ns == time for path, time in before.items() if path != removed)
    assert not any(event.task.startswith("measuring") for event in events) and events[-1].share == 1.0
    (folder / "mine.jpg").write_bytes(b"kept")
    fewer = choose_frames(video, folder, max_frames=10)
    assert fewer.taken <= 10 and len(list(folder.glob("frame_*.jpg"))) == fewer.taken
    assert (folder / "mine.jpg").read_bytes() == b"kept"


def test_progress_never_decreases(wall, tmp_path):
    video = write_video(tmp_path / "clip.mp4", [crop_wall(wall, 4.0 * number) for number in range(40)])
    events: list[TaskEvent] = []
    choose_frames(video, tmp_path / "frames", progress=events.append)
    shares = [event.share for event in events]
    assert shares == sorted(shares) and 0 <= shares[0] and shares[-1] == 1.0


@pytest.mark.parametrize("degrees", only_in_acceptance([90, 180, -90], [180, -90]))
def test_frames_are_written_upright(wall, tmp_path, degrees):
    def turned(stream):
        if not hasattr(stream, "set_display_rotation"):
            pytest.skip("this version of PyAV cannot write a rotation")
        stream.set_display_rotation(degrees)

    frames = [crop_wall(wall, 4.0 * number) for number in range(40)]
    choose_frames(write_video(tmp_path / "clip.mp4", frames, set_up=turned), tmp_path / "frames")
    number = frame_numbers(tmp_path / "frames")[2]
    expected = np.rot90(frames[number], degrees // 90)  # counter-clockwise, as the file states
    assert mean_luma_difference(tmp_path / "frames", number, expected) < 4


@pytest.mark.parametrize(
    ("matrix", "show"),
    [
        ((-1, 0, 0, 1), lambda pixels: pixels[:, ::-1]),
        ((1, 0, 0, -1), lambda pixels: pixels[::-1]),
        ((0, 1, 1, 0), lambda pixels: pixels.transpose(1, 0, 2)),
        ((0, 1, -1, 0), lambda pixels: np.rot90(pixels, -1)),
    ],
    ids=["left to right", "top to bottom", "at the diagonal", "a quarter turn"],
)
def test_frames_are_mirrored_as_the_video_says(wall, tmp_path, matrix, show):
    frames = [crop_wall(wall, 4.0 * number) for number in range(40)]
    video = write_video(tmp_path / "clip.mp4", frames)
    header = [round(65536 * value) for value in (1, 0, 0, 0, 1, 0, 0, 0)] + [1 << 30]
    content, stored = video.read_bytes(), struct.pack(">9i", *header)
    header[0:2], header[3:5] = ([65536 * value for value in matrix[i : i + 2]] for i in (0, 2))
    track = content.index(b"tkhd")
    video.write_bytes(content[:track] + content[track:].replace(stored, struct.pack(">9i", *header), 1))
    choose_frames(video, tmp_path / "frames")
    number = frame_numbers(tmp_path / "frames")[2]
    assert mean_luma_difference(tmp_path / "frames", number, show(frames[number])) < 4


def test_the_stated_size_is_that_of_the_frames_as_written(wall, tmp_path):
    def turned(stream):
        if not hasattr(stream, "set_display_rotation"):
            pytest.skip("this version of PyAV cannot write a rotation")
        stream.set_display_rotation(90)

    frames = [crop_wall(wall, 4.0 * number) for number in range(40)]
    _, size, _ = survey_frames(write_video(tmp_path / "clip.mp4", frames, set_up=turned))
    assert size == (FRAME_HEIGHT, FRAME_WIDTH)


def test_a_raw_stream_that_cannot_be_rewound_is_read_twice(wall, tmp_path):
    frames = [crop_wall(wall, 4.0 * number) for number in range(40)]
    choose_frames(write_video(tmp_path / "clip.h264", frames), tmp_path / "frames")
    number = frame_numbers(tmp_path / "frames")[2]
    assert mean_luma_difference(tmp_path / "frames", number, frames[number]) < 4


def test_a_damaged_pixel_aspect_ratio_is_ignored(wall, tmp_path):
    def stretched(stream):
        stream.codec_context.sample_aspect_ratio = Fraction(1000, 1)

    frames = [crop_wall(wall, 4.0 * number) for number in range(40)]
    choose_frames(write_video(tmp_path / "clip.mp4", frames, set_up=stretched), tmp_path / "frames")
    with Image.open(next((tmp_path / "frames").glob("*.jpg"))) as picture:
        assert picture.size == (FRAME_WIDTH, FRAME_HEIGHT)


@pytest.mark.parametrize("seconds", [[0.0333 * number for number in range(15)], [*np.arange(14) / 14, 3.0]])
def test_an_intact_short_video_is_not_called_damaged(wall, tmp_path, seconds):
    frames = [crop_wall(wall, 8.0 * number) for number in range(15)]
    times = [round(1000 * time) for time in seconds]
    assert choose_frames(write_video(tmp_path / "clip.mkv", frames, times=times), tmp_path / "frames").notes == ()


def test_frames_at_uneven_times_are_all_found(wall, tmp_path):
    times = np.cumsum(np.random.default_rng(2).integers(5, 200, 50)).tolist()
    frames = [crop_wall(wall, 4.0 * number) for number in range(50)]
    report = choose_frames(write_video(tmp_path / "clip.mkv", frames, times=times), tmp_path / "frames")
    assert report.of == 50
    number = frame_numbers(tmp_path / "frames")[-2]
    assert mean_luma_difference(tmp_path / "frames", number, frames[number]) < 4


def test_a_truncated_video_gives_its_frames_and_a_note(wall, tmp_path):
    video = write_video(tmp_path / "clip.mkv", [crop_wall(wall, 4.0 * number) for number in range(120)])
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    report = choose_frames(video, tmp_path / "frames")
    assert 20 < report.of < 100
    assert any("cut off" in note for note in report.notes)


def test_a_video_that_changes_its_size_is_not_called_damaged(wall, tmp_path, monkeypatch):
    def resized_frames(video):
        for number, time, frame in usual_frames(video):
            yield number, time, frame if number < 60 else frame.reformat(width=FRAME_HEIGHT, height=FRAME_WIDTH)

    usual_frames = Video.frames
    monkeypatch.setattr(Video, "frames", resized_frames)
    video = write_video(tmp_path / "clip.mkv", [crop_wall(wall, 4.0 * number) for number in range(120)])
    assert choose_frames(video, tmp_path / "frames").notes == (
        "the picture changes its size after 2 s; the frames after that are not used",
    )


def test_a_damaged_video_gives_the_frames_that_can_be_decoded(wall, tmp_path):
    video = write_video(tmp_path / "clip.mkv", [crop_wall(wall, 4.0 * number) for number in range(120)])
    data = bytearray(video.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 3000] = bytes(3000)
    video.write_bytes(data)
    assert choose_frames(video, tmp_path / "frames").taken >= 20


def frame_error(video: Path, folder: Path) -> str:
    with pytest.raises(HyrfDataError) as caught:
        choose_frames(video, folder)
    assert not folder.exists()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_video_without_usable_frames_is_a_clear_error(wall, tmp_path):
    moving = [crop_wall(wall, 4.0 * number) for number in range(60)]
    whole = write_video(tmp_path / "whole.mp4", moving)
    out = tmp_path / "frames"
    assert "only 3 frames" in frame_error(write_video(tmp_path / "three.mp4", moving[:3]), out)
    assert "only 1 frame;" in frame_error(write_video(tmp_path / "one.mp4", moving[:1]), out)
    assert "hardly moves" in frame_error(write_video(tmp_path / "still.mp4", [moving[0]] * 60), out)
    flat = [np.full((FRAME_HEIGHT, FRAME_WIDTH, 3), 90, np.uint8)] * 30
    assert "blurred" in frame_error(write_video(tmp_path / "flat.mp4", flat), out)
    soft = [ndimage.gaussian_filter(picture, (5, 5, 0)) for picture in moving]
    assert "blurred" in frame_error(write_video(tmp_path / "soft.mp4", soft), out)
    cut = tmp_path / "cut.mp4"  # the table of contents is at the end of the file
    cut.write_bytes(whole.read_bytes()[:-2000])
    assert "cannot be read as a video" in frame_error(cut, out)
    unknown = write_video(tmp_path / "unknown.mkv", moving)
    unknown.write_bytes(unknown.read_bytes().replace(b"V_MPEG4/ISO/AVC", b"V_MPEG4/ISO/XXX"))
    assert "cannot decode this kind of video" in frame_error(unknown, out)
    text = tmp_path / "text.mp4"
    text.write_text("no video")
    assert frame_error(text, out).endswith("; copy it again in full")
    text = text.rename(tmp_path / "text.mov")
    assert frame_error(text, out).endswith("; copy it again in full, or save it as .mp4")
    (tmp_path / "empty.mp4").touch()
    assert "empty" in frame_error(tmp_path / "empty.mp4", out)
    assert "no such file" in frame_error(tmp_path / "nowhere.mp4", out)
    assert "folder" in frame_error(tmp_path, out)


def test_a_file_of_sound_alone_is_rejected(tmp_path):
    with av.open(str(tmp_path / "sound.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.int16), "s16", "mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert "no video stream" in frame_error(tmp_path / "sound.wav", tmp_path / "frames")


def test_without_pyav_the_error_names_it(tmp_path, monkeypatch):
    import sys

    (tmp_path / "clip.mp4").write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(HyrfError, match=r"pip install \"hyrfpack\[video\]\""):
        choose_frames(tmp_path / "clip.mp4", tmp_path / "frames")


@pytest.mark.parametrize(
    ("transfer", "signal", "light"),
    [
        (PQ_TRANSFER, 0.5806, 203.0),
        (HLG_TRANSFER, 0.75, 203.0),
        (PQ_TRANSFER, 0.4, 32.46),
        (HLG_TRANSFER, 0.25, 1000 * (0.25**2 / 3) ** 1.2),
    ],
)
def test_high_dynamic_range_keeps_grey_and_its_light(transfer, signal, light):
    """The points of the curves are tabulated in BT.2408 and BT.2100; light above 0.7 of paper white is compressed."""
    shown = tone_map_to_srgb(np.full((1, 1, 3), round(signal * 65535), np.uint16), transfer)[0, 0].astype(float)
    assert np.ptp(shown) <= 1
    linear = ((shown[0] / 255 + 0.055) / 1.055) ** 2.4 if shown[0] > 10 else shown[0] / 255 / 12.92
    share = light / 203
    expected = share if share < 0.7 else 0.7 + 0.3 * ((share - 0.7) / 0.3) / (1 + (share - 0.7) / 0.3)
    assert linear == pytest.approx(expected, rel=0.03, abs=0.002)


def test_high_dynamic_range_clips_nothing():
    ramp = np.repeat(np.arange(0, 65536, 257, dtype=np.uint16)[None, :, None], 3, axis=2)
    for transfer in (PQ_TRANSFER, HLG_TRANSFER):
        shown = tone_map_to_srgb(ramp, transfer)[0, :, 0].astype(int)
        assert (np.diff(shown) >= 0).all() and shown[0] == 0 and (shown == 255).sum() < 60


@pytest.mark.acceptance
def test_a_resumed_estimation_of_a_video_still_reports_its_number_of_frames(wall, tmp_path, caplog):
    video = write_video(tmp_path / "clip.mp4", [crop_wall(wall, 4.0 * number) for number in range(60)])

    def stop(event: TaskEvent) -> None:
        if "features" in event.task:
            raise KeyboardInterrupt

    said: list[list[str]] = []
    for _ in range(2):
        caplog.clear()
        with pytest.raises(KeyboardInterrupt):
            hyrfpack.estimate_poses(video, tmp_path / "scene", context=RunContext(progress=stop))
        said.append(caplog.messages)
    assert said[1] == ["resuming an interrupted estimation", *said[0]]
    assert "frames were taken" in said[0][0]


def test_frames_keep_their_times_so_that_messages_can_name_them(wall, tmp_path):
    times = [int(1000 * number / 30) + (500 if number >= 30 else 0) for number in range(60)]
    video = write_video(tmp_path / "clip.mp4", [crop_wall(wall, 4 * number) for number in range(60)], times=times)
    choose_frames(video, tmp_path / "frames")
    found = frame_times(tmp_path / "frames")
    assert sorted(found) == [f"frame_{number:06d}.jpg" for number in frame_numbers(tmp_path / "frames")]
    for name, seconds in found.items():
        assert seconds == pytest.approx(times[int(name[6:12])] / 1000, abs=0.002)


def test_every_stage_of_a_video_reports_progress(wall, tmp_path):
    events: list[TaskEvent] = []
    video = write_video(tmp_path / "clip.mp4", [crop_wall(wall, 4 * number) for number in range(60)])
    choose_frames(video, tmp_path / "frames", progress=events.append)
    shares = [event.share for event in events]
    assert shares == sorted(shares) and shares[-1] == 1
    for words in ("measuring frame 60, 2 s of 2 s", "measuring the camera motion, frame 59/60", "writing frames "):
        assert any(words in event.task for event in events), words


def test_an_omitted_frame_is_named_with_its_time(wall, tmp_path):
    from hyrfpack.config.poses import PosesConfig
    from hyrfpack.poses.estimate import _PoseEstimation

    video = write_video(tmp_path / "clip.mp4", [crop_wall(wall, 4 * number) for number in range(60)])
    estimation = _PoseEstimation(video, tmp_path / "scene", PosesConfig(), None, False, ignore_progress)
    (tmp_path / "scene").mkdir()
    estimation.output.check_replaceable(video, overwrite=False)
    job = estimation._prepare_job()
    number = int(job.names[5][6:12])
    assert estimation._user_name(job.names[5]) == f"{job.names[5]} (at {number / 30:.1f} s)"


@pytest.mark.acceptance
def test_a_360_degree_video_is_refused_by_its_own_name(tmp_path):
    panorama = render_panorama(arc_pose(0.5), wall_textures())
    frames = [np.roll(panorama, 4 * number, axis=1) for number in range(20)]
    video = write_video(tmp_path / "round.mp4", frames)
    sentence = refused("poses", video, "-o", tmp_path / "scene")
    assert "round.mp4: this is a 360-degree video" in sentence
    assert sentence.endswith("save frames of the video as pictures in a folder, and name that folder")
    assert not (tmp_path / "scene").exists()
