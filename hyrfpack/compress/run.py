"""Compress a file: measure sensitivities, plan, fine-tune or search if requested, and write."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from hyrfpack.cameras.capture import Capture, place_photos
from hyrfpack.checks import check_type
from hyrfpack.compress.calibrate import measure_calibrated_sensitivity
from hyrfpack.compress.distortion import DEFAULT_PSNR_DROP_DB, default_distortion
from hyrfpack.compress.limits import EncodedCandidate, encode_within_bytes, encode_within_psnr_drop
from hyrfpack.compress.merged import (
    MergedPacker,
    compress_parts,
    is_merged,
    is_shown,
    iterate_parts,
    mask_scene_views,
    name_part,
)
from hyrfpack.compress.packer import Packer
from hyrfpack.compress.planner import Planner
from hyrfpack.compress.reference_renders import ReferenceRenders
from hyrfpack.compress.report import CompressionReport
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.config.compress import CompressConfig
from hyrfpack.context import RunContext
from hyrfpack.copying import copy_file
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError, named_in_errors
from hyrfpack.format.codec import load_parts, load_with_provenance, packed_provenance, repack, write_model
from hyrfpack.format.info import describe_file
from hyrfpack.format.min_file_size import check_target_above, check_target_bytes, min_merged_file_bytes
from hyrfpack.format.parts import write_merged
from hyrfpack.format.run_folder import find_model
from hyrfpack.out_of_memory import explain_out_of_memory
from hyrfpack.outputs import Outputs, StrPath
from hyrfpack.parallel.ranks import SINGLE_PROCESS
from hyrfpack.progress import Progress, part_of_progress
from hyrfpack.scene import Scene

_LOG = logging.getLogger(__name__)

# Share of the progress at which sensitivities are measured and encoding starts, for a single file and for a search.
ENCODING_START_SHARE = 0.7
SEARCH_ENCODING_START_SHARE = 0.3


@explain_out_of_memory("reduce `max_size` of the photos")
def compress_model(
    source: StrPath,
    target: StrPath,
    config: CompressConfig = CompressConfig(),  # noqa: B008 - frozen
    *,
    data: Scene | None = None,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> CompressionReport:
    """Compress a `.hyrf` file into a smaller one.

    Profile "compact" measures at the cameras of `data`, or at those stored in the file. On the CPU the same input gives
    the same bytes. On a GPU sums of gradients vary in their last bits, and so may the bytes. The parts of a merged file
    are compressed each by itself; within a limit, all to the same distortion.

    Args:
        source: a file of any profile, best "raw", or the folder of a run.
        target: the file to write.
        config: the settings.
        data: photos of the scene, for profile "compact" only. Fine-tuning and limits on PSNR need them. Those of a
            merged file show its first part.
        overwrite: replace a file at `target`. If False, an existing file is an error. A file that appears in the
            meantime is kept, and the result is written beside it under a free name, which the report names.
        context: device, processes and progress. The processes share the photos of fine-tuning.

    Raises:
        HyrfError: a file cannot be read or written, the target would replace an input, the settings exclude each
            other, or no file meets the limits.
        TypeError: `config` is not a CompressConfig, or `data` is not a Scene.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.compress_model("runs/bonsai", "small.hyrf", hyrfpack.CompressConfig(target_bytes=20_000))
        >>> report.profile, report.bytes_after < report.bytes_before
        ('compact', True)
    """
    check_type("config", config, CompressConfig)
    if data is not None:
        check_type("data", data, Scene)
    source, ranks = find_model(source), context.ranks or SINGLE_PROCESS
    # Only the main process checks the target, while the others wait. They must not mistake its output for an old file.
    outputs = Outputs(source, scene=data, overwrite=overwrite)
    ranks.run_on_main(lambda: outputs.file(target))
    check_request(config, data)
    data = place_photos(describe_file(source), data)
    compress = _compress_merged if is_merged(source) else _compress_single
    report = compress(source, target, config, data, overwrite, context)
    if config.profile == "compact" and report.bytes_after > (before := source.stat().st_size):
        _LOG.warning(
            f"{report.file}: {report.bytes_after:,} bytes, more than the {before:,} of {source}, which was compressed "
            "already; keep that file, or set a limit with `target_bytes`"
        )
    return report


def _compress_single(
    source: Path, target: StrPath, config: CompressConfig, data: Scene | None, overwrite: bool, context: RunContext
) -> CompressionReport:
    """Compress a file of one model."""
    ranks = context.ranks or SINGLE_PROCESS
    if config.profile != "compact":
        settings = config.encoder_settings()
        repacked = ranks.run_on_main(lambda: repack(source, target, config.profile, overwrite=overwrite, **settings))
        return CompressionReport(**vars(repacked))
    with context.open_progress("compress") as progress:
        candidate, search_result, sensitivity = _encode_compact(source, config, data, context, progress)
    report = ranks.run_on_main(lambda: write_model(candidate.data, target, overwrite=overwrite))
    return CompressionReport(
        **vars(report),
        shares=_error_shares(candidate),
        error=candidate.measured_error or sum(candidate.predicted_errors.values()),
        found=search_result,
        finetuned=config.finetune_steps is not None,
        sensitivity=sensitivity,
    )


def _error_shares(candidate: EncodedCandidate) -> dict[str, float]:
    """Return the share of each entry in the predicted error of a file; zeros if there is no error."""
    total = sum(candidate.predicted_errors.values())
    return {part: error / (total or 1.0) for part, error in candidate.predicted_errors.items()}


def _compress_merged(
    source: Path, target: StrPath, config: CompressConfig, data: Scene | None, overwrite: bool, context: RunContext
) -> CompressionReport:
    """Compress the parts of a merged file: within a limit to one distortion, else each part by itself."""
    if config.finetune_steps or not (context.ranks or SINGLE_PROCESS).is_single:
        raise HyrfError(
            f"{source}: it holds merged models, and fine-tuning and several processes are for one model",
            fix="leave them out, or compress the models before they are merged",
        )
    if config.target_bytes is not None or config.max_psnr_drop is not None:
        with context.open_progress("compress") as progress:
            candidate, found = _encode_merged(source, config, data, context, progress)
        written = write_merged(candidate.data, target, overwrite=overwrite)
        error = sum(candidate.predicted_errors.values())
        return CompressionReport(**vars(written), shares=_error_shares(candidate), error=error, found=found)
    photos = data  # which show the first part, the scene

    def compress_part(loose: Path, packed: Path, progress: Progress) -> None:
        nonlocal photos
        own, photos = photos, None
        facts = describe_file(loose)
        if config.profile == "compact" and not facts["gaussians"] and not facts["config"]["background"]:
            copy_file(loose, packed)  # nothing can be measured of a solid colour
        else:
            _compress_single(loose, packed, config, own, True, replace(context, progress=progress))

    with context.open_progress("compress") as progress:
        written = compress_parts(source, target, compress_part, progress, overwrite=overwrite)
    return CompressionReport(**vars(written))


def _encode_merged(
    source: Path, config: CompressConfig, data: Scene | None, context: RunContext, progress: Progress
) -> tuple[EncodedCandidate, str]:
    """Encode all parts of a merged file within a limit; return the file, and the outcome of the search."""
    if config.target_bytes is not None:
        _check_merged_target(source, config.target_bytes)
    names, packers, start = list[str](), list[Packer](), 0.0
    for name, part, share in iterate_parts(source, part_of_progress(progress, 0.0, SEARCH_ENCODING_START_SHARE)):
        photos = None if packers else data
        with named_in_errors(part, name_part(source, name)):
            packer, _, distortion = _prepare_packer(
                part, replace(config, target_bytes=None), photos, context, share, progress
            )
        start = start or distortion  # that of the scene
        names.append(name)
        packer.planner = None  # so that the plans of all parts are not in memory together
        packers.append(packer)
    merged = MergedPacker(names, packers)
    searching = part_of_progress(progress, SEARCH_ENCODING_START_SHARE, 1.0)
    if config.target_bytes is not None:
        return encode_within_bytes(merged.encode, config.target_bytes, start, searching)
    assert data is not None and config.max_psnr_drop is not None
    views = mask_scene_views(merged.model, data.test or data.train)
    return encode_within_psnr_drop(
        merged.encode, merged.decode, merged.model, views, config.max_psnr_drop, start, searching
    )


def _check_merged_target(source: Path, target_bytes: int) -> None:
    """Raise HyrfError if no merged file of the parts is as small as the target size."""
    parts = [
        (name, packed_provenance(provenance, model), model.exposure)
        for number, (name, model, provenance) in enumerate(load_parts(source))
        if is_shown(number, len(model))
    ]
    check_target_above(target_bytes, min_merged_file_bytes(parts))


def _encode_compact(
    source: Path, config: CompressConfig, data: Scene | None, context: RunContext, progress: Progress
) -> tuple[EncodedCandidate, str, Sensitivity]:
    """Encode a file with profile "compact"; return it, the outcome of a search as a sentence, and the sensitivities."""
    searches = config.target_bytes is not None or config.max_psnr_drop is not None
    encoding_start = SEARCH_ENCODING_START_SHARE if config.finetune_steps or searches else ENCODING_START_SHARE
    measuring, encoding = (
        part_of_progress(progress, 0.0, encoding_start),
        part_of_progress(progress, encoding_start, 1.0),
    )
    packer, references, start = _prepare_packer(source, config, data, context, measuring, encoding)
    sensitivity = packer.sensitivity
    if config.target_bytes is not None:
        return *packer.encode_within_bytes(config.target_bytes, start), sensitivity
    if config.max_psnr_drop is not None:
        return *packer.encode_within_psnr_drop(config.max_psnr_drop, start), sensitivity
    if config.finetune_steps:
        return packer.encode(start, encoding), "", sensitivity
    target_drop = DEFAULT_PSNR_DROP_DB if config.distortion is None else None
    return packer.encode_to_distortion(start, references, target_drop), "", sensitivity


def _prepare_packer(
    source: Path,
    config: CompressConfig,
    data: Scene | None,
    context: RunContext,
    measuring_progress: Progress,
    encoding_progress: Progress,
) -> tuple[Packer, ReferenceRenders, float]:
    """Measure sensitivities of a model; return its packer, renders of it, and the distortion to start from."""
    ranks = context.ranks or SINGLE_PROCESS
    model, provenance = load_with_provenance(source)
    kept = packed_provenance(provenance, model)
    if config.target_bytes is not None:
        check_target_bytes(config.target_bytes, kept, model.exposure)
    model = model.to(context.choose_device())
    model.precision = "float32"  # quantisation errors are smaller than the rounding of lower precisions on a GPU
    if len(model) == 0 and not model.config.background:
        raise HyrfError(
            f"{source}: there is no Gaussian in it and no background, so there is nothing to measure",
            fix="use profile 'paper'",
        )
    capture = Capture(describe_file(source), data)
    cameras = capture.cameras
    _LOG.info(f"measuring how each stored number affects renders, at {len(cameras)} cameras and between them")
    steps = config.finetune_steps or 0
    start = config.distortion or default_distortion(provenance, steps)
    planner = Planner(model, config.prune)
    sensitivity, references = measure_calibrated_sensitivity(
        model, cameras, start, config.prune, measuring_progress, planner=planner
    )
    # The model of a uniform wall or sky may be all background, at cameras that are known to be its own.
    has_own_cameras = data is None or ("cameras" in provenance and not capture.mismatch)
    if len(model) and not sensitivity.is_seen and not (model.config.background and has_own_cameras):
        raise HyrfError(
            f"{source}: none of its {len(cameras)} cameras sees a Gaussian, so there is nothing to measure",
            fix="name photos that show the model with `data`, or use profile 'paper'",
        )
    sensitivity = ranks.broadcast(sensitivity)  # on GPUs the other ranks' values differ in their last bits
    cache = context.cache or PictureCache()
    last_planner = None if steps else planner  # Fine-tuning moves Gaussians, so the last plan is of no use to it.
    packer = Packer(model, kept, sensitivity, data, steps, config.prune, encoding_progress, cache, ranks, last_planner)
    return packer, references, start


def check_request(config: CompressConfig, data: Scene | None) -> None:
    """Raise HyrfError if settings exclude each other, or photos are missing or cannot be used."""
    limits = {
        "a target size": config.target_bytes,
        "a largest loss of PSNR": config.max_psnr_drop,
        "a distortion": config.distortion,
    }
    given = [name for name, limit in limits.items() if limit is not None]
    if config.profile != "compact" and (data is not None or config.finetune_steps or given):
        raise HyrfError(
            f"profile '{config.profile}' cannot be fitted to photos, a target size or a limit on the loss",
            fix="use profile 'compact'",
        )
    if config.profile != "paper" and config.paper is not None:
        raise HyrfError(f"profile '{config.profile}' has none of the settings of 'paper'", fix="leave them out")
    if data is None and (config.finetune_steps or config.max_psnr_drop is not None):
        asked = "steps of fine-tuning" if config.finetune_steps else "limits on the loss of PSNR"
        raise HyrfError(f"{asked} need photos", fix="name their folder with `data`")
    if len(given) > 1:
        raise HyrfError(
            f"{' and '.join(given)} each decide how fine the file is",
            fix="give one of them",
        )
    if data is not None and not data.train:
        raise HyrfError(
            f"{data.path}: all photos are held out, so that none is left to measure with",
            fix="use a larger `test_every`",
        )
