"""Reading videos with PyAV: which frames there are, and a frame as the picture that a player shows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.outputs import VIDEO_SUFFIXES, StrPath
from hyrfpack.poses.hdr import HLG, PQ, standard_range

if TYPE_CHECKING:
    from PIL.Image import Image

_HD = 720  # lines; untagged videos of so many and more are Rec. 709 in colour, others Rec. 601
_UNSPECIFIED, _REC709 = 2, 1  # ITU-T H.273, of matrix coefficients


def is_video(path: StrPath) -> bool:
    """Whether a file is called like a video (.mp4, .mov, .mkv, .webm and so on, in any case).

    Example:
        >>> is_video("clip.MOV"), is_video("photo.jpg")
        (True, False)
    """
    return str(path).lower().endswith(VIDEO_SUFFIXES)


class Video:
    """An open video: its length and its frames.

    Attributes:
        seconds: that its header says it takes, 0 where it does not say.
        size: (width, height) in pixels of the frames as they are stored.
        aspect: width of a pixel over its height.
        damaged: packets and frames that could not be decoded so far.
    """

    def __init__(self, container: Any) -> None:
        self._container, self._stream = container, container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self.damaged = 0
        self.size = (self._stream.codec_context.width, self._stream.codec_context.height)
        self.aspect = float(self._stream.sample_aspect_ratio or 1) or 1.0
        length, unit = self._stream.duration, self._stream.time_base
        self.seconds = float(length * unit) if length and unit else (container.duration or 0) / 1e6

    def frames(self) -> Iterator[tuple[int, float, Any]]:
        """Number, time in seconds and av.VideoFrame of every frame that can be decoded, in the order of showing.

        What is damaged is skipped and counted. The numbers are the same each time that a file is read.
        """
        import av

        self._container.seek(0)
        start, number, last = None, 0, 0.0
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:
                self.damaged += 1
                return
            if packet is None:
                return
            try:
                frames = packet.decode()
            except av.error.FFmpegError:
                self.damaged += 1
                continue
            for frame in frames:
                if getattr(frame, "is_corrupt", False):
                    self.damaged += 1
                    continue
                time = last if frame.time is None else float(frame.time)
                start = time if start is None else start
                last = time
                yield number, time - start, frame
                number += 1


@contextmanager
def opened(path: Path) -> Iterator[Video]:
    """Open a video.

    Raises:
        HyrfDataError: it is missing, unreadable, cut off before its table of contents, or has no pictures.
        HyrfError: PyAV is not installed.
    """
    with needs_package("av", f"{path}: reading videos"):
        import av
    if not path.is_file():
        what = "this is a folder, not a video" if path.is_dir() else "there is no such file"
        raise HyrfDataError(f"{path}: {what}; check the path")
    if path.stat().st_size == 0:
        raise HyrfDataError(f"{path}: the video is empty (0 bytes); copy it again")
    try:
        container = av.open(str(path))
    except Exception as error:  # PyAV raises whatever FFmpeg's demuxers report, and what the system says
        raise HyrfDataError(
            f"{path}: this cannot be read as a video ({_reason(error)}); copy it again in full, or save it as .mp4"
        ) from error
    try:
        if not container.streams.video:
            raise HyrfDataError(f"{path}: there are no pictures in this file, sound at most; name a video")
        yield Video(container)
    finally:
        container.close()


def gray_picture(frame: Any, longer: int) -> np.ndarray:
    """A frame as luma, shrunk to at most `longer` pixels on the longer side, as it is stored: (H, W) uint8."""
    scale = min(1.0, longer / max(frame.width, frame.height))
    width, height = (max(2, round(side * scale)) for side in (frame.width, frame.height))
    return frame.reformat(width=width, height=height, format="gray", interpolation="AREA").to_ndarray()


def upright_picture(frame: Any, aspect: float) -> Image:
    """A frame as players show it: upright, with square pixels, high dynamic range brought to the ordinary one."""
    from PIL import Image

    colors = _REC709 if frame.colorspace == _UNSPECIFIED and frame.height >= _HD else None
    if frame.color_trc in (PQ, HLG):
        wide = frame.reformat(format="rgb48le", src_colorspace=colors).to_ndarray()
        picture = Image.fromarray(standard_range(wide, frame.color_trc))
    else:
        picture = Image.fromarray(frame.reformat(format="rgb24", src_colorspace=colors).to_ndarray())
    if abs(aspect - 1) > 0.01:
        picture = picture.resize((round(picture.width * aspect), picture.height), Image.Resampling.LANCZOS)
    turn = round(frame.rotation / 90) % 4  # counter-clockwise
    if turn:
        kinds = Image.Transpose.ROTATE_90, Image.Transpose.ROTATE_180, Image.Transpose.ROTATE_270
        picture = picture.transpose(kinds[turn - 1])
    return picture


def _reason(error: Exception) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return text.splitlines()[0][:120]
