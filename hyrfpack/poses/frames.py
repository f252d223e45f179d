"""Choose the frames of a video that become photos: sharp ones, spaced by the motion of the picture."""

from __future__ import annotations

import io
import json
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.atomic import make_folder, write_atomic
from hyrfpack.counts import format_count
from hyrfpack.data.quality import mark_blurred, measure_sharpness
from hyrfpack.errors import HyrfDataError
from hyrfpack.outputs import StrPath
from hyrfpack.poses.motion import TRACKING_SIDE_PIXELS, motion_distances, track_windows
from hyrfpack.poses.video import Video, decode_gray, decode_upright, open_video
from hyrfpack.progress import Progress, TaskEvent, ignore_progress, part_of_progress

__all__ = ["FrameReport", "choose_frames", "survey_frames"]


RECORD_NAME = "frames.json"  # this file beside the frames states their video and settings

# Spacings are the motion of the picture between two taken frames, as a ratio of its longer side.
_DEFAULT_SPACING_RATIO = 0.05
_MIN_SPACING_RATIO = 0.01
_MAX_MATCHABLE_SPACING_RATIO = 0.15  # matching begins to fail beyond this spacing
_TARGET_FRAMES = 60  # in slow videos the spacing is reduced until this number is reached
_MIN_DECODED_FRAMES = 10
_MIN_TAKEN_FRAMES = 5
_DEFAULT_MAX_TAKEN_FRAMES = 150
_SHARPNESS_SIDE_PIXELS = 640  # longer side of the pictures whose sharpness is measured
# Measuring more frames than this takes time and does not improve the choice.
_MAX_MEASURED_FRAMES_PER_SECOND = 30.5
_MAX_MEASURED_FRAMES = 6000
_MAX_REPEAT_DIFFERENCE_LEVELS = 0.4  # mean over 255 levels: video coders change repeated frames by less than this
# Ratios of the whole work that are done after the measuring pass and after tracking.
_MEASURED_PROGRESS = 0.6
_TRACKED_PROGRESS = 0.7
_MIN_DURATION_RATIO = 0.95  # a video with less of the duration in its header counts as cut off


@dataclass(frozen=True)
class FrameReport:
    """Figures about the frames that were taken from a video.

    Attributes:
        taken: number of frames written.
        of: number of frames that could be decoded.
        blurred: number of measured frames that are blurred compared with the others.
        repeated: number of measured frames that equal the previous frame.
        seconds: duration of the decoded video.
        spacing: median motion of the picture between two taken frames, as a ratio of its longer side.
        notes: sentences for the user.
    """

    taken: int
    of: int
    blurred: int
    repeated: int
    seconds: float
    spacing: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _VideoMeasurement:
    """Result of the measuring pass over a video; the arrays hold the N measured frames without repeated ones.

    Attributes:
        numbers: (N,) frame numbers in the video.
        times: (N,) seconds from the start of the video.
        sharpness: (N,) sharpness of each frame.
        thumbnails: N pictures, (h, w) uint8.
        decoded_count: number of frames that could be decoded.
        repeated_count: number of measured frames that equal the previous frame.
        seconds: duration of the decoded video.
        notes: sentences for the user.
        size: (width, height) of the frames as they are written, upright and with square pixels.
    """

    numbers: np.ndarray
    times: np.ndarray
    sharpness: np.ndarray
    thumbnails: list[np.ndarray]
    decoded_count: int
    repeated_count: int
    seconds: float
    notes: tuple[str, ...]
    size: tuple[int, int]


