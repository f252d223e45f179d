"""Which frames of a video become photos: sharp ones, spread by how far the picture moves."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.atomic import make_folder, write_atomic
from hyrfpack.data.quality import is_blurred, measure_sharpness
from hyrfpack.errors import HyrfDataError
from hyrfpack.outputs import StrPath
from hyrfpack.poses.motion import WIDE, distances, track
from hyrfpack.poses.video import Video, gray_picture, is_video, opened, upright_picture

__all__ = ["FrameReport", "choose_frames", "is_video", "survey_frames"]

Report = Callable[[str, float], None]

RECORD = "frames.json"  # beside the frames: of which video they are, and that they are all there

_SPACING = 0.05  # of the longer side that the picture moves between chosen frames, where there are neither
_CLOSEST = 0.01  # too few of them nor too many; never less than this
_ENOUGH = 60  # frames, for which slow videos are taken closer
_WIDE_APART = 0.15  # where matching begins to fail
_LEAST_DECODED, _LEAST_TAKEN = 10, 5  # frames
_SHARPNESS_AT = 640  # pixels of the longer side
_MEASURED_RATE, _MEASURED = 30.5, 6000  # frames a second and in all: more are as one sees them no better
_SAME = 0.4  # mean difference in levels of 255: a repeated frame, whatever the coder made of it
_LOOKING_SHARE, _TRACKING_SHARE = 0.6, 0.7  # of the work, that is done once all frames were looked at, and followed
_WHOLE = 0.95  # of the length that the header says


@dataclass(frozen=True)
class FrameReport:
    """What was taken of a video.

    Attributes:
        taken: frames written.
        of: frames that could be decoded.
        blurred, repeated: how many of those looked at are blurred beside the others, and the same as the one before.
        seconds: of video.
        spacing: how far the picture moves from one taken frame to the next, the median in shares of the longer side.
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
class _Measured:
    """What one pass over a video says of the frames looked at that are no repetitions, and of all."""

    numbers: np.ndarray  # (N,) places in the video
    times: np.ndarray  # (N,) seconds from its start
    sharp: np.ndarray  # (N,)
    small: list[np.ndarray]  # N of (h, w) uint8
    of: int
    repeated: int
    seconds: float
    notes: tuple[str, ...]


def choose_frames(video: StrPath, folder: StrPath, *, most: int = 150, report: Report | None = None) -> FrameReport:
    """Write the frames of a video that serve as photos.

    All frames are decoded once to measure how sharp they are and how the picture moves, and those chosen once more at
    full size. Frames that are blurred beside their neighbours are never taken, nor are repeated ones. Between two
    taken frames the picture moves by about 5 % of its longer side, less in slow videos and more in long ones, and of
    those around that place the sharpest is taken.

    The frames are upright JPEG files, "frame_000123.jpg" by their place in the video, with "frames.json" beside them.
    Where a folder has the frames of this very video, nothing is done; an interrupted call goes on when it is repeated.

    Args:
        video: a file that FFmpeg knows. High dynamic range is brought to the ordinary one.
        folder: to write to; made if missing. Of what lies in it, only frames of an earlier call are removed.
        most: frames to take.
        report: called with what is going on and the share of the work that is done, in [0, 1].

    Raises:
        HyrfDataError: the file is missing or no video, or too few of its frames can be decoded, are sharp, or differ.
        HyrfError: PyAV is not installed, or the frames cannot be written.
        ValueError: `most` is below 5.

    Example:
        >>> from hyrfpack.poses.frames import choose_frames
        >>> report = choose_frames("clip.mp4", "scene/images")  # doctest: +SKIP
        >>> f"{report.taken} of {report.of} frames"  # doctest: +SKIP
        '112 of 1843 frames'
    """
    if most < _LEAST_TAKEN:
        raise ValueError(f"most must be {_LEAST_TAKEN} or more, not {most}")
    video, folder = Path(video), Path(folder)
    tell = report or (lambda text, share: None)
    with opened(video) as source:
        key = {"video": video.name, "bytes": video.stat().st_size, "modified": video.stat().st_mtime_ns, "most": most}
        record = _read_record(folder)
        if record is None or record["key"] != key:
            measured = _measure(video, source, tell)
            chosen, found = _choose(video, measured, most, tell)
            _remove_frames(folder, record)
            make_folder(folder)
            times = {_name(number): seconds for number, seconds in chosen.items()}
            record = {"key": key, "frames": list(chosen), "times": times, "report": asdict(found)}
            write_atomic(folder / RECORD, json.dumps(record).encode())
        _write_frames(source, folder, record["frames"], tell)
    tell("frames written", 1.0)
    return FrameReport(**{**record["report"], "notes": tuple(record["report"]["notes"])})


