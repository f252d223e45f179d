"""HybridModel <-> `.hyrf` bytes. What each byte means is in `docs/format.md`."""

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
from hyrfpack.format.arrays import RULES, check_rules, group_shapes, parse_config, to_model
from hyrfpack.format.container import Container, Section, raw_limit, read_container, write_container
from hyrfpack.format.exposure import decode_exposure, exposure_section
from hyrfpack.format.info import SectionSize, section_sizes
from hyrfpack.format.metadata import Metadata, read_metadata
from hyrfpack.format.run_folder import find_model
from hyrfpack.format.sections import (
    EXPOSURE,
    LAYERED,
    NON_PARAMETERS,
    POSITIONS,
    SECTIONS,
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
DEFAULT_PROFILE = "compact"  # of `compress`
# Gaussians that a file may have: so many for each of its bytes, and some that are free, as equal ones take no bytes.
GAUSSIANS_A_BYTE, FREE_GAUSSIANS = 32, 1 << 18
DECODERS = {**raw.DECODERS, **paper.DECODERS}  # of codecs that need no other section


@dataclass(frozen=True)
class CompressionReport:
    """What a file takes, and what was lost.

    Attributes:
        profile: "raw", "paper" or "compact".
        gaussians: how many.
        bytes_before: of all parameters as float32.
        bytes_after: of the file.
        sections: bytes of each section before and after; header, table of contents and padding are the rest.
        shares: of "compact": what part of the error in pictures comes from each section, and from what is "pruned".
        error: of "compact": the mean squared error that pictures got, colours in [0, 1]; by estimate where the file was
            not drawn.
        found: in words, what a search came to.
        finetuned: of "compact": whether its numbers were fitted to photos.
        sensitivity: of "compact": what each number does to pictures (`hyrfpack.compress.sensitivity.Sensitivity`), by
            which it was packed; kept so that a page about the file need not measure it again.
        file: the path that was written.
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
        """All but the sensitivity, as plain numbers, strings, lists and dictionaries, ready for JSON."""
        values = asdict(replace(self, sensitivity=None))
        del values["sensitivity"]
        return values


def encode_model(model: HybridModel, profile: str = "raw", provenance: dict | None = None, **settings: Any) -> bytes:
    """Write a model as the bytes of a `.hyrf` file: same model, same settings, same bytes.

    Args:
        model: on any device.
        profile: "raw" (float32, exact), "paper" (see `hyrfpack.format.paper`) or "compact" (`hyrfpack.format.compact`).
        provenance: where the model comes from, any JSON object; kept for people.
        settings: of the profile: the fields of `paper.PaperSettings`; for "compact" what `hyrfpack.compress`
            decided, its `quantized` numbers; "raw" has none.

    Raises:
        HyrfError: there is no such profile, or a parameter is NaN, infinite or too large for the profile.
        TypeError: `model` is no HybridModel.
    """
    check_type("model", model, HybridModel)
    if profile not in PROFILES:
        raise HyrfError(f"there is no profile '{profile}'; use one of: {', '.join(PROFILES)}")
    sections, used = PROFILES[profile](model, **settings)
    counts = [section.raw_length // 12 for section in sections if group_and_layer(section.type)[0] == POSITIONS]
    layers = counts if len(counts) > 1 else []
    metadata = Metadata(profile, sum(counts), model.config.to_dict(), RULES, used, provenance or {}, layers=layers)
    is_compact = profile == "compact"  # without a map, all else is read by readers of version 1.0 too
    minor = int(is_compact)
    if model.exposure is not None:
        sections, minor = [exposure_section(model.exposure), *sections], 2
    sections = [metadata.to_section(deflate=is_compact), *sections]
    stored, raw_length = (sum(sizes) for sizes in zip(*((len(s.data), s.raw_length) for s in sections), strict=True))
    if raw_length > raw_limit(stored) or sum(counts) > most_gaussians(stored):
        raise HyrfError(
            f"{raw_length:,} bytes of numbers, nearly all alike, would take only {stored:,}, and readers do not "
            "unpack so much from so few; keep this model as profile raw"
        )
    return write_container(sections, minor=minor)


def most_gaussians(file_length: int) -> int:
    """Most Gaussians that a file of `file_length` bytes may hold."""
    return GAUSSIANS_A_BYTE * file_length + FREE_GAUSSIANS


def decode_model(
    data: bytes | memoryview,
    device: str | torch.device = "cpu",
    name: str = "the data",
    fraction: float | None = None,
) -> HybridModel:
    """Read a model from the bytes of a `.hyrf` file. Safe on any input.

    Its parameters want no gradients, so that pictures of it are plain numbers; `model.requires_grad_()` changes that.

    Args:
        device: where the parameters shall live, see `hyrfpack.device.choose_device`.
        name: what error messages call the file.
        fraction: read only this part of the file, from its first byte, 0 to 1; the rest may be missing. Files of
            profile "compact" come in layers: what is whole of them makes a coarser model. None wants the whole file.

    Raises:
        HyrfFormatError: the bytes are damaged, contradict themselves, or come from a newer version.
        HyrfError: there is no such device.
    """
    device = choose_device(device)
    return _decode(read_container(data, SECTIONS, name, fraction)).to(device)


def save(
    model: HybridModel,
    path: str | os.PathLike[str],
    profile: str = "raw",
    provenance: dict | None = None,
    *,
    overwrite: bool = True,
    **settings: Any,
) -> CompressionReport:
    """Write a model to a `.hyrf` file, whole or not at all. Arguments and errors as `encode_model`.

    Args:
        overwrite: replace a file at `path`. Without it, the file gets a free name beside, which the report tells.

    Raises:
        HyrfError: also when the file cannot be written.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load("bonsai.hyrf")
        >>> report = hyrfpack.save(model, "copy.hyrf", provenance={"note": "by hand"})
        >>> report.profile, report.gaussians == len(model)
        ('raw', True)
    """
    return write_model(encode_model(model, profile, provenance, **settings), path, overwrite=overwrite)


def write_model(data: bytes, path: str | os.PathLike[str], *, overwrite: bool = True) -> CompressionReport:
    """Write what `encode_model` made to a file, whole or not at all. `overwrite` as of `save`.

    Raises:
        HyrfError: the file cannot be written.
    """
    written = write_atomic(path, data, overwrite=overwrite)
    container = read_container(data, SECTIONS)
    metadata, sizes = read_metadata(container), section_sizes(container)
    before = sum(size.before for size in sizes if size.type not in NON_PARAMETERS)
    return CompressionReport(metadata.profile, metadata.gaussians, before, len(data), sizes, file=str(written))


def load(
    path: str | os.PathLike[str], device: str | torch.device = "cpu", fraction: float | None = None
) -> HybridModel:
    """Read a model from a `.hyrf` file, or from the folder of a run.

    Arguments and errors as `decode_model`, and where no file can be read.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load("bonsai.hyrf")
        >>> model.gaussians.positions.shape[1], model.gaussians.positions.requires_grad
        (3, False)
    """
    device = choose_device(device)
    with Container.open(path, SECTIONS, fraction) as container:
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
    """Rewrite a `.hyrf` file with profile "raw" or "paper"; its provenance goes along, see `quantized_provenance`.

    Arguments and errors as `encode_model`, `load` and `save`.

    Args:
        overwrite: replace a file at `target`. Without it, one that is there is an error, and one that appears in the
            meantime is kept: the result gets a free name beside it, which the report names.
    """
    source = find_model(source)
    Outputs(source, overwrite=overwrite).file(target)
    model, provenance = load_with_provenance(source, fraction)
    kept = provenance if profile == "raw" else quantized_provenance(provenance, model.config.frame.scale)
    return save(model, target, profile, kept, overwrite=overwrite, **settings)


def load_with_provenance(path: str | os.PathLike[str], fraction: float | None = None) -> tuple[HybridModel, dict]:
    """A model and where it comes from. Arguments and errors as `load`."""
    with Container.open(path, SECTIONS, fraction) as container:
        return _decode(container), read_metadata(container).provenance


def _decode(container: Container) -> HybridModel:
    name, metadata = container.name, read_metadata(container)
    try:
        check_rules(metadata.rules)
        config = parse_config(metadata.config)
    except HyrfFormatError as error:
        raise HyrfFormatError(f"{name}: {error}") from error
    layers = metadata.layers or [metadata.gaussians]
    shapes = {}
    for layer, count in enumerate(layers):
        for group, shape in group_shapes(config, count).items():
            if layer == 0 or group in LAYERED:
                shapes[layer_section(group, layer)] = shape
    # Every size is checked before the first section is decoded.
    for tag, (rows, columns) in shapes.items():
        entry = container.entries.get(tag)
        if entry is None:
            raise HyrfFormatError(f"{name}: there is no section '{tag}'; the file is incomplete, write it again")
        if entry.codec not in DECODERS and entry.codec not in compact.CODECS:
            raise HyrfFormatError(f"{name}: section '{tag}' has the unknown codec {entry.codec}; update hyrfpack")
        if entry.raw_length != 4 * rows * columns:
            raise HyrfFormatError(
                f"{name}: section '{tag}' says it decodes to {entry.raw_length} bytes and the metadata asks for "
                f"{4 * rows * columns}; the file is damaged, write it again"
            )
    # Of a file that is not all there: the first layer must be, further ones up to the first that lacks something.
    there = 1
    while there < len(layers) and all(layer_section(group, there) in container for group in LAYERED):
        there += 1
    wanted = [tag for tag in shapes if group_and_layer(tag)[1] < there]
    if any(tag not in container for tag in wanted) and container.available < container.length:
        needed = max(container.entries[tag].end for tag in wanted)
        raise HyrfFormatError(
            f"{name}: the first {needed:,} of {container.length:,} bytes make a model, and only "
            f"{container.available:,} are there or allowed; take more of the file"
        )
    if sum(layers[:there]) > (most := most_gaussians(container.available)):
        raise HyrfFormatError(
            f"{name}: it says {sum(layers[:there]):,} Gaussians, and so few bytes may hold {most:,}; the file is "
            "damaged, copy or write it again"
        )
    sections = {tag: container[tag] for tag in wanted}
    arrays: dict[str, np.ndarray] = {}
    points = {}  # of each layer with positions on a lattice, on which other sections lean

    def decode_positions(layer: int) -> None:
        tag = layer_section(POSITIONS, layer)
        if sections[tag].codec == compact.CODEC_POINTS:
            with _naming(name, tag):
                arrays[tag], points[layer] = compact.decode_positions(
                    memoryview(sections[tag].data), layers[layer], config
                )

    run_tasks(decode_positions, there)
    rest = [tag for tag in wanted if tag not in arrays]

    def decode(index: int) -> None:
        tag = rest[index]
        group, layer = group_and_layer(tag)
        codec, data = sections[tag].codec, memoryview(sections[tag].data)
        with _naming(name, tag):
            if codec in DECODERS:
                arrays[tag] = DECODERS[codec](data, shapes[tag])
            else:
                arrays[tag] = compact.decode_section(group, codec, data, shapes[tag], config, points.get(layer))

    run_tasks(decode, len(rest))
    for tag, values in arrays.items():
        if not np.isfinite(values).all():
            raise HyrfFormatError(f"{name}: section '{tag}' holds numbers that are not finite; write the file again")
    for group in LAYERED if there > 1 else ():
        arrays[group] = np.concatenate([arrays.pop(layer_section(group, layer)) for layer in range(there)])
    model = to_model(config, arrays).requires_grad_(False)
    if EXPOSURE in container:
        section = container[EXPOSURE]
        with _naming(name, EXPOSURE):
            model.exposure = decode_exposure(section.codec, memoryview(section.data), section.raw_length)
    return model


@contextmanager
def _naming(name: str, group: str) -> Iterator[None]:
    """Say which file and section an error is of."""
    try:
        yield
    except (HyrfFormatError, DamagedDataError) as error:
        raise HyrfFormatError(f"{name}: section '{group}': {error}") from error