def choose_frames(
    video: StrPath,
    folder: StrPath,
    *,
    max_frames: int = _DEFAULT_MAX_TAKEN_FRAMES,
    progress: Progress = ignore_progress,
) -> FrameReport:
    """Choose sharp, evenly spaced frames of a video and write them as photos.

    All frames are decoded once to measure their sharpness and the motion of the picture. The chosen frames are decoded
    once more at full size. Blurred and repeated frames are never taken. Between two taken frames the picture moves by
    about 5 % of its longer side, less in slow videos and more in long ones. The sharpest of the frames near that
    spacing is taken.

    The frames are upright JPEG files, named by their number in the video ("frame_000123.jpg"), with "frames.json"
    beside them. If the folder already has all frames of the same video and settings, nothing is written. A repeated
    call resumes an interrupted one.

    Args:
        video: a video file that FFmpeg can read. High dynamic range is tone mapped to sRGB.
        folder: output folder; created if missing. Only frames of an earlier call are removed from it.
        max_frames: maximum number of frames to take.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfDataError: the file is missing or is no video, or too few frames can be decoded, are sharp, or differ.
        HyrfError: PyAV is not installed, or the frames cannot be written.
        ValueError: `max_frames` is below 5.

    Example:
        >>> from hyrfpack.poses.frames import choose_frames
        >>> report = choose_frames("clip.mp4", "scene/images")  # doctest: +SKIP
        >>> f"{report.taken} of {report.of} frames"  # doctest: +SKIP
        '112 of 1843 frames'
    """
    if max_frames < _MIN_TAKEN_FRAMES:
        raise ValueError(f"max_frames must be {_MIN_TAKEN_FRAMES} or more, not {max_frames}")
    video, folder = Path(video), Path(folder)
    with open_video(video) as source:
        status = video.stat()
        key = {"video": video.name, "bytes": status.st_size, "modified": status.st_mtime_ns, "most": max_frames}
        record = _read_record(folder)
        if record is None or record["key"] != key:
            measured = _measure_video(video, source, progress)
            chosen, report = _choose_spaced_frames(video, measured, max_frames, progress)
            _remove_frames(folder, record)
            make_folder(folder)
            times = {_frame_name(number): seconds for number, seconds in chosen.items()}
            record = {"key": key, "frames": list(chosen), "times": times, "report": asdict(report)}
            write_atomic(folder / RECORD_NAME, json.dumps(record).encode())
        _write_frames(source, folder, record["frames"], progress)
    progress(TaskEvent("frames written", 1.0))
    return FrameReport(**{**record["report"], "notes": tuple(record["report"]["notes"])})


def survey_frames(video: StrPath, progress: Progress = ignore_progress) -> tuple[FrameReport, tuple[int, int], int]:
    """Measure a video and report which frames `choose_frames` would take by default, without writing any file.

    Args:
        video, progress: see `choose_frames`.

    Returns:
        The report, the (width, height) of the frames as they are written, upright and with square pixels, and the
            number of measured frames.

    Raises:
        HyrfDataError: see `choose_frames`.

    Example:
        >>> report, size, measured_count = survey_frames("clip.mp4")  # doctest: +SKIP
    """
    video = Path(video)
    with open_video(video) as source:
        measured = _measure_video(video, source, progress)
        _, report = _choose_spaced_frames(video, measured, _DEFAULT_MAX_TAKEN_FRAMES, progress)
        return report, measured.size, len(measured.numbers) + measured.repeated_count