def survey_frames(
    video: StrPath, *, most: int = 150, report: Report | None = None
) -> tuple[FrameReport, tuple[int, int], int]:
    """What `choose_frames` would take of a video; nothing is written.

    Args:
        video, most, report: as of `choose_frames`.

    Returns:
        The report, (width, height) of the frames as they are stored, and how many of them were looked at.

    Raises:
        HyrfDataError: as `choose_frames`.

    Example:
        >>> report, size, looked_at = survey_frames("clip.mp4")  # doctest: +SKIP
    """
    video = Path(video)
    with opened(video) as source:
        tell = report or (lambda text, share: None)
        measured = _measure(video, source, tell)
        return _choose(video, measured, most, tell)[1], source.size, len(measured.numbers) + measured.repeated


def _measure(path: Path, video: Video, tell: Report) -> _Measured:
    step = max(1 / _MEASURED_RATE, video.seconds / _MEASURED)
    numbers: list[int] = []
    times: list[float] = []
    sharp: list[float] = []
    small: list[np.ndarray] = []
    notes: list[str] = []
    of, repeated, time, interlaced, last = 0, 0, 0.0, False, -np.inf
    for number, time, frame in video.frames():
        of = number + 1
        interlaced = interlaced or bool(frame.interlaced_frame)
        if time - last < step * 0.98 and time > last:
            continue
        last = time
        gray = gray_picture(frame, _SHARPNESS_AT)
        scale = WIDE / max(gray.shape)
        size = (max(8, round(gray.shape[1] * scale)), max(8, round(gray.shape[0] * scale)))
        thumbnail = np.asarray(Image.fromarray(gray).resize(size, Image.Resampling.BOX))
        if small and small[-1].shape != thumbnail.shape:
            notes.append(f"the picture changes its size after {time:.0f} s; what follows was not used")
            break
        if small and np.abs(thumbnail.astype(np.int16) - small[-1]).mean() < _SAME:
            repeated += 1
        else:
            sharp.append(measure_sharpness(gray.astype(np.float32) / 255))
            small.append(thumbnail)
            numbers.append(number)
            times.append(time)
        length = f" of {video.seconds:.0f} s" if video.seconds else ""
        share = min(1.0, time / video.seconds) if video.seconds else 0.0
        tell(f"looking at frame {of:,}, {time:.0f} s{length}", _LOOKING_SHARE * share)
    if of < _LEAST_DECODED:
        cut = " that can be decoded; copy it again in full, or film" if video.damaged else "; film"
        raise HyrfDataError(f"{path}: the video has only {of} frames{cut} for at least ten seconds")
    if video.damaged or time < _WHOLE * video.seconds:
        notes.append(
            f"the video is damaged or cut off: {of} frames of {time:.1f} s could be read, of {video.seconds:.1f} s "
            "that it should have; copy it again if there is more"
        )
    if interlaced:
        notes.append("the video is interlaced, which combs what moves; film progressively (p, not i) if you can")
    return _Measured(np.array(numbers), np.array(times), np.array(sharp), small, of, repeated, time, tuple(notes))


