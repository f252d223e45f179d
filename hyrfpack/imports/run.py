"""Make a `.hyrf` file from a file of 3D Gaussians, or from splats in memory."""

from __future__ import annotations

import dataclasses
import logging
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.checks import check_type
from hyrfpack.config.imports import MAX_IMPORT_PSNR_DB, ImportConfig
from hyrfpack.context import RunContext
from hyrfpack.counts import format_count
from hyrfpack.format.codec import decode_model
from hyrfpack.format.container import read_container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.format.rewrite import with_metadata
from hyrfpack.format.sections import SECTION_CONTENTS
from hyrfpack.imports.pack import pack
from hyrfpack.imports.prepare import prepare_model
from hyrfpack.model import ModelConfig
from hyrfpack.out_of_memory import explain_out_of_memory
from hyrfpack.outputs import Outputs, StrPath
from hyrfpack.progress import TaskEvent, part_of_progress
from hyrfpack.scene import Camera, Scene
from hyrfpack.splats.files import bytes_on_disk, read_splats
from hyrfpack.splats.names import find_sog_folder
from hyrfpack.splats.splats import Splats

_LOG = logging.getLogger(__name__)

OUT_OF_MEMORY_FIX = "reduce `size`"


@dataclass(frozen=True)
class ImportReport:
    """The result of an import.

    Attributes:
        gaussians_before, gaussians_after: number of Gaussians of the original and of the file.
        degree: degree of the original's spherical harmonics.
        views: number of held-out viewpoints that were scored.
        psnr: mean PSNR over these views of the decoded file's renders against the original's, over black; dB.
        psnr_worst: PSNR of the worst view; dB.
        psnr_unpacked: mean PSNR of the model before compression; dB.
        psnr_asked: the target PSNR of `ImportConfig`; None with a target size.
        bytes_source: size of the original file; None if the splats did not come from a file.
        bytes_ply: size of the original as PLY in INRIA's layout, without the header: 4 (17 + 3 (K - 1)) bytes for each
            Gaussian with K harmonics.
        bytes_after: size of the `.hyrf` file.
        seconds: duration of the import.
        file: the path that was written.
    """

    gaussians_before: int
    gaussians_after: int
    degree: int
    views: int
    psnr: float
    psnr_worst: float
    psnr_unpacked: float
    psnr_asked: float | None
    bytes_source: int | None
    bytes_ply: int
    bytes_after: int
    seconds: float
    file: str

    def to_dict(self) -> dict:
        """Return the attributes as a dictionary ready for JSON."""
        return asdict(self)