def _measure_video(path: Path, video: Video, progress: Progress) -> _VideoMeasurement:
    """Decode a video once; measure the sharpness of its frames, and keep thumbnails on which motion is tracked."""
    step = max(1 / _MAX_MEASURED_FRAMES_PER_SECOND, video.seconds / _MAX_MEASURED_FRAMES)
    numbers: list[int] = []
    times: list[float] = []
    sharpness: list[float] = []
    thumbnails: list[np.ndarray] = []
    decoded_count, repeated_count, time, last_measured, longest_gap = 0, 0, 0.0, -np.inf, 0.0
    is_interlaced = changes_size = False
    upright_size = (0, 0)
    for number, start, frame in video.frames():
        longest_gap, time = max(longest_gap, start - time), start
        decoded_count = number + 1
        is_interlaced = is_interlaced or bool(frame.interlaced_frame)
        if time - last_measured < step * 0.98 and time > last_measured:
            continue
        last_measured = time
        if not thumbnails:
            upright_size = decode_upright(frame, video.aspect).size
        gray = decode_gray(frame, _SHARPNESS_SIDE_PIXELS)
        scale = TRACKING_SIDE_PIXELS / max(gray.shape)
        size = (max(8, round(gray.shape[1] * scale)), max(8, round(gray.shape[0] * scale)))
        thumbnail = np.asarray(Image.fromarray(gray).resize(size, Image.Resampling.BOX))
        if thumbnails and thumbnails[-1].shape != thumbnail.shape:
            changes_size = True
            break
        if thumbnails and np.abs(thumbnail.astype(np.int16) - thumbnails[-1]).mean() < _MAX_REPEAT_DIFFERENCE_LEVELS:
            repeated_count += 1
        else:
            sharpness.append(measure_sharpness(gray.astype(np.float32) / 255))
            thumbnails.append(thumbnail)
            numbers.append(number)
            times.append(time)
        length = f" of {video.seconds:.0f} s" if video.seconds else ""
        share = min(1.0, time / video.seconds) if video.seconds else 0.0
        progress(TaskEvent(f"measuring frame {decoded_count}, {time:.0f} s{length}", _MEASURED_PROGRESS * share))
    if decoded_count < _MIN_DECODED_FRAMES:
        problem, fix = f"the video has only {format_count(decoded_count, 'frame')}", "film for at least ten seconds"
        if video.damaged_count:
            problem, fix = f"{problem} that can be decoded", f"copy it again in full, or {fix}"
        raise HyrfDataError(f"{path}: {problem}", fix=fix)
    notes = []
    if changes_size:
        notes.append(f"the picture changes its size after {time:.0f} s; the frames after that are not used")
    # The last frame is shown for some time too, which is estimated by the longest time between two frames.
    if video.damaged_count or (not changes_size and time + longest_gap < _MIN_DURATION_RATIO * video.seconds):
        notes.append(
            f"the video is damaged or cut off: {decoded_count} frames of {time:.1f} s could be read, of "
            f"{video.seconds:.1f} s that it should have; copy it again if there is more"
        )
    if is_interlaced:
        notes.append("the video is interlaced, so moving edges look like combs; record progressive video (p, not i)")
    return _VideoMeasurement(
        np.array(numbers),
        np.array(times),
        np.array(sharpness),
        thumbnails,
        decoded_count,
        repeated_count,
        time,
        tuple(notes),
        upright_size,
    )


def _choose_spaced_frames(
    path: Path, measured: _VideoMeasurement, max_frames: int, progress: Progress
) -> tuple[dict[int, float], FrameReport]:
    """Return the frames to take, as number -> time in seconds, and the report about them."""
    blurred = mark_blurred(measured.sharpness)
    if blurred.all():
        raise HyrfDataError(
            f"{path}: all frames of the video are blurred",
            fix="film again, slower and with more light",
        )
    sharp_indices = np.flatnonzero(~blurred)
    thumbnails = [measured.thumbnails[index] for index in sharp_indices]
    trajectories = track_windows(thumbnails, part_of_progress(progress, _MEASURED_PROGRESS, _TRACKED_PROGRESS))
    picked = _pick_frames_in_limits(trajectories, measured.sharpness[sharp_indices], max_frames)
    if len(picked) < _MIN_TAKEN_FRAMES:
        raise HyrfDataError(
            f"{path}: the camera hardly moves, so that only {len(picked)} of {measured.decoded_count} frames can "
            f"serve as photos, but at least {_MIN_TAKEN_FRAMES} are needed",
            fix="walk around what you film",
        )
    spacings = [motion_distances(trajectories, a, slice(b, b + 1))[0] for a, b in zip(picked, picked[1:], strict=False)]
    median_spacing = float(np.median(spacings))
    notes = list(measured.notes)
    if median_spacing > _MAX_MATCHABLE_SPACING_RATIO:
        notes.append(
            f"the taken frames are {median_spacing:.0%} of the picture apart, so far that matching may fail; "
            "take more frames, film slower, or cut the video into pieces"
        )
    taken = sharp_indices[picked]
    seconds = [round(time, 3) for time in measured.times[taken].tolist()]
    return dict(zip(measured.numbers[taken].tolist(), seconds, strict=True)), FrameReport(
        taken=len(picked),
        of=measured.decoded_count,
        blurred=int(blurred.sum()),
        repeated=measured.repeated_count,
        seconds=round(measured.seconds, 3),
        spacing=round(median_spacing, 4),
        notes=tuple(notes),
    )


