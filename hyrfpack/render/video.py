"""Pictures -> a video, through the ffmpeg program where there is one."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from hyrfpack.atomic import pending_file
from hyrfpack.errors import HyrfError

# Chroma is stored at half resolution, so both sides must be even; a black row or column is added when they are not.
_EVEN = "pad=ceil(iw/2)*2:ceil(ih/2)*2:0:0,format=yuv420p"


def has_ffmpeg() -> bool:
    """Whether the ffmpeg program is on the PATH."""
    return shutil.which("ffmpeg") is not None


def write_video(
    frames: Sequence[Path], path: str | os.PathLike[str], frames_per_second: int = 30, *, overwrite: bool = True
) -> Path:
    """Put PNG files together as an MP4, whole or not at all.

    Args:
        frames: pictures in order; those of another size than the first are scaled to it.
        path: the .mp4 to write, in a folder that exists.
        frames_per_second: how fast it plays.
        overwrite: replace a file at `path`; without it, the video gets a free name beside.

    Returns:
        The path that was written.

    Raises:
        HyrfError: there is no ffmpeg program, or it fails; its last line is in the message.
    """
    program = shutil.which("ffmpeg")
    if program is None:
        raise HyrfError(f"{path}: no video was made because there is no ffmpeg program; install ffmpeg and try again")
    command = [program, "-hide_banner", "-loglevel", "error", "-y", "-f", "image2pipe", "-c:v", "png"]
    command += ["-framerate", str(frames_per_second), "-i", "-", "-vf", _EVEN, "-movflags", "+faststart", "-f", "mp4"]
    with pending_file(path, overwrite=overwrite) as pending:
        with subprocess.Popen(
            [*command, str(pending.temporary)], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        ) as process:  # which waits for the program, also when a frame cannot be read
            assert process.stdin is not None  # a pipe was asked for
            try:
                for frame in frames:
                    process.stdin.write(frame.read_bytes())
            except BrokenPipeError:  # ffmpeg gave up; its message says why
                pass
            _, complaint = process.communicate()
        if process.returncode:
            lines = complaint.decode(errors="replace").strip().splitlines() or ["it gave no reason"]
            raise HyrfError(f"{path}: ffmpeg could not make the video ({lines[-1]}); the pictures are in place")
    return pending.path
