"""Read videos with PyAV: iterate over the frames, and convert a frame to the picture that a player shows."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.poses.hdr import HLG_TRANSFER, PQ_TRANSFER, tone_map_to_srgb

if TYPE_CHECKING:
    from PIL.Image import Image

_MIN_REC709_LINES = 720  # videos without a colour tag are read as Rec. 709 from this height on, as players do
MAX_PIXEL_ASPECT = 4
# Numbers of colour matrices in ITU-T H.273.
_H273_UNSPECIFIED = 2
_H273_REC709 = 1


class Video:
    """An open video file.

    Attributes:
        seconds: duration according to the header; 0 if the header has none.
        aspect: pixel aspect ratio, the width of a pixel divided by its height; 1 where the header has a ratio beyond
            MAX_PIXEL_ASPECT, which is damaged.
        damaged_count: number of packets and frames that could not be decoded so far.
    """

    def __init__(self, path: Path, container: Any) -> None:
        self._path, self._container, self._stream = path, container, container.streams.video[0]
        self._is_at_start = True
        self.damaged_count = 0
        aspect = float(self._stream.sample_aspect_ratio or 1)
        self.aspect = aspect if 1 / MAX_PIXEL_ASPECT <= aspect <= MAX_PIXEL_ASPECT else 1.0
        duration, unit = self._stream.duration, self._stream.time_base
        self.seconds = float(duration * unit) if duration and unit else (container.duration or 0) / 1e6

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def frames(self) -> Iterator[tuple[int, float, Any]]:
        """Yield the number, the time in seconds and the av.VideoFrame of each decodable frame, in display order.

        Damaged packets and frames are skipped and counted. A frame has the same number each time the file is read.
        """
        import av

        if not self._is_at_start:  # Raw streams cannot be rewound, so the file is opened again.
            self.close()
            self._container = _open_container(self._path)
            self._stream = self._container.streams.video[0]
        self._is_at_start = False
        self._stream.thread_type = "AUTO"
        first_time, number, last_time = None, 0, 0.0
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:
                self.damaged_count += 1
                return
            if packet is None:
                return
            try:
                frames = packet.decode()
            except av.error.FFmpegError:
                self.damaged_count += 1
                continue
            for frame in frames:
                if getattr(frame, "is_corrupt", False):
                    self.damaged_count += 1
                    continue
                time = last_time if frame.time is None else float(frame.time)
                first_time = time if first_time is None else first_time
                last_time = time
                yield number, time - first_time, frame
                number += 1


@contextmanager
def open_video(path: Path) -> Iterator[Video]:
    """Open a video file and close it at the end of the block.

    Raises:
        HyrfDataError: the file is missing, unreadable, cut off before its table of contents, or has no video stream.
        HyrfError: PyAV is not installed.
    """
    with needs_package(f"{path}: reading videos"):
        import av  # noqa: F401 - `_open_container` imports it
    if not path.is_file():
        what = "this is a folder, not a video" if path.is_dir() else "there is no such file"
        raise HyrfDataError(f"{path}: {what}", fix="check the path")
    if path.stat().st_size == 0:
        raise HyrfDataError(f"{path}: the video is empty (0 bytes)", fix="copy it again")
    container = _open_container(path)
    video = None
    try:
        if not container.streams.video:
            raise HyrfDataError(f"{path}: the file has no video stream", fix="name a video")
        if container.streams.video[0].codec_context is None:
            raise HyrfDataError(
                f"{path}: the installed FFmpeg cannot decode this kind of video", fix="save it as H.264 (.mp4)"
            )
        video = Video(path, container)
        yield video
    finally:
        (video or container).close()


def _open_container(path: Path) -> Any:
    """Open a file with PyAV, which must be installed.

    Raises:
        HyrfDataError: FFmpeg cannot read it.
    """
    import av

    try:
        return av.open(os.path.abspath(path))  # FFmpeg takes what precedes a colon in a relative path for a protocol
    except Exception as error:  # PyAV passes on many types of errors, of FFmpeg's demuxers and of the system
        raise HyrfDataError(
            f"{path}: this cannot be read as a video ({_error_text(error)})",
            fix="copy it again in full" + ("" if path.suffix.lower() == ".mp4" else ", or save it as .mp4"),
        ) from error


def decode_gray(frame: Any, max_side: int) -> np.ndarray:
    """Return the luma of a frame as stored, shrunk to at most `max_side` pixels on the longer side: (H, W) uint8."""
    scale = min(1.0, max_side / max(frame.width, frame.height))
    width, height = (max(2, round(side * scale)) for side in (frame.width, frame.height))
    return frame.reformat(width=width, height=height, format="gray", interpolation="AREA").to_ndarray()


def decode_upright(frame: Any, aspect: float) -> Image:
    """Return a frame as players show it: upright, with square pixels, and tone mapped if it has high dynamic range."""
    from PIL import Image

    color_matrix = _H273_REC709 if frame.colorspace == _H273_UNSPECIFIED and frame.height >= _MIN_REC709_LINES else None
    if frame.color_trc in (PQ_TRANSFER, HLG_TRANSFER):
        signal = frame.reformat(format="rgb48le", src_colorspace=color_matrix).to_ndarray()
        picture = Image.fromarray(tone_map_to_srgb(signal, frame.color_trc))
    else:
        picture = Image.fromarray(frame.reformat(format="rgb24", src_colorspace=color_matrix).to_ndarray())
    if abs(aspect - 1) > 0.01:
        picture = picture.resize((round(picture.width * aspect), picture.height), Image.Resampling.LANCZOS)
    return _apply_display_matrix(picture, frame)


def _apply_display_matrix(picture: Image, frame: Any) -> Image:
    """Rotate a picture by quarter turns and mirror it, as the display matrix of its frame says.

    The matrix [[a, b, u], [c, d, v], [x, y, w]] moves a pixel at (p, q) to (a p + c q + x, b p + d q + y).
    """
    from PIL import Image

    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return picture
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    if abs(c) > abs(a):
        picture, a, d = picture.transpose(Image.Transpose.TRANSPOSE), c, b
    if a < 0:
        picture = picture.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    return picture.transpose(Image.Transpose.FLIP_TOP_BOTTOM) if d < 0 else picture


def _error_text(error: Exception) -> str:
    """Return the first line of an error's message, shortened, or its type if it has none."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return text.splitlines()[0][:120]