def _pick_frames_in_limits(trajectories: np.ndarray, sharpness: np.ndarray, max_frames: int) -> list[int]:
    """Pick frames at the default spacing, or at another one if these are too many or too few."""
    picked = _pick_sharpest_frames(trajectories, sharpness, _DEFAULT_SPACING_RATIO)
    min_frames = min(_TARGET_FRAMES, max_frames)
    if len(picked) > max_frames:
        max_spacing = 2.0 * len(sharpness) * _DEFAULT_SPACING_RATIO
        return _bisect_spacing(trajectories, sharpness, max_frames, _DEFAULT_SPACING_RATIO, max_spacing)
    if len(picked) < min_frames:
        closest = _pick_sharpest_frames(trajectories, sharpness, _MIN_SPACING_RATIO)
        if len(closest) <= min_frames:
            return closest
        return _bisect_spacing(trajectories, sharpness, min_frames, _MIN_SPACING_RATIO, _DEFAULT_SPACING_RATIO)
    return picked


def _bisect_spacing(
    trajectories: np.ndarray, sharpness: np.ndarray, max_frames: int, low: float, high: float
) -> list[int]:
    """Pick frames at the smallest spacing between `low` and `high` at which they are at most `max_frames`."""
    for _ in range(12):
        middle = (low * high) ** 0.5
        if len(_pick_sharpest_frames(trajectories, sharpness, middle)) > max_frames:
            low = middle
        else:
            high = middle
    return _pick_sharpest_frames(trajectories, sharpness, high)


def _pick_sharpest_frames(trajectories: np.ndarray, sharpness: np.ndarray, spacing: float) -> list[int]:
    """Pick the sharpest frame near the start, then repeatedly the sharpest one about `spacing` from the last pick.

    Args:
        trajectories: (N, windows, 2) displacements, from `track_windows`.
        sharpness: (N,) sharpness of each frame.
        spacing: wanted motion between two picks, as a ratio of the longer side.

    Returns:
        Indices of the picked frames, ascending.
    """
    picked: list[int] = []
    base, begin, low, high = 0, 0, 0.0, 0.5 * spacing
    while begin < len(sharpness):
        first = stop = None
        for start in range(begin, len(sharpness), 64):
            moved = motion_distances(trajectories, base, slice(start, start + 64))
            if first is None and (moved >= low).any():
                first = start + int((moved >= low).argmax())
            if first is not None:
                beyond = np.flatnonzero(moved[max(0, first - start) :] > high)
                if len(beyond):
                    stop = max(start, first) + int(beyond[0])
                    break
        if first is None:
            break
        stop = max(first + 1, len(sharpness) if stop is None else stop)
        base = first + int(sharpness[first:stop].argmax())
        picked.append(base)
        begin, low, high = base + 1, 0.75 * spacing, 1.25 * spacing
    return picked


def _write_frames(video: Video, folder: Path, numbers: list[int], progress: Progress) -> None:
    """Write the frames of these numbers that are not yet in the folder."""
    missing = {number for number in numbers if not (folder / _frame_name(number)).is_file()}
    if not missing:
        return
    count, last = len(missing), max(missing)
    for number, _, frame in video.frames():
        if number in missing:
            data = io.BytesIO()
            decode_upright(frame, video.aspect).save(data, "JPEG", quality=95, subsampling=0)
            write_atomic(folder / _frame_name(number), data.getvalue())
            missing.remove(number)
        task = f"writing frames {count - len(missing)}/{count}"
        share = min((number + 1) / (last + 1), 1.0)
        progress(TaskEvent(task, _TRACKED_PROGRESS + (1 - _TRACKED_PROGRESS) * share))
        if not missing:
            break


def frame_times(folder: Path) -> dict[str, float]:
    """Return the time in seconds from the start of the video of each frame that `choose_frames` wrote into a folder."""
    record = _read_record(folder)
    return {} if record is None else dict(record["times"])


def _frame_name(number: int) -> str:
    """Return the file name of the frame with this number in the video."""
    return f"frame_{number:06d}.jpg"


def _read_record(folder: Path) -> dict | None:
    """Return the record that an earlier call wrote beside its frames; None if there is none."""
    with suppress(OSError, ValueError, TypeError):
        record = json.loads((folder / RECORD_NAME).read_text())
        if isinstance(record, dict) and {"key", "frames", "times", "report"} <= record.keys():
            return record
    return None


def _remove_frames(folder: Path, record: dict | None) -> None:
    """Remove the frames that an earlier call with another video or other settings wrote."""
    for number in record["frames"] if record else ():
        (folder / _frame_name(number)).unlink(missing_ok=True)
