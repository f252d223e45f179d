"""Compression of merged files: each part by itself, or all to one distortion, within limits on the whole file."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.compress.limits import EncodedCandidate
from hyrfpack.compress.packer import Packer
from hyrfpack.data.masked_views import mask_differing_pixels
from hyrfpack.errors import HyrfError, named_in_errors
from hyrfpack.format.container import Container, read_container
from hyrfpack.format.info import FileReport
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.part_names import open_parts
from hyrfpack.format.parts import decode_parts, encode_parts, write_parts
from hyrfpack.format.sections import PART_NAMES, SECTION_CONTENTS
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.outputs import StrPath
from hyrfpack.progress import Progress, part_of_progress
from hyrfpack.render import render_view
from hyrfpack.scene import View

_LOG = logging.getLogger(__name__)


def is_merged(path: Path) -> bool:
    """Return whether a file holds several models."""
    with Container.open(path, SECTION_CONTENTS) as container:
        return PART_NAMES in container.entries


def name_part(source: Path, name: str) -> str:
    """Return how messages call a part of a merged file."""
    return f"{source}: part '{name}'"


def is_shown(number: int, gaussians: int) -> bool:
    """Return whether a part of a merged file is shown, given its number from 0 and its number of Gaussians.

    Earlier versions wrote parts without Gaussians. Of these, only the first part shows anything: its background.
    """
    return number == 0 or gaussians > 0


def iterate_parts(source: Path, progress: Progress) -> Iterator[tuple[str, Path, Progress]]:
    """Yield name, file and progress of each part of a merged file. A file lasts until the next one is asked for.

    Parts that show nothing (`is_shown`) are left out.
    """
    with Container.open(source, SECTION_CONTENTS) as container, tempfile.TemporaryDirectory() as folder:
        models = list[tuple[str, Container]]()
        for number, (name, part) in enumerate(open_parts(container)):
            if is_shown(number, read_metadata(part).gaussians):
                models.append((name, part))
            else:
                _LOG.info(f"{name_part(source, name)} holds no Gaussian and is left out")
        for number, (name, part) in enumerate(models):
            loose = Path(folder, "part.hyrf")
            write_atomic(loose, part.read_bytes())
            yield name, loose, part_of_progress(progress, number / len(models), (number + 1) / len(models))


def compress_parts(
    source: Path,
    target: StrPath,
    compress_part: Callable[[Path, Path, Progress], object],
    progress: Progress,
    *,
    overwrite: bool,
) -> FileReport:
    """Compress each part of a merged file, and write a merged file of the results.

    Args:
        source: the merged file.
        target: the file to write.
        compress_part: compresses the file of one model, the first path, to the second path, and reports its progress.
        progress: called with `TaskEvent`s.
        overwrite: replace a file at `target`.
    """
    parts = []
    for name, loose, share in iterate_parts(source, progress):
        packed = loose.with_name("packed.hyrf")
        with named_in_errors(loose, name_part(source, name)):
            compress_part(loose, packed, share)
        parts.append((name, packed.read_bytes()))
    return write_parts(parts, target, overwrite=overwrite)


@dataclass(frozen=True)
class MergedPacker:
    """Encodes all parts of a merged file at one distortion.

    Attributes:
        names: names of the parts.
        packers: the packer of each part.
    """

    names: Sequence[str]
    packers: Sequence[Packer]

    @property
    def model(self) -> MergedModel:
        """The models that are encoded."""
        return MergedModel(tuple(self.names), tuple(packer.model for packer in self.packers))

    def encode(self, distortion: float, progress: Progress) -> EncodedCandidate:
        """Encode a file of which each part adds an estimated `distortion` to the mean squared error of its pictures."""
        parts, errors, count = [], [], len(self.packers)
        for number, (name, packer) in enumerate(zip(self.names, self.packers, strict=True)):
            share = part_of_progress(progress, number / count, (number + 1) / count)
            candidate = packer.encode(distortion, share)
            parts.append((name, candidate.data))
            errors.append(candidate.predicted_errors)
        sums = {key: sum(error.get(key, 0.0) for error in errors) / count for error in errors for key in error}
        return EncodedCandidate(encode_parts(parts), sums)

    def decode(self, candidate: EncodedCandidate) -> HybridModel | MergedModel:
        """Decode a file, on the device and at the precision of the models."""
        model = decode_parts(read_container(candidate.data, SECTION_CONTENTS))
        device = self.packers[0].model.gaussians.positions.device
        assert isinstance(model, MergedModel)
        for part, packer in zip(model.parts, self.packers, strict=True):
            part.precision = packer.model.precision
        return model.to(device)


def mask_scene_views(model: MergedModel, views: Sequence[View]) -> list[View]:
    """Return photos of the scene, of which only the pixels count in which no other part is seen.

    Photos do not show the other parts, and that error would hide the error that compression adds.

    Raises:
        HyrfError: the other parts cover all photos.
    """
    decoded, alone = model.decode(), model.scene.decode()
    masked = []
    for view in views:
        merged = render_view(model, view.camera, decoded=decoded).rgb
        scene = render_view(model.scene, view.camera, decoded=alone).rgb
        if (masked_view := mask_differing_pixels(view, merged, scene)) is not None:
            masked.append(masked_view)
    if not masked:
        raise HyrfError(
            "other parts cover every pixel of the photos, so no loss of PSNR can be measured there",
            fix="use `target_bytes` instead of `max_psnr_drop`",
        )
    return masked