@explain_out_of_memory(OUT_OF_MEMORY_FIX)
def import_splats(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    config: ImportConfig = ImportConfig(),  # noqa: B008 - frozen
    *,
    cameras: Sequence[Camera] | None = None,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> ImportReport:
    """Make a `.hyrf` file from a file of 3D Gaussians.

    The arguments are those of `import_loaded_splats`; `read_splats` describes which files can be read.

    Raises:
        HyrfDataError: the source cannot be read, the viewpoints show none of its Gaussians, or given ones show less
            than 1 %.
        HyrfSizeError: no file of this scene is as small as `config.target_bytes`.
        HyrfError: no file at all is that small, or the target cannot be written.
        TypeError: the settings or a camera have the wrong type.

    Example:
        >>> import hyrfpack
        >>> quick = hyrfpack.ImportConfig(psnr=15, size=32, views=6, test_views=2)
        >>> report = hyrfpack.import_splats("bonsai.ply", "again.hyrf", quick)
        >>> report.bytes_after < report.bytes_source
        True
    """
    check_type("config", config, ImportConfig)
    for camera in cameras or ():
        check_type("each of the cameras", camera, Camera)
    check_target(source, target, overwrite=overwrite)
    splats = read_splats(source)
    result = import_loaded_splats(
        splats, target, config, name=str(source), cameras=cameras, overwrite=overwrite, context=context
    )
    return dataclasses.replace(result, bytes_source=bytes_on_disk(source))


def check_target(
    source: StrPath | None,
    target: StrPath,
    cameras: StrPath | None = None,
    *,
    scene: Scene | None = None,
    overwrite: bool,
) -> None:
    """Check that an import may write `target`. Raises HyrfError otherwise.

    Args:
        source: the file or the folder of splats that is read; None for splats in memory.
        target: the file to write.
        cameras: a file of cameras that is read.
        scene: photos and poses whose cameras are read.
        overwrite: an existing file may be replaced, except those that are read.
    """
    folder = None if source is None else find_sog_folder(source)
    Outputs(source, cameras, folders=[folder], scene=scene, overwrite=overwrite).file(target, ".hyrf")


@explain_out_of_memory(OUT_OF_MEMORY_FIX)
def import_loaded_splats(
    splats: Splats,
    target: str | os.PathLike[str],
    config: ImportConfig = ImportConfig(),  # noqa: B008 - frozen
    *,
    name: str = "the splats",
    cameras: Sequence[Camera] | None = None,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> ImportReport:
    """Make a model that equals splats, and compress it with profile "compact".

    Without cameras, viewpoints are sampled (`sample_viewpoints`). The Gaussians that contribute least to the renders
    from there are left out. The fields are zero, and residuals hold the shapes and colours of the others
    (`exact_model`). On the CPU the same splats and settings give the same bytes; on a GPU sums of gradients vary in
    their last bits. If the packed file cannot be scored, as when memory runs out, it is written without scores.

    Args:
        splats: the splats, in any units and at any place.
        target: the `.hyrf` file to write.
        name: name of the splats in messages.
        cameras: viewpoints at which the model must match the splats, shrunk if larger than `config.size`; one in
            TEST_EVERY is held out.
        overwrite: replace a file at `target`. If False, an existing file is an error. A file that appears in the
            meantime is kept, and the result is written beside it under a free name, which the report names.
        context: device for rendering, progress and stop.

    Raises:
        HyrfDataError: the viewpoints show none of the splats, or given ones show less than 1 %.
        HyrfSizeError: no file of this scene is as small as `config.target_bytes`.
        HyrfError: no file at all is that small, the file cannot be written, or the device does not exist.
    """
    started = time.perf_counter()
    check_target(None, target, overwrite=overwrite)
    if config.target_bytes is not None:
        check_target_bytes(config.target_bytes)  # before the work; packing knows more precisely what fits
    device = context.choose_device()
    with context.open_progress("import") as progress:
        prepared = prepare_model(
            splats,
            config,
            name=name,
            cameras=cameras,
            device=device,
            progress=part_of_progress(progress, 0.0, 0.7),
        )
        unpacked_scores = prepared.test.psnr_per_view(prepared.model)
        unpacked_psnr = float(np.mean(unpacked_scores))
        _LOG.info(f"PSNR before compression: {unpacked_psnr:.2f} dB")
        imported = (
            f"{format_count(len(splats), 'Gaussian')} of degree {splats.degree} from {Path(name).name}, without photos"
        )
        choices = {"imported": imported}
        provenance: dict = {"steps": 0, "seed": config.seed, "choices": choices}
        packing = part_of_progress(progress, 0.7, 0.97)
        psnr, target_bytes = config.target_psnr, config.target_bytes
        data = pack(prepared, psnr, provenance, packing, worst=config.worst, target_bytes=target_bytes)
        progress(TaskEvent("scoring the file", 0.97))
        try:
            decoded = decode_model(data, device)
            decoded.precision = prepared.model.precision
            scores = prepared.test.psnr_per_view(decoded)
        except Exception:  # not an interrupt, which keeps an earlier file
            written = write_atomic(target, data, overwrite=overwrite)
            _LOG.warning(f"{written}: the file is complete, but it could not be scored")
            raise
        reached_psnr = float(np.mean(scores))
        if config.target_bytes is None:  # With a target size, there may be no space for it.
            data = _state_psnr(data, decoded.config, reached_psnr)
        # The file is written after all else that an interrupt may end, so that an earlier file is kept.
        written = write_atomic(target, data, overwrite=overwrite)
    if config.target_bytes is None and _falls_short(reached_psnr, config.target_psnr):
        _LOG.warning(_shortfall(reached_psnr, unpacked_psnr, config, has_cameras=cameras is not None))
    if config.worst is not None and _falls_short(min(scores), config.worst):
        _LOG.warning(_worst_shortfall(min(scores), min(unpacked_scores), config.worst, has_cameras=cameras is not None))
    return ImportReport(
        gaussians_before=len(splats),
        gaussians_after=len(decoded),
        degree=splats.degree,
        views=len(scores),
        psnr=reached_psnr,
        psnr_worst=min(scores),
        psnr_unpacked=unpacked_psnr,
        psnr_asked=config.target_psnr if config.target_bytes is None else None,
        bytes_source=None,
        bytes_ply=4 * len(splats) * (17 + 3 * (splats.harmonics.shape[1] - 1)),
        bytes_after=len(data),
        seconds=time.perf_counter() - started,
        file=str(written),
    )


def _state_psnr(data: bytes, config: ModelConfig, psnr: float) -> bytes:
    """Return a file with its PSNR in the provenance. By default, `compress` adds a share of that error."""
    container = read_container(data, SECTION_CONTENTS)
    provenance = read_metadata(container).provenance
    return with_metadata(container, config, {**provenance, "psnr": round(psnr, 2)})


def _falls_short(reached_psnr: float, asked: float) -> bool:
    """Return whether a PSNR is less than the target, both rounded as in messages."""
    return round(reached_psnr, 1) < round(asked, 1)


def _shortfall(reached_psnr: float, unpacked_psnr: float, config: ImportConfig, *, has_cameras: bool) -> str:
    """Describe how far the file falls short of the target PSNR, and what the user can do about it.

    `has_cameras`: whether the user gave the viewpoints.
    """
    outcome = (
        f"the target PSNR is {config.target_psnr:g} dB, but the file reaches {reached_psnr:.1f} dB at held-out "
        f"viewpoints ({unpacked_psnr:.1f} dB before compression)"
    )
    if not _falls_short(unpacked_psnr, config.target_psnr):
        return f"{outcome}; {_advise_higher_target(config.target_psnr, 'target with `psnr`', has_cameras)}"
    if has_cameras:
        return (
            f"{outcome}; Gaussians that the given cameras hardly show are left out, and opacities and scales are "
            "limited in a model, so give more `cameras` or set a lower `psnr`"
        )
    return f"{outcome}; opacities and scales are limited in a model, so set a lower `psnr`"


def _advise_higher_target(asked: float, setting: str, has_cameras: bool) -> str:
    """Return what the user can do where the model reaches a target PSNR and the compressed file does not.

    Args:
        asked: the target PSNR, in dB.
        setting: the setting that holds it, in the words of the message.
        has_cameras: whether the user gave the viewpoints.
    """
    if asked < MAX_IMPORT_PSNR_DB:
        return f"set a higher {setting}"
    more = "give more `cameras`" if has_cameras else "name many viewpoints with `cameras`"
    return f"{MAX_IMPORT_PSNR_DB:g} dB is the highest target, so {more}, at which the compression is decided"


def _worst_shortfall(reached_psnr: float, unpacked_psnr: float, asked: float, *, has_cameras: bool = False) -> str:
    """Describe how far the worst held-out view falls short of the PSNR asked for, and what the user can do about it."""
    is_limited = _falls_short(unpacked_psnr, asked)
    remedy = "set a lower `worst`" if is_limited else _advise_higher_target(asked, "`worst`", has_cameras)
    return (
        f"the target PSNR of the worst view is {asked:g} dB, but the worst held-out view has {reached_psnr:.1f} dB "
        f"({unpacked_psnr:.1f} dB before compression); {remedy}"
    )
