"""Encoding of a HybridModel to the bytes of a `.hyrf` file and back; `docs/reference/format.md` specifies each byte."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.capture import quantized_provenance
from hyrfpack.checks import check_type
from hyrfpack.device import choose_device
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import compact, paper, raw
from hyrfpack.format.arrays import MODEL_RULES, check_rules, group_shapes, parse_config, to_model
from hyrfpack.format.container import Container, Section, raw_bytes_limit, read_container, write_container
from hyrfpack.format.exposure import decode_exposure, encode_exposure
from hyrfpack.format.info import SectionSize, section_sizes
from hyrfpack.format.metadata import Metadata, read_metadata
from hyrfpack.format.run_folder import find_model
from hyrfpack.format.sections import (
    EXPOSURE,
    LAYERED_SECTIONS,
    NON_PARAMETER_SECTIONS,
    POSITIONS,
    SECTION_CONTENTS,
    group_and_layer,
    layer_section,
)
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.parallel.pool import run_tasks
from hyrfpack.quant import DamagedDataError

PROFILES: dict[str, Callable[..., tuple[list[Section], dict]]] = {
    "raw": raw.encode,
    "paper": paper.encode,
    "compact": compact.encode,
}
DEFAULT_PROFILE = "compact"  # `hyrfpack.compress_model` and the command line use it where no profile is named
# A file may declare this many Gaussians for each of its bytes, plus a constant, because equal Gaussians take no bytes.
MAX_GAUSSIANS_PER_FILE_BYTE = 32
EXTRA_GAUSSIANS_PER_FILE = 1 << 18
# Decoders of the codecs that read no other section; `compact` has those that need the positions.
DECODER_BY_CODEC = {**raw.DECODER_BY_CODEC, **paper.DECODER_BY_CODEC}


@dataclass(frozen=True)
class CompressionReport:
    """Size of a written file and the error that compression added.

    Attributes:
        profile: "raw", "paper" or "compact".
        gaussians: number of Gaussians in the file.
        bytes_before: bytes of all parameters as float32.
        bytes_after: bytes of the file.
        sections: bytes of each section before and after; header, table of contents and padding are the rest.
        shares: profile "compact" only: the fraction of the error in renders that comes from each section, and from
            the "pruned" Gaussians.
        error: profile "compact" only: the mean squared error of renders, colours in [0, 1]; an estimate where the file
            was not rendered.
        found: the outcome of a search for a target size or quality, as a sentence.
        finetuned: profile "compact" only: whether the quantised numbers were fine-tuned on photos.
        sensitivity: profile "compact" only: how much each number changes renders
            (`hyrfpack.compress.sensitivity.Sensitivity`), by which the steps were chosen. It is kept so that a report
            page need not measure it again.
        file: path of the file that was written.
    """

    profile: str
    gaussians: int
    bytes_before: int
    bytes_after: int
    sections: list[SectionSize]
    shares: dict[str, float] = field(default_factory=dict)
    error: float | None = None
    found: str = ""
    finetuned: bool = False
    sensitivity: Any = field(default=None, repr=False, compare=False)
    file: str = ""

    def to_dict(self) -> dict:
        """Return all fields except the sensitivity as plain numbers, strings, lists and dictionaries for JSON."""
        values = asdict(replace(self, sensitivity=None))
        del values["sensitivity"]
        return values


def encode_model(model: HybridModel, profile: str = "raw", provenance: dict | None = None, **settings: Any) -> bytes:
    """Encode a model as the bytes of a `.hyrf` file. The same model and settings give the same bytes.

    Args:
        model: the model, on any device.
        profile: "raw" (float32, exact), "paper" (see `hyrfpack.format.paper`) or "compact" (`hyrfpack.format.compact`).
        provenance: any JSON object that says where the model comes from. It is stored for readers of the file.
        settings: settings of the profile: for "paper" the fields of `paper.PaperSettings`, for "compact" the
            `quantized` numbers from `hyrfpack.compress_model`; "raw" has none.

    Raises:
        HyrfError: the profile does not exist, or a parameter is NaN, infinite or too large for the profile.
        TypeError: `model` is not a HybridModel.
    """
    check_type("model", model, HybridModel)
    if profile not in PROFILES:
        raise HyrfError(f"there is no profile '{profile}'", fix=f"use one of: {', '.join(PROFILES)}")
    sections, used = PROFILES[profile](model, **settings)
    counts = [section.raw_length // 12 for section in sections if group_and_layer(section.type)[0] == POSITIONS]
    layers = counts if len(counts) > 1 else []
    metadata = Metadata(
        profile, sum(counts), model.config.to_dict(), MODEL_RULES, used, provenance or {}, layers=layers
    )
    is_compact = profile == "compact"
    minor = int(is_compact)  # readers of version 1.0 can read every profile but this one
    if model.exposure is not None:
        sections, minor = [encode_exposure(model.exposure), *sections], 2
    sections = [metadata.to_section(deflate=is_compact), *sections]
    stored, raw_length = (sum(sizes) for sizes in zip(*((len(s.data), s.raw_length) for s in sections), strict=True))
    if raw_length > raw_bytes_limit(stored) or sum(counts) > gaussian_limit(stored):
        raise HyrfError(
            f"{raw_length:,} bytes of almost equal numbers would compress to {stored:,} bytes, a ratio that readers "
            "refuse",
            fix="use profile 'raw' for this model",
        )
    return write_container(sections, minor=minor)


def gaussian_limit(file_length: int) -> int:
    """Return the largest number of Gaussians that a file of `file_length` bytes may hold."""
    return MAX_GAUSSIANS_PER_FILE_BYTE * file_length + EXTRA_GAUSSIANS_PER_FILE


def decode_model(
    data: bytes | memoryview,
    device: str | torch.device = "cpu",
    name: str = "the data",
    fraction: float | None = None,
) -> HybridModel:
    """Decode a model from the bytes of a `.hyrf` file. It is safe on untrusted input.

    The parameters do not require gradients, so that renders carry no autograd graph; `model.requires_grad_()` changes
    that.

    Args:
        data: the bytes of the file.
        device: device of the parameters, see `hyrfpack.device.choose_device`.
        name: name of the file in error messages.
        fraction: read only this fraction of the file, 0 to 1, from its first byte; the rest may be missing. Files of
            profile "compact" are stored in layers, and the complete layers make a coarser model. None reads the whole
            file.

    Raises:
        HyrfFormatError: the bytes are damaged, inconsistent, or of a newer format version.
        HyrfError: the device is not available.
    """
    device = choose_device(device)
    return _decode(read_container(data, SECTION_CONTENTS, name, fraction)).to(device)


def save_model(
    model: HybridModel,
    path: str | os.PathLike[str],
    profile: str = "raw",
    provenance: dict | None = None,
    *,
    overwrite: bool = True,
    **settings: Any,
) -> CompressionReport:
    """Write a model to a `.hyrf` file, completely or not at all.

    The other arguments and errors are those of `encode_model`.

    Args:
        overwrite: replace a file at `path`. Without it, a free file name in the same folder is used; `report.file`
            is the path that was written.

    Raises:
        HyrfError: the file cannot be written, or an error of `encode_model`.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load_model("bonsai.hyrf")
        >>> report = hyrfpack.save_model(model, "copy.hyrf", provenance={"note": "by hand"})
        >>> report.profile, report.gaussians == len(model)
        ('raw', True)
    """
    return write_model(encode_model(model, profile, provenance, **settings), path, overwrite=overwrite)


def write_model(data: bytes, path: str | os.PathLike[str], *, overwrite: bool = True) -> CompressionReport:
    """Write the bytes that `encode_model` returned to a file, completely or not at all.

    `overwrite` is that of `save_model`.

    Raises:
        HyrfError: the file cannot be written.
    """
    written = write_atomic(path, data, overwrite=overwrite)
    container = read_container(data, SECTION_CONTENTS)
    metadata, sizes = read_metadata(container), section_sizes(container)
    before = sum(size.before for size in sizes if size.type not in NON_PARAMETER_SECTIONS)
    return CompressionReport(metadata.profile, metadata.gaussians, before, len(data), sizes, file=str(written))


def load_model(
    path: str | os.PathLike[str], device: str | torch.device = "cpu", fraction: float | None = None
) -> HybridModel:
    """Read a model from a `.hyrf` file, or from the folder of a training run.

    The other arguments and the errors are those of `decode_model`.

    Args:
        path: a `.hyrf` file, or the folder of a training run.

    Raises:
        HyrfFormatError: there is no readable file at `path`, or an error of `decode_model`.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load_model("bonsai.hyrf")
        >>> model.gaussians.positions.shape[1], model.gaussians.positions.requires_grad
        (3, False)
    """
    device = choose_device(device)
    with Container.open(path, SECTION_CONTENTS, fraction) as container:
        return _decode(container).to(device)


def repack(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    profile: str = "raw",
    fraction: float | None = None,
    *,
    overwrite: bool = True,
    **settings: Any,
) -> CompressionReport:
    """Rewrite a `.hyrf` file with profile "raw" or "paper", and copy its provenance.

    Except for profile "raw", the cameras in the provenance are rounded, see `quantized_provenance`. The other
    arguments and the errors are those of `encode_model`, `load_model` and `save_model`.

    Args:
        overwrite: replace a file at `target`. Without it, an existing file is an error. A file that appears during the
            call is kept, and a free file name in the same folder is used, which the report contains.
    """
    source = find_model(source)
    Outputs(source, overwrite=overwrite).file(target)
    model, provenance = load_with_provenance(source, fraction)
    stored_provenance = provenance if profile == "raw" else quantized_provenance(provenance, model.config.frame.scale)
    return save_model(model, target, profile, stored_provenance, overwrite=overwrite, **settings)


def load_with_provenance(path: str | os.PathLike[str], fraction: float | None = None) -> tuple[HybridModel, dict]:
    """Read a model and its provenance. The arguments and the errors are those of `load_model`."""
    with Container.open(path, SECTION_CONTENTS, fraction) as container:
        return _decode(container), read_metadata(container).provenance


def _decode(container: Container) -> HybridModel:
    name, metadata = container.name, read_metadata(container)
    try:
        check_rules(metadata.rules)
        config = parse_config(metadata.config)
    except HyrfFormatError as error:
        raise error.with_text(f"{name}: {error.problem}") from error
    layers = metadata.layers or [metadata.gaussians]
    shapes = {}
    for layer, count in enumerate(layers):
        for group, shape in group_shapes(config, count).items():
            if layer == 0 or group in LAYERED_SECTIONS:
                shapes[layer_section(group, layer)] = shape
    # Every size is checked before the first section is decoded, so that a forged file cannot cause large allocations.
    for tag, (rows, columns) in shapes.items():
        entry = container.entries.get(tag)
        if entry is None:
            raise HyrfFormatError(f"{name}: there is no section '{tag}'", fix="the file is incomplete, write it again")
        if entry.codec not in DECODER_BY_CODEC and entry.codec not in compact.SECTIONS_BY_CODEC:
            raise HyrfFormatError(f"{name}: section '{tag}' has the unknown codec {entry.codec}", fix="update hyrfpack")
        if entry.raw_length != 4 * rows * columns:
            raise HyrfFormatError(
                f"{name}: section '{tag}' says it decodes to {entry.raw_length} bytes and the metadata asks for "
                f"{4 * rows * columns}",
                fix="the file is damaged, write it again",
            )
    # In a partial file, the first layer must be complete; further layers are used up to the first incomplete one.
    layer_count = 1
    while layer_count < len(layers) and all(
        layer_section(group, layer_count) in container for group in LAYERED_SECTIONS
    ):
        layer_count += 1
    used_tags = [tag for tag in shapes if group_and_layer(tag)[1] < layer_count]
    if any(tag not in container for tag in used_tags) and container.available < container.length:
        needed = max(container.entries[tag].end for tag in used_tags)
        raise HyrfFormatError(
            f"{name}: the model needs the first {needed:,} of {container.length:,} bytes, but only "
            f"{container.available:,} are available or allowed",
            fix="read a larger part of the file",
        )
    if sum(layers[:layer_count]) > (limit := gaussian_limit(container.available)):
        raise HyrfFormatError(
            f"{name}: the file claims {sum(layers[:layer_count]):,} Gaussians, but its size allows at most {limit:,} "
            "Gaussians",
            fix="the file is damaged, copy or write it again",
        )
    sections = {tag: container[tag] for tag in used_tags}
    arrays: dict[str, np.ndarray] = {}
    points = {}  # lattice points by layer, if positions are on a lattice; other sections need them for decoding

    def decode_positions(layer: int) -> None:
        tag = layer_section(POSITIONS, layer)
        if sections[tag].codec == compact.CODEC_POINTS:
            with _add_error_context(name, tag):
                arrays[tag], points[layer] = compact.decode_positions(
                    memoryview(sections[tag].data), layers[layer], config
                )

    run_tasks(decode_positions, layer_count)
    rest = [tag for tag in used_tags if tag not in arrays]

    def decode(index: int) -> None:
        tag = rest[index]
        group, layer = group_and_layer(tag)
        codec, data = sections[tag].codec, memoryview(sections[tag].data)
        with _add_error_context(name, tag):
            if codec in DECODER_BY_CODEC:
                arrays[tag] = DECODER_BY_CODEC[codec](data, shapes[tag])
            else:
                arrays[tag] = compact.decode_section(group, codec, data, shapes[tag], config, points.get(layer))

    run_tasks(decode, len(rest))
    for tag, values in arrays.items():
        if not np.isfinite(values).all():
            raise HyrfFormatError(
                f"{name}: section '{tag}' holds numbers that are not finite",
                fix="write the file again",
            )
    for group in LAYERED_SECTIONS if layer_count > 1 else ():
        arrays[group] = np.concatenate([arrays.pop(layer_section(group, layer)) for layer in range(layer_count)])
    model = to_model(config, arrays).requires_grad_(False)
    if EXPOSURE in container:
        section = container[EXPOSURE]
        with _add_error_context(name, EXPOSURE):
            model.exposure = decode_exposure(section.codec, memoryview(section.data), section.raw_length)
    return model


@contextmanager
def _add_error_context(name: str, group: str) -> Iterator[None]:
    """Add the file and the section to the message of a format error."""
    try:
        yield
    except HyrfFormatError as error:
        raise error.with_text(f"{name}: section '{group}': {error.problem}") from error
    except DamagedDataError as error:
        raise HyrfFormatError(f"{name}: section '{group}': {error}", fix="copy or write the file again") from error
