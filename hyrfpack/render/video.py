"""Encoding of images as a video by the ffmpeg program."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from hyrfpack.atomic import pending_file
from hyrfpack.errors import HyrfError

# Players read videos of 720 rows and more with the matrix of BT.709. Without it, ffmpeg would use that of BT.601.
_COLOR_FILTER = "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p"
_COLOR_TAGS = {"colorspace": "bt709", "color_primaries": "bt709", "color_trc": "iec61966-2-1", "color_range": "tv"}


def has_ffmpeg() -> bool:
    """Return whether the ffmpeg program is on the PATH."""
    return shutil.which("ffmpeg") is not None


def write_video(
    frames: Sequence[Path], path: str | os.PathLike[str], frames_per_second: int = 30, *, overwrite: bool = True
) -> Path:
    """Encode PNG files as an MP4 video, which is written completely or not at all.

    Args:
        frames: PNG files in order, at least one; those of another size than the first are fitted into its size, between
            black bars.
        path: the .mp4 file to write, in an existing folder.
        frames_per_second: frame rate of the video.
        overwrite: replace a file at `path`; without it, a free file name in the same folder is used.

    Returns:
        The path that was written.

    Raises:
        HyrfError: there is no frame or no ffmpeg program, or the program fails; the message contains its last line.
    """
    if not frames:
        raise HyrfError(f"{path}: there are no frames to make a video of", fix="render at least one")
    program = shutil.which("ffmpeg")
    if program is None:
        raise HyrfError(
            f"{path}: no video was made because there is no ffmpeg program",
            fix="install ffmpeg and try again",
        )
    command = [program, "-hide_banner", "-loglevel", "error", "-y", "-f", "image2pipe", "-c:v", "png"]
    command += [
        "-framerate",
        str(frames_per_second),
        "-i",
        "-",
        "-vf",
        f"{_fit_filter(frames[0])},{_COLOR_FILTER}",
        *(word for name, value in _COLOR_TAGS.items() for word in (f"-{name}", value)),
        "-movflags",
        "+faststart",
        "-f",
        "mp4",
    ]
    with pending_file(path, overwrite=overwrite) as pending:
        # Messages go to a file, because a pipe that nobody reads would block ffmpeg once it is full.
        with tempfile.TemporaryFile() as messages:
            with subprocess.Popen(
                [*command, str(pending.temporary)], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=messages
            ) as process:  # the context waits for the program, also if a frame cannot be read
                assert process.stdin is not None  # because stdin is a pipe
                try:
                    for frame in frames:
                        process.stdin.write(frame.read_bytes())
                except BrokenPipeError:  # ffmpeg has stopped; its message, read below, gives the reason
                    pass
                process.communicate()
            messages.seek(0)
            message = messages.read().decode(errors="replace")
        if process.returncode:
            lines = message.strip().splitlines() or ["it gave no reason"]
            raise HyrfError(
                f"{path}: ffmpeg could not make the video ({lines[-1]})",
                fix="use the pictures, which are written",
            )
    return pending.path


def _fit_filter(first: Path) -> str:
    """Return ffmpeg's filter that fits each frame into the size of the first.

    Both sides must be even, because chroma is stored at half resolution; a black row or column is added if needed.
    """
    try:
        with Image.open(first) as picture:
            width, height = picture.size
    except UnidentifiedImageError:
        return "null"  # ffmpeg says what is wrong with the file
    size = f"{width + width % 2}:{height + height % 2}"
    return f"scale={width}:{height}:force_original_aspect_ratio=decrease,pad={size}:(ow-iw)/2:(oh-ih)/2"
