"""Distillation: a file of 3D Gaussians becomes a hybrid model, taught by the file's own pictures."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from hyrfpack import format as hyrf_format
from hyrfpack.atomic import write_atomic
from hyrfpack.checks import check_type
from hyrfpack.device import choose_device
from hyrfpack.distill.config import DistillConfig
from hyrfpack.distill.pack import pack
from hyrfpack.distill.teach import teach
from hyrfpack.outputs import Outputs
from hyrfpack.progress import Report, no_report, report_part
from hyrfpack.scene import Camera
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.names import bytes_on_disk
from hyrfpack.splats.splats import Splats


@dataclass(frozen=True)
class DistillReport:
    """What a distillation came to.

    Attributes:
        gaussians_before, gaussians_after: of the original and of the file.
        degree: of the original's spherical harmonics.
        views: held-out viewpoints that the scores are of.
        psnr: dB, mean over these views, of the decoded file's pictures against the original's, over black.
        psnr_worst: of the view with the least.
        psnr_unpacked: mean, of the model before it was packed.
        psnr_asked: of `DistillConfig`.
        bytes_source: of the original as it was given; None when it was no file.
        bytes_ply: of the original as PLY in INRIA's layout, without the header: 4 (17 + 3 (K - 1)) for each Gaussian.
        bytes_after: of the `.hyrf` file.
        seconds: that it took.
        file: the path that was written.
    """

    gaussians_before: int
    gaussians_after: int
    degree: int
    views: int
    psnr: float
    psnr_worst: float
    psnr_unpacked: float
    psnr_asked: float
    bytes_source: int | None
    bytes_ply: int
    bytes_after: int
    seconds: float
    file: str

    def to_dict(self) -> dict:
        """Plain numbers, ready for JSON."""
        return asdict(self)


def distill(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    config: DistillConfig = DistillConfig(),  # noqa: B008 - frozen
    *,
    cameras: Sequence[Camera] | None = None,
    overwrite: bool = True,
    device: str | torch.device = "auto",
    say: Callable[[str], None] = lambda sentence: None,
    report: Report = no_report,
) -> DistillReport:
    """Make a `.hyrf` file from a file of 3D Gaussians; see `distill_splats`, and `read_splats` for what is read.

    Raises:
        HyrfDataError: the source cannot be read, or there is nothing to be seen in it.
        HyrfError: the target cannot be written.
        TypeError: the settings or a camera are something else.

    Example:
        >>> import hyrfpack
        >>> quick = hyrfpack.DistillConfig(steps=4, psnr=15, size=32, train_views=6, test_views=2)
        >>> report = hyrfpack.distill("bonsai.ply", "again.hyrf", quick)
        >>> report.bytes_after < report.bytes_source
        True
    """
    check_type("config", config, DistillConfig)
    for camera in cameras or ():
        check_type("each of the cameras", camera, Camera)
    Outputs(source, overwrite=overwrite).file(target)
    splats = read_splats(source)
    result = distill_splats(
        splats, target, config, name=str(source), cameras=cameras, overwrite=overwrite, device=device, say=say,
        report=report,
    )  # fmt: skip
    return dataclasses.replace(result, bytes_source=bytes_on_disk(source))


def distill_splats(
    splats: Splats,
    target: str | os.PathLike[str],
    config: DistillConfig = DistillConfig(),  # noqa: B008 - frozen
    *,
    name: str = "the splats",
    cameras: Sequence[Camera] | None = None,
    overwrite: bool = True,
    device: str | torch.device = "auto",
    say: Callable[[str], None] = lambda sentence: None,
    report: Report = no_report,
) -> DistillReport:
    """Turn splats into a hybrid model that looks like them, and pack it (profile compact).

    Without cameras viewpoints are made up (`sample_viewpoints`). The faintest Gaussians, as seen from there, are left
    out; the fields are fitted to the others' shapes and colours (`initial_model`), the whole is fitted to pictures of
    the original. Same splats and settings, same bytes, on the CPU: on a GPU sums of gradients vary in their last bits.

    Args:
        splats: in any units, anywhere.
        target: the `.hyrf` file.
        name: what messages call the splats.
        cameras: that pictures shall hold at, made smaller where larger than `config.size`; one in TEST_EVERY is held
            out.
        overwrite: replace a file at `target`. Without it, one that is there is an error, and one that appears in the
            meantime is kept: the result gets a free name beside it, which the report names.
        device: where pictures are drawn and the model learns, see `hyrfpack.device.choose_device`.
        say: told what is going on.
        report: called with what is being done and the share of the work that is done, 0 to 1.

    Raises:
        HyrfDataError: no view shows any of the splats.
        HyrfError: the file cannot be written, or there is no such device.
    """
    started = time.perf_counter()
    Outputs(overwrite=overwrite).file(target)
    place = choose_device(device, say)
    taught = teach(
        splats, config, name=name, cameras=cameras, device=place, say=say, report=report_part(report, 0.0, 0.7)
    )
    unpacked = float(np.mean(taught.test.likeness(taught.model)))
    say(f"{unpacked:.2f} dB before packing")
    imported = f"{len(splats):,} Gaussians of degree {splats.degree} from {Path(name).name}, without photos"
    provenance = {"steps": config.steps, "seed": config.seed, "psnr": unpacked, "choices": {"imported": imported}}
    data = pack(taught, config.psnr, provenance, say, report_part(report, 0.7, 0.97))
    written = write_atomic(target, data, overwrite=overwrite)  # only now: an interrupt leaves what was there before
    report("scoring the file", 0.97)
    decoded = hyrf_format.load(written).to(place)
    decoded.precision = taught.model.precision
    scores = taught.test.likeness(decoded)
    reached = float(np.mean(scores))
    if _below(reached, config.psnr):
        say(_shortfall(reached, unpacked, config, made_up=cameras is None))
    return DistillReport(
        gaussians_before=len(splats),
        gaussians_after=len(decoded),
        degree=splats.degree,
        views=len(scores),
        psnr=reached,
        psnr_worst=min(scores),
        psnr_unpacked=unpacked,
        psnr_asked=config.psnr,
        bytes_source=None,
        bytes_ply=4 * len(splats) * (17 + 3 * (splats.harmonics.shape[1] - 1)),
        bytes_after=len(data),
        seconds=time.perf_counter() - started,
        file=str(written),
    )


def _below(reached: float, asked: float) -> bool:
    """Whether a PSNR is less than was asked for, as it is told."""
    return round(reached, 1) < asked


def _shortfall(reached: float, unpacked: float, config: DistillConfig, *, made_up: bool) -> str:
    """What to do about a file that is less like the original than was asked for."""
    told = (
        f"asked for {config.psnr:g} dB and reached {reached:.1f} at held-out viewpoints, {unpacked:.1f} before packing"
    )
    if not _below(unpacked, config.psnr):
        return f"{told}: ask for more than you need with `psnr`"
    where = ", or name with `cameras` from where it will be looked at" if made_up else ""
    return f"{told}: learn longer, as with `steps={max(DistillConfig.steps, 2 * config.steps)}`{where}"
