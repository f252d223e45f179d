"""The page about a compressed file: what it takes, what it lost, what else it could have been."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.capture import Capture, quantized_provenance
from hyrfpack.compress.calibrate import calibrated
from hyrfpack.compress.distortion import LIMITS, default_distortion
from hyrfpack.compress.quantize import decide
from hyrfpack.compress.report_page import FILES, PAGE, PLOT, SHOWN, Findings, Point, ShownView, page, picture_names
from hyrfpack.compress.report_plot import draw
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import Evaluation, evaluate
from hyrfpack.evaluate.metrics import psnr, to_8bit
from hyrfpack.format.codec import (
    CompressionReport,
    decode_model,
    encode_model,
    load_with_provenance,
)
from hyrfpack.format.info import describe
from hyrfpack.lock import exclusive_folder
from hyrfpack.measure.machine import describe_machine, format_machine
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.render import render
from hyrfpack.render.files import save_picture, to_image
from hyrfpack.scene import Picture, Scene, View, evenly_spaced

FACTORS = (1 / 16, 1 / 4, 1, 4, 16)  # of the file's distortion, for the curve
LARGE = 200_000  # Gaussians from which on the curve takes the middle three alone
PHOTOS, VIEWPOINTS = 24, 12  # scored at most
VISIBLE = 0.4  # rms difference that the worst shown view is amplified to, at most
MOST_AMPLIFIED = 64
TURNS = 3  # of timing each file
CHOSEN, SAME = "this file", "compact, the same distortion"


def write_report(
    folder: str | os.PathLike[str],
    source: str | os.PathLike[str],
    packed: str | os.PathLike[str],
    report: CompressionReport,
    scene: Scene | None = None,
    *,
    command: str = "",
    overwrite: bool = True,
    say: Callable[[str], None] = lambda sentence: None,
) -> Path:
    """Write `folder/index.html` about a compressed file, and its pictures beside it.

    Scores are those of decoded files on the held-out photos of the scene, on those it was trained on where none are
    held out, and without photos against the uncompressed model's own renders.

    Args:
        folder: made if missing.
        source: the file that was compressed.
        packed: the file it became.
        report: what `hyrfpack.compress` returned.
        scene: photos.
        command: what was run, for people to run it again.
        overwrite: replace files of an earlier page; without it, they are an error.
        say: told what is going on.

    Returns:
        The page, written last: where it is, all that it shows is there.

    Raises:
        HyrfError: a file cannot be read, the folder cannot be written, or another call is at work in it.
    """
    folder, source, packed = Path(folder), Path(source), Path(packed)
    Outputs(source, packed, scene=scene, overwrite=True).folder(folder, FILES)
    with exclusive_folder(folder, "another folder with `report`"):
        Outputs(source, packed, scene=scene, overwrite=overwrite).folder(folder, FILES)
        return _write_report(folder, source, packed, report, scene, command, overwrite, say)


def _write_report(
    folder: Path,
    source: Path,
    packed: Path,
    report: CompressionReport,
    scene: Scene | None,
    command: str,
    overwrite: bool,
    say: Callable[[str], None],
) -> Path:
    """As `write_report`, into a folder that this call holds."""
    model, provenance = load_with_provenance(source)
    views, words = _views(model, source, scene)
    say(f"comparing pictures with {words}, for the page")
    before = evaluate(model, views)
    facts, data = describe(packed), _read(packed)
    scored = [view for view in views if view.name not in before.skipped]

    profiles = _profiles(model, provenance, report.profile)
    curve = {}
    if len(model):
        distortion = _distortion(facts, model, provenance)
        sensitivity = report.sensitivity
        if sensitivity is None:
            sensitivity, _ = calibrated(model, Capture(describe(source), scene).cameras, distortion)
        # The file itself stands for the one of its distortion, unless it was fine-tuned, and so is off the curve.
        itself = data if report.profile == "compact" and not report.finetuned else None
        curve = _finer_and_coarser(model, provenance, sensitivity, distortion, itself)
    same = [name for name, other in curve.items() if other is data]
    files = {CHOSEN: data, **profiles, **{name: other for name, other in curve.items() if name not in same}}
    points, decoded = _measured(files, scored)

    shown, amplified = _write_pictures(folder, model, decoded[CHOSEN], scored, before, points[CHOSEN].scores, overwrite)
    findings = Findings(
        views=words,
        has_photos=scene is not None,
        before=before,
        chosen=points[CHOSEN],
        profiles=[points[name] for name in profiles],
        curve=[points[CHOSEN if name in same else name] for name in curve],
        shown=shown,
        amplified=amplified,
        gaussians=len(model),
        machine=format_machine(describe_machine()),
        writer=facts["writer"],
    )
    draw(findings, folder / PLOT, overwrite=overwrite)
    path = folder / PAGE
    text = page(source, packed, report, findings, command).encode()
    return write_atomic(path, text, overwrite=overwrite, rename=False)


def _views(model: HybridModel, source: Path, scene: Scene | None) -> tuple[list[View], str]:
    """What pictures are compared with, and that in words."""
    if scene is None:
        with torch.no_grad():
            decoded = model.decode()
            cameras = evenly_spaced(Capture(describe(source)).cameras, VIEWPOINTS)
            renders = [to_image(render(model, camera, decoded=decoded).rgb) for camera in cameras]
        views = [
            View(f"viewpoint {number}", camera, partial(Picture, np.asarray(picture)))
            for number, (camera, picture) in enumerate(zip(cameras, renders, strict=True), 1)
        ]
        return views, f"what the uncompressed model shows from {len(views)} viewpoints"
    views, kind = (scene.test, "held-out") if scene.test else (scene.train, "training")
    chosen = evenly_spaced(views, PHOTOS)
    count = f"{len(chosen)}" if len(chosen) == len(views) else f"{len(chosen)} of {len(views)}"
    return chosen, f"{count} {kind} {'photo' if len(views) == 1 else 'photos'}"


def _distortion(facts: dict, model: HybridModel, provenance: dict) -> float:
    """What the packed file allows pictures, as `make_plan` takes it; of other profiles the default."""
    each = facts["settings"].get("distortion")
    if not isinstance(each, float) or not each > 0:
        return default_distortion(provenance)
    return each * sum(parameter.numel() for parameter in model.parameters())


def _profiles(model: HybridModel, provenance: dict, done: str) -> dict[str, bytes]:
    """The model in the profiles without settings to choose, but for the one that is done."""
    files = {}
    for profile, kept in (("raw", provenance), ("paper", quantized_provenance(provenance, model.config.frame.scale))):
        with suppress(HyrfError):  # half precision does not hold every model
            if profile != done:
                files[profile] = encode_model(model, profile, kept)
    return files


def _finer_and_coarser(
    model: HybridModel, provenance: dict, sensitivity: Sensitivity, distortion: float, same: bytes | None
) -> dict[str, bytes]:
    """The model in profile "compact", finest first; `same` is the file of this distortion, where there is one."""
    files = {}
    for factor in FACTORS if len(model) < LARGE else FACTORS[1:-1]:
        if factor == 1 and same is not None:
            files[SAME] = same
            continue
        share = f"{Fraction(factor)} of the distortion" if factor < 1 else f"{factor} times the distortion"
        quantized = decide(model, sensitivity, float(np.clip(factor * distortion, *LIMITS)))
        name = SAME if factor == 1 else f"compact, {share}"
        files[name] = encode_model(
            model, "compact", quantized_provenance(provenance, model.config.frame.scale), quantized=quantized
        )
    return files


def _measured(files: dict[str, bytes], views: Sequence[View]) -> tuple[dict[str, Point], dict[str, HybridModel]]:
    """Decode files in turns, and score what comes out."""
    times, decoded = time_alternately({name: partial(decode_model, data) for name, data in files.items()}, TURNS)
    points = {
        name: Point(name, len(data), evaluate(decoded[name], views), times[name].ms) for name, data in files.items()
    }
    return points, decoded


@torch.no_grad()
def _write_pictures(
    folder: Path,
    model: HybridModel,
    packed: HybridModel,
    views: Sequence[View],
    before: Evaluation,
    after: Evaluation,
    overwrite: bool,
) -> tuple[list[ShownView], int]:
    """Renders of both models and their difference, from the view that loses most to the one that loses least.

    Returns:
        The views, and how many times the differences are amplified.
    """
    scored = sorted(zip(views, before.views, after.views, strict=True), key=lambda item: item[2].psnr - item[1].psnr)
    chosen = evenly_spaced(scored, SHOWN)
    both = model.decode(), packed.decode()
    pairs = [
        (
            to_8bit(render(model, view.camera, decoded=both[0]).rgb),
            to_8bit(render(packed, view.camera, decoded=both[1]).rgb),
        )
        for view, *_ in chosen
    ]
    between = [psnr(new, old) for old, new in pairs]
    amplified = amplification(min(between))
    shown = []
    for number, ((view, old, new), pair, distance) in enumerate(zip(chosen, pairs, between, strict=True), 1):
        names = picture_names(number)
        for name, picture in zip(names, (*pair, amplified * (pair[1] - pair[0]).abs()), strict=True):
            save_picture(folder / name, to_image(picture), overwrite=overwrite, rename=False)
        shown.append(ShownView(view.name, old.psnr, new.psnr, distance, names))
    return shown, amplified


def amplification(between: float) -> int:
    """The power of two that makes a difference of so many dB visible, 1 to MOST_AMPLIFIED."""
    rms = 10 ** (-between / 20)
    return 2 ** max(0, min(math.floor(math.log2(VISIBLE / rms)), int(math.log2(MOST_AMPLIFIED))))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise HyrfError(f"{path}: the file cannot be read ({error.strerror or error}); write it again") from error
