"""Decoding of a container to a HybridModel, after all sizes that it declares have been checked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch

from hyrfpack.cameras.sampling import PhotoCameras
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import compact, paper, raw
from hyrfpack.format.arrays import group_shapes, layered_groups, read_config, to_gaussians, to_model
from hyrfpack.format.container import Container
from hyrfpack.format.exposure import decode_exposure
from hyrfpack.format.metadata import gaussian_limit, read_metadata
from hyrfpack.format.sections import (
    EXPOSURE,
    METADATA,
    PART_NAMES,
    POSITIONS,
    SECTION_CONTENTS,
    TABLE_SECTIONS,
    group_and_layer,
    layer_section,
)
from hyrfpack.format.shared import CODEC_SHARED, open_shared, read_provenance, read_section
from hyrfpack.model.config import ModelConfig
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.parallel.pool import run_tasks
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.points import LatticePoints

# Decoders of the codecs that read no other section; `compact` has those that need the positions.
DECODER_BY_CODEC = {**raw.DECODER_BY_CODEC, **paper.DECODER_BY_CODEC}


@dataclass(frozen=True)
class ModelLayout:
    """The parts of a file that are decoded.

    Attributes:
        config: configuration of the model.
        layers: number of Gaussians in each layer.
        shapes: (rows, columns) of the numbers of each section, by its type, in the order of decoding.
    """

    config: ModelConfig
    layers: list[int]
    shapes: dict[str, tuple[int, int]]


def decode_container(container: Container, fields: HybridModel | None = None) -> HybridModel:
    """Decode the model of an open file; it is safe on untrusted input.

    Args:
        container: the file.
        fields: a model whose fields and exposure map the model gets, because it shares them; None decodes them.

    Raises:
        HyrfFormatError: the file is damaged, inconsistent, or incomplete, or it holds several models.
    """
    if PART_NAMES in container.entries:
        raise HyrfFormatError(
            f"{container.name}: this file holds merged models, and one model is needed",
            fix="take one out with 'hyrfpack edit' and its `part`",
        )
    layout = read_layout(container)
    if fields is not None:
        if layout.config != fields.config:
            raise HyrfFormatError(
                f"{container.name}: its configuration is not that of the file with its fields",
                fix="copy the whole folder again",
            )
        groups = layered_groups(layout.config)
        shapes = {tag: shape for tag, shape in layout.shapes.items() if group_and_layer(tag)[0] in groups}
        layout = replace(layout, shapes=shapes)
    arrays = _decode_sections(container, layout)
    for tag, values in arrays.items():
        if not np.isfinite(values).all():
            raise HyrfFormatError(
                f"{container.name}: section '{tag}' holds numbers that are not finite",
                fix="write the file again",
            )
    if (layer_count := len(layout.layers)) > 1:
        for group in layered_groups(layout.config):
            arrays[group] = np.concatenate([arrays.pop(layer_section(group, layer)) for layer in range(layer_count)])
    if fields is not None:
        model = fields.with_gaussians(to_gaussians(arrays))
        _add_photo_sampling(model.requires_grad_(False), read_provenance(container))
        return model
    model = to_model(layout.config, arrays).requires_grad_(False)
    if EXPOSURE in container:
        section = read_section(container, EXPOSURE)
        with _add_error_context(container.name, EXPOSURE):
            model.exposure = decode_exposure(section.codec, memoryview(section.data), section.raw_length)
    _add_photo_sampling(model, read_provenance(container))
    return model


def _add_photo_sampling(model: HybridModel, provenance: dict) -> None:
    """Store with the model how finely the photos sampled it, if the provenance has their cameras."""
    photos, frame = PhotoCameras.from_provenance(provenance), model.config.frame
    model.background_spacing = photos.background_spacing
    sizes = photos.pixel_sizes(model.gaussians.positions.numpy(), frame.center, frame.scale, frame.axes)
    model.gaussians.pixel_sizes = None if sizes is None else torch.from_numpy(sizes)


def read_layout(container: Container) -> ModelLayout:
    """Check all sizes that a file declares, and return what is decoded of it.

    No section is decoded, so that a forged file cannot cause large allocations. Of a partial file, the first layer must
    be complete; further layers are used up to the first incomplete one.

    Raises:
        HyrfFormatError: a section is missing, has an unknown codec or another size than the metadata asks for, or there
            are more Gaussians than the size of the file allows.
    """
    if METADATA in container.entries and METADATA not in container:
        raise _incomplete_error(container, [tag for tag in container.entries if _is_in_first_layer(tag)])
    name, metadata, config = container.name, read_metadata(container), read_config(container)
    layers = metadata.layers or [metadata.gaussians]
    shapes, groups = {}, layered_groups(config)
    for layer, count in enumerate(layers):
        for group, shape in group_shapes(config, count).items():
            if layer == 0 or group in groups:
                shapes[layer_section(group, layer)] = shape
    _check_sections(container, shapes)
    layer_count = 1
    while layer_count < len(layers) and all(layer_section(group, layer_count) in container for group in groups):
        layer_count += 1
    layers = layers[:layer_count]
    shapes = {tag: shape for tag, shape in shapes.items() if group_and_layer(tag)[1] < layer_count}
    if any(tag not in container for tag in shapes) and container.available < container.length:
        raise _incomplete_error(container, shapes)
    if sum(layers) > (limit := gaussian_limit(container.available)):
        raise HyrfFormatError(
            f"{name}: the file claims {sum(layers):,} Gaussians, but its size allows at most {limit:,} Gaussians",
            fix="the file is damaged, copy or write it again",
        )
    return ModelLayout(config, layers, shapes)


def _is_in_first_layer(tag: str) -> bool:
    """Return whether the first layer of a model cannot be decoded without a section of this type."""
    return tag in SECTION_CONTENTS and tag != EXPOSURE and group_and_layer(tag)[1] == 0


def _incomplete_error(container: Container, tags: Iterable[str]) -> HyrfFormatError:
    """Return the error for a partial file that ends before the last of the sections that decoding needs."""
    length, needed = container.length, max(container.entries[tag].end for tag in tags)
    if not any(group_and_layer(tag)[1] for tag in container.entries):
        fix = f"the file has no layers, so that only the whole file can be read; {container.partial_file_fix}"
    elif container.stored < needed:
        fix = f"read a larger part of the file, at least its first {needed:,} bytes"
    else:
        fix = f"read a larger part of the file, with a `fraction` of at least {_min_fraction(needed, length):g}"
    return HyrfFormatError(
        f"{container.name}: the model needs the first {needed:,} of {length:,} bytes, but only "
        f"{container.available:,} are available or allowed",
        fix=fix,
    )


def _min_fraction(needed: int, length: int) -> float:
    """Return the smallest fraction, in thousandths, of `length` bytes that holds the first `needed` bytes."""
    return next(n / 1000 for n in range(needed * 1000 // length, 1001) if int(n / 1000 * length) >= needed)


def _check_sections(container: Container, shapes: dict[str, tuple[int, int]]) -> None:
    """Check the codec and the decoded size of each section that the metadata asks for."""
    for tag, (rows, columns) in shapes.items():
        entry, name = container.entries.get(tag), container.name
        if entry is not None and entry.codec == CODEC_SHARED:
            if tag not in container:
                continue  # The reference lies past the available bytes; `read_layout` says how many are needed.
            shared = open_shared(container)
            entry, name = shared.entries[tag], shared.name
            if tag in TABLE_SECTIONS and entry.codec == compact.CODEC_GROUPS:
                raise HyrfFormatError(
                    f"{name}: section '{tag}' has codec {entry.codec}, which depends on the Gaussians of its own file, "
                    f"and {container.name} refers to it",
                    fix="write both files again",
                )
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


def _decode_sections(container: Container, layout: ModelLayout) -> dict[str, np.ndarray]:
    """Decode the sections of a layout in parallel; return their numbers by the type of the section."""
    config, shapes, name = layout.config, layout.shapes, container.name
    sections = {tag: read_section(container, tag) for tag in shapes}
    arrays: dict[str, np.ndarray] = {}
    # Lattice points by layer, if positions are on a lattice. Other sections need them for decoding.
    points: dict[int, LatticePoints] = {}

    def decode_positions(layer: int) -> None:
        tag = layer_section(POSITIONS, layer)
        if sections[tag].codec == compact.CODEC_POINTS:
            with _add_error_context(name, tag):
                arrays[tag], points[layer] = compact.decode_positions(
                    memoryview(sections[tag].data), layout.layers[layer], config
                )

    run_tasks(decode_positions, len(layout.layers))
    remaining_tags = [tag for tag in shapes if tag not in arrays]

    def decode(index: int) -> None:
        tag = remaining_tags[index]
        group, layer = group_and_layer(tag)
        codec, data = sections[tag].codec, memoryview(sections[tag].data)
        with _add_error_context(name, tag):
            if codec in DECODER_BY_CODEC:
                arrays[tag] = DECODER_BY_CODEC[codec](data, shapes[tag])
            else:
                arrays[tag] = compact.decode_section(group, codec, data, shapes[tag], config, points.get(layer))

    run_tasks(decode, len(remaining_tags))
    return arrays


@contextmanager
def _add_error_context(name: str, tag: str) -> Iterator[None]:
    """Add the file and the section to the message of a format error."""
    try:
        yield
    except HyrfFormatError as error:
        raise error.with_text(f"{name}: section '{tag}': {error.problem}") from error
    except DamagedDataError as error:
        raise HyrfFormatError(f"{name}: section '{tag}': {error}", fix="copy or write the file again") from error
