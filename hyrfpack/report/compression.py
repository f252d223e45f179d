"""The compression report: measure a compressed file and its alternatives, and write the page about them."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from contextlib import suppress
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.capture import Capture, place_photos
from hyrfpack.compress import CompressionReport
from hyrfpack.compress.calibrate import measure_calibrated_sensitivity
from hyrfpack.compress.distortion import DISTORTION_RANGE, default_distortion
from hyrfpack.compress.merged import is_merged
from hyrfpack.compress.quantize import plan_and_quantize
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import Evaluation, evaluate_model
from hyrfpack.evaluate.figures import require_matplotlib
from hyrfpack.evaluate.metrics import psnr, to_8bit
from hyrfpack.format.codec import (
    decode_model,
    encode_model,
    load_with_provenance,
    packed_provenance,
)
from hyrfpack.format.info import describe_file
from hyrfpack.lock import exclusive_folder
from hyrfpack.measure.machine import describe_machine, format_machine
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.render import render_view
from hyrfpack.render.files import save_picture, to_image
from hyrfpack.report.compression_page import (
    MAX_SHOWN_VIEWS,
    PAGE_FILE,
    REPORT_FILES,
    Findings,
    MeasuredFile,
    ShownView,
    encode_compression_page,
    picture_names,
)
from hyrfpack.report.compression_plot import draw_plot
from hyrfpack.report.page import embed_figure
from hyrfpack.scene import Picture, Scene, View, evenly_spaced

_LOG = logging.getLogger(__name__)

# Distortions of the rate-distortion curve, relative to that of the file.
CURVE_DISTORTION_RATIOS = (1 / 16, 1 / 4, 1, 4, 16)
# With this many Gaussians or more, the curve has only the middle three points: each takes long to encode and score.
SHORT_CURVE_MIN_GAUSSIANS = 200_000
MAX_SCORED_PHOTOS = 24
MAX_SCORED_VIEWPOINTS = 12
# The RMS of the worst shown difference picture is at most this after amplification.
MAX_AMPLIFIED_RMS = 0.4
MAX_AMPLIFICATION = 64
DECODE_TIMING_TURNS = 3
WRITTEN_FILE_LABEL = "this file"
SAME_DISTORTION_NAME = "compact, the same distortion"


def write_compression_report(
    folder: str | os.PathLike[str],
    source: str | os.PathLike[str],
    packed: str | os.PathLike[str],
    report: CompressionReport,
    scene: Scene | None = None,
    *,
    command: str = "",
    overwrite: bool = True,
) -> Path:
    """Write `folder/index.html` about a compressed file, and its pictures beside it.

    Decoded files are scored on the held-out photos of the scene, or on its training photos if none are held out.
    Without photos they are scored against renders of the uncompressed model.

    Args:
        folder: folder of the report; created if missing.
        source: the file that was compressed.
        packed: the compressed file.
        report: the result of `hyrfpack.compress_model`.
        scene: photos of the scene.
        command: command line shown on the page as the way to make the file again.
        overwrite: replace files of an earlier page; if False, they are an error.

    Returns:
        The path of the page. It is written last, so if it exists, all pictures that it shows exist.

    Raises:
        HyrfError: a file cannot be read or holds merged models, the folder cannot be written, another call is writing
            into it, or matplotlib is missing.
    """
    require_matplotlib()
    check_single_model(source)
    folder, source, packed = Path(folder), Path(source), Path(packed)
    Outputs(source, packed, scene=scene, overwrite=True).folder(folder, REPORT_FILES)
    with exclusive_folder(folder, "another folder with `report`"):
        Outputs(source, packed, scene=scene, overwrite=overwrite).folder(folder, REPORT_FILES)
        return _write_report(folder, source, packed, report, scene, command, overwrite)


def check_single_model(source: str | os.PathLike[str]) -> None:
    """Raise HyrfError if a file holds merged models, for which there is no report."""
    if is_merged(Path(source)):
        raise HyrfError(
            f"{source}: this file holds merged models, and a report compares versions of one model",
            fix="leave out `report`, or compress the models before they are merged",
        )


def _write_report(
    folder: Path,
    source: Path,
    packed: Path,
    report: CompressionReport,
    scene: Scene | None,
    command: str,
    overwrite: bool,
) -> Path:
    """Do the work of `write_compression_report` in a folder that this call has locked."""
    model, provenance = load_with_provenance(source)
    scene = place_photos(describe_file(source), scene)
    views, views_in_words = _views_to_score(model, source, scene)
    _LOG.info(f"comparing renders with {views_in_words} for the report")
    model_scores = evaluate_model(model, views)
    facts, data = describe_file(packed), _read_bytes(packed)
    scored = [view for view in views if view.name not in model_scores.skipped]

    profiles = _encode_other_profiles(model, provenance, report.profile)
    curve = {}
    if len(model):
        distortion = _distortion_of_file(facts, model, provenance)
        sensitivity = report.sensitivity
        if sensitivity is None:
            sensitivity, _ = measure_calibrated_sensitivity(
                model, Capture(describe_file(source), scene).cameras, distortion
            )
        # The written file is the curve's point at its distortion, unless fine-tuning moved it off the curve.
        written_file = data if report.profile == "compact" and not report.finetuned else None
        curve = _encode_curve(model, provenance, sensitivity, distortion, written_file)
    at_same_distortion = [name for name, encoded in curve.items() if encoded is data]
    files = {
        WRITTEN_FILE_LABEL: data,
        **profiles,
        **{name: encoded for name, encoded in curve.items() if name not in at_same_distortion},
    }
    points, decoded = _measure_files(files, scored)

    shown_views, amplification = _write_pictures(
        folder, model, decoded[WRITTEN_FILE_LABEL], scored, model_scores, points[WRITTEN_FILE_LABEL].scores, overwrite
    )
    findings = Findings(
        views=views_in_words,
        has_photos=scene is not None,
        before=model_scores,
        chosen=points[WRITTEN_FILE_LABEL],
        profiles=[points[name] for name in profiles],
        curve=[points[WRITTEN_FILE_LABEL if name in at_same_distortion else name] for name in curve],
        shown=shown_views,
        amplification=amplification,
        gaussians=len(model),
        machine=format_machine(describe_machine()),
        writer=facts["writer"],
    )
    plot = embed_figure(draw_plot(findings), "Bytes of each file against its loss, and against the time to decode it")
    page = encode_compression_page(source, packed, report, findings, plot, command)
    return write_atomic(folder / PAGE_FILE, page, overwrite=overwrite, rename=False)


def _views_to_score(model: HybridModel, source: Path, scene: Scene | None) -> tuple[list[View], str]:
    """Return the views to score against, and a description of them."""
    if scene is None:
        with torch.no_grad():
            decoded = model.decode()
            cameras = evenly_spaced(Capture(describe_file(source)).cameras, MAX_SCORED_VIEWPOINTS)
            renders = [to_image(render_view(model, camera, decoded=decoded).rgb) for camera in cameras]
        views = [
            View(f"viewpoint {number}", camera, partial(Picture, np.asarray(picture)))
            for number, (camera, picture) in enumerate(zip(cameras, renders, strict=True), 1)
        ]
        return views, f"renders of the uncompressed model from {format_count(len(views), 'viewpoint')}"
    views, kind = (scene.test, "held-out") if scene.test else (scene.train, "training")
    chosen = evenly_spaced(views, MAX_SCORED_PHOTOS)
    count = f"{len(chosen)}" if len(chosen) == len(views) else f"{len(chosen)} of {len(views)}"
    return chosen, f"{count} {kind} {'photo' if len(views) == 1 else 'photos'}"


def _distortion_of_file(facts: dict, model: HybridModel, provenance: dict) -> float:
    """Return the distortion that the file was planned for, or the default if it has another profile than "compact"."""
    per_number = facts["settings"].get("distortion")
    if not isinstance(per_number, float) or not per_number > 0:
        return default_distortion(provenance)
    return per_number * sum(parameter.numel() for parameter in model.parameters())


def _encode_other_profiles(model: HybridModel, provenance: dict, written_profile: str) -> dict[str, bytes]:
    """Encode the model in the profiles that have no settings, except the profile that was written already."""
    files = {}
    for profile, kept_provenance in (("raw", provenance), ("paper", packed_provenance(provenance, model))):
        with suppress(HyrfError):  # half precision cannot represent every model
            if profile != written_profile:
                files[profile] = encode_model(model, profile, kept_provenance)
    return files


def _encode_curve(
    model: HybridModel, provenance: dict, sensitivity: Sensitivity, distortion: float, at_same_distortion: bytes | None
) -> dict[str, bytes]:
    """Encode the model in profile "compact" at each distortion of the curve, smallest distortion first.

    Args:
        at_same_distortion: the file of exactly this distortion, if it exists already.
    """
    files = {}
    for factor in CURVE_DISTORTION_RATIOS if len(model) < SHORT_CURVE_MIN_GAUSSIANS else CURVE_DISTORTION_RATIOS[1:-1]:
        if factor == 1 and at_same_distortion is not None:
            files[SAME_DISTORTION_NAME] = at_same_distortion
            continue
        share = f"{Fraction(factor)} of the distortion" if factor < 1 else f"{factor} times the distortion"
        quantized = plan_and_quantize(model, sensitivity, float(np.clip(factor * distortion, *DISTORTION_RANGE)))
        name = SAME_DISTORTION_NAME if factor == 1 else f"compact, {share}"
        files[name] = encode_model(model, "compact", packed_provenance(provenance, model), quantized=quantized)
    return files


def _measure_files(
    files: dict[str, bytes], views: Sequence[View]
) -> tuple[dict[str, MeasuredFile], dict[str, HybridModel]]:
    """Time the decoding of all files in turns, and score the decoded models."""
    times, decoded = time_alternately(
        {name: partial(decode_model, data) for name, data in files.items()}, DECODE_TIMING_TURNS
    )
    points = {
        name: MeasuredFile(name, len(data), evaluate_model(decoded[name], views), times[name].ms)
        for name, data in files.items()
    }
    return points, decoded


@torch.no_grad()
def _write_pictures(
    folder: Path,
    model: HybridModel,
    packed: HybridModel,
    views: Sequence[View],
    model_scores: Evaluation,
    packed_scores: Evaluation,
    overwrite: bool,
) -> tuple[list[ShownView], int]:
    """Write renders of both models and their difference, from the view that loses most to the one that loses least.

    Returns:
        The shown views, and the amplification of the differences.
    """
    scored = sorted(
        zip(views, model_scores.views, packed_scores.views, strict=True), key=lambda item: item[2].psnr - item[1].psnr
    )
    chosen = evenly_spaced(scored, MAX_SHOWN_VIEWS)
    decoded_models = model.decode(), packed.decode()
    pairs = [
        (
            to_8bit(render_view(model, view.camera, decoded=decoded_models[0]).rgb),
            to_8bit(render_view(packed, view.camera, decoded=decoded_models[1]).rgb),
        )
        for view, *_ in chosen
    ]
    psnr_between = [psnr(packed_picture, model_picture) for model_picture, packed_picture in pairs]
    amplification = choose_amplification(min(psnr_between))
    shown_views = []
    for number, ((view, model_score, packed_score), pair, view_psnr) in enumerate(
        zip(chosen, pairs, psnr_between, strict=True), 1
    ):
        names = picture_names(number)
        for name, picture in zip(names, (*pair, amplification * (pair[1] - pair[0]).abs()), strict=True):
            save_picture(folder / name, to_image(picture), overwrite=overwrite, rename=False)
        shown_views.append(ShownView(view.name, model_score.psnr, packed_score.psnr, view_psnr, names))
    return shown_views, amplification


def choose_amplification(psnr_between: float) -> int:
    """Choose the amplification that makes the difference between two renders visible.

    Args:
        psnr_between: PSNR between the renders, dB.

    Returns:
        A power of two, 1 to MAX_AMPLIFICATION.
    """
    rms = 10 ** (-psnr_between / 20)
    return 2 ** max(0, min(math.floor(math.log2(MAX_AMPLIFIED_RMS / rms)), int(math.log2(MAX_AMPLIFICATION))))


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise HyrfError(f"{path}: the file cannot be read ({error.strerror or error})", fix="write it again") from error