def _choose(path: Path, measured: _Measured, most: int, tell: Report) -> tuple[dict[int, float], FrameReport]:
    """Number and time of each frame to take, and what there is to say about them."""
    blurred = is_blurred(measured.sharp)
    if blurred.all():
        raise HyrfDataError(f"{path}: all frames of the video are blurred; film again, slower and with more light")
    sharp = np.flatnonzero(~blurred)

    def progress(done: int) -> None:
        share = _LOOKING_SHARE + (_TRACKING_SHARE - _LOOKING_SHARE) * done / len(sharp)
        tell(f"following the motion, frame {done:,} of {len(sharp):,}", share)

    places = track([measured.small[place] for place in sharp], progress)
    values = measured.sharp[sharp]
    spacing = _SPACING
    picked = _spread(places, values, spacing)
    wanted = min(_ENOUGH, most)
    if len(picked) > most:
        spacing, picked = _bisect(places, values, most, spacing, 2.0 * len(sharp) * spacing)
    elif len(picked) < wanted:
        closest = _spread(places, values, _CLOSEST)
        spacing, picked = (
            (_CLOSEST, closest) if len(closest) <= wanted else _bisect(places, values, wanted, _CLOSEST, spacing)
        )
    if len(picked) < _LEAST_TAKEN:
        raise HyrfDataError(
            f"{path}: the camera hardly moves, so that {len(picked)} of {measured.of} frames can serve as photos, and "
            f"{_LEAST_TAKEN} is the least; walk around what you film"
        )
    steps = np.array([distances(places, a, slice(b, b + 1))[0] for a, b in zip(picked, picked[1:], strict=False)])
    notes = list(measured.notes)
    if np.median(steps) > _WIDE_APART:
        notes.append(
            f"the taken frames are {np.median(steps):.0%} of the picture apart, so far that matching may fail; "
            "take more frames, film slower, or cut the video into pieces"
        )
    taken = sharp[picked]
    seconds = [round(time, 3) for time in measured.times[taken].tolist()]
    return dict(zip(measured.numbers[taken].tolist(), seconds, strict=True)), FrameReport(
        taken=len(picked),
        of=measured.of,
        blurred=int(blurred.sum()),
        repeated=measured.repeated,
        seconds=round(measured.seconds, 3),
        spacing=round(float(np.median(steps)), 4),
        notes=tuple(notes),
    )


def _bisect(places: np.ndarray, sharp: np.ndarray, most: int, low: float, high: float) -> tuple[float, list[int]]:
    """The least spacing between two that takes at most so many frames, and these."""
    for _ in range(12):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if len(_spread(places, sharp, middle)) > most else (low, middle)
    return high, _spread(places, sharp, high)


def _spread(places: np.ndarray, sharp: np.ndarray, spacing: float) -> list[int]:
    """Take the sharpest frame of the start, and then again and again the sharpest around the place that is `spacing`
    from the last one taken."""
    picked: list[int] = []
    base, begin, low, high = 0, 0, 0.0, 0.5 * spacing
    while begin < len(sharp):
        first = stop = None
        for start in range(begin, len(sharp), 64):
            moved = distances(places, base, slice(start, start + 64))
            if first is None and (moved >= low).any():
                first = start + int((moved >= low).argmax())
            if first is not None:
                beyond = np.flatnonzero(moved[max(0, first - start) :] > high)
                if len(beyond):
                    stop = max(start, first) + int(beyond[0])
                    break
        if first is None:
            break
        stop = max(first + 1, len(sharp) if stop is None else stop)
        base = first + int(sharp[first:stop].argmax())
        picked.append(base)
        begin, low, high = base + 1, 0.75 * spacing, 1.25 * spacing
    return picked


def _write_frames(video: Video, folder: Path, numbers: list[int], tell: Report) -> None:
    missing = {number for number in numbers if not (folder / _name(number)).is_file()}
    if not missing:
        return
    left = len(missing)
    last = max(missing)
    for number, _, frame in video.frames():
        if number in missing:
            data = io.BytesIO()
            upright_picture(frame, video.aspect).save(data, "JPEG", quality=95, subsampling=0)
            write_atomic(folder / _name(number), data.getvalue())
            missing.remove(number)
        written = f"writing frames, {left - len(missing):,} of {left:,}"
        tell(written, _TRACKING_SHARE + (1 - _TRACKING_SHARE) * min((number + 1) / (last + 1), 1.0))
        if not missing:
            break


def frame_times(folder: Path) -> dict[str, float]:
    """The time in seconds, from the start of the video, of each frame that `choose_frames` wrote into a folder."""
    record = _read_record(folder)
    return {} if record is None else dict(record["times"])


def _name(number: int) -> str:
    return f"frame_{number:06d}.jpg"


def _read_record(folder: Path) -> dict | None:
    """What an earlier call wrote beside its frames, if any."""
    with suppress(OSError, ValueError, TypeError):
        record = json.loads((folder / RECORD).read_text())
        if isinstance(record, dict) and {"key", "frames", "times", "report"} <= record.keys():
            return record
    return None


def _remove_frames(folder: Path, record: dict | None) -> None:
    """Remove the frames of an earlier call with another video or other settings."""
    for number in record["frames"] if record else ():
        (folder / _name(number)).unlink(missing_ok=True)
