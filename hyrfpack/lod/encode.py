"""Encode the files of a scene folder: one with the shared sections, and chunks that refer to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from hyrfpack.compress.channels import MIN_STEP_CODE, requantize_channel
from hyrfpack.compress.plan import snap_to_lattice
from hyrfpack.format import raw
from hyrfpack.format.arrays import grid_configs, layered_groups, residual_widths, to_arrays
from hyrfpack.format.compact.channels import (
    BASIS_BYTES,
    Channel,
    decode_channel,
    encode_channel,
    read_basis,
    read_channel_header,
)
from hyrfpack.format.compact.groups import encode_usage_classes
from hyrfpack.format.compact.plan import USAGE_CLASS_COUNT, build_step_groups
from hyrfpack.format.compact.quantized import (
    CODEC_CHANNELS,
    CODEC_GROUPS,
    CODEC_POINTS,
    CODEC_RESIDUALS,
    CODEC_STATED_GROUPS,
    LOGIT_COLUMNS,
)
from hyrfpack.format.container import Container, Section, read_container, write_container
from hyrfpack.format.metadata import Metadata, read_metadata, writer_name
from hyrfpack.format.sections import (
    COLORS,
    LOGIT_SECTIONS,
    POSITIONS,
    SECTION_CONTENTS,
    TABLE_SECTIONS,
    layer_section,
)
from hyrfpack.format.shared import SHARED_SECTIONS, refer_to_section, self_contained_bytes
from hyrfpack.format.versions import lowest_minor_version
from hyrfpack.lod.residuals import LayerResiduals
from hyrfpack.model import HybridModel
from hyrfpack.quant.points import LatticePoints, decode_points, encode_points

# A number that is stored as its difference from a prediction changes by up to half a step if a chunk predicts it from
# other neighbours. So its step is made finer by this many octaves; each halves the step and lowers the error by 6 dB.
FINER_STEP_OCTAVES = 1
_CODES_PER_OCTAVE = 8


@dataclass(frozen=True)
class LayerNumbers:
    """The quantised numbers of a layer of a compact file.

    Attributes:
        points: lattice points of its Gaussians, with their classes.
        values: five channels (N,) float64: three of colour in the file's basis, then scale and opacity logit.
        headers: mean, weight of the prediction, and step codes of each channel.
        residuals: the residuals of each section; empty without any.
    """

    points: LatticePoints
    values: list[np.ndarray]
    headers: list[tuple[np.float32, int, np.ndarray]]
    residuals: list[LayerResiduals]


class ChunkEncoder:
    """Encodes chunks of a model and keeps the numbers of its file, exactly or nearly so.

    Attributes:
        model: the model of the file, on the CPU.
        metadata: the metadata of the file.
        is_compact: whether the file and its chunks have the profile "compact"; otherwise chunks have "raw".
        profile: profile of the chunks.
        shared_name: name of the shared file.
        shared_bytes: bytes of the shared file.
    """

    def __init__(self, container: Container, model: HybridModel, shared_name: str) -> None:
        """Read the file of a model; it stays open while chunks are encoded."""
        self.model, self.metadata, self.shared_name = model, read_metadata(container), shared_name
        self._file = read_container(self_contained_bytes(container), SECTION_CONTENTS, container.name)
        self.is_compact = self._file.entries[POSITIONS].codec == CODEC_POINTS
        self.profile = "compact" if self.is_compact else "raw"
        self.shared_bytes = self._encode_shared()
        self._shared = read_container(self.shared_bytes, SECTION_CONTENTS)

    def encode_subset(self, index: np.ndarray) -> tuple[bytes, np.ndarray]:
        """Encode the Gaussians at ascending `index` (n,) int64.

        Positions are kept exactly. So are logits of raw files, and of compact files where they were stored without
        prediction; others get steps that are finer by FINER_STEP_OCTAVES octaves.

        Returns:
            The bytes of the chunk, and (n,) the index of the Gaussian at each place of the chunk.
        """
        if not self.is_compact:
            return self._encode_raw(self.model.subset(torch.from_numpy(index))), index
        sections: list[Section] = []
        counts: list[int] = []
        order, start = [], 0
        for layer in self._layers:
            count = len(layer.points.classes)
            members = index[(index >= start) & (index < start + count)] - start
            if len(members):
                points = LatticePoints(layer.points.cells[members], layer.points.classes[members], layer.points.bits)
                data, places, points = encode_points(points, keep_bits=True)
                members = members[places]
                channels = [
                    requantize_channel(values[members], points.classes, *_exact_or_finer(*header))
                    for values, header in zip(layer.values, layer.headers, strict=True)
                ]
                sections += self._make_sections(len(counts), points, data, channels)
                for residuals in layer.residuals:
                    stored = residuals.encode_subset(members, points.classes)
                    sections.append(self._make_residual_section(residuals.group, len(counts), stored, len(members)))
                counts.append(len(members))
                order.append(members + start)
            start += count
        return self._encode_chunk(sections, counts), np.concatenate(order or [index])

    def encode_gaussians(self, model: HybridModel) -> bytes:
        """Encode Gaussians that are not in the file, with the steps that are most common in its first layer."""
        if not self.is_compact:
            return self._encode_raw(model)
        layer = self._layers[0]
        most_common_class = int(np.bincount(layer.points.classes, minlength=1).argmax())
        arrays = to_arrays(model)
        cube = model.cube_coords(model.gaussians.positions.detach().double()).numpy()
        classes = np.full(len(model), most_common_class, np.uint8)
        data, order, points = encode_points(snap_to_lattice(cube, classes, layer.points.bits), keep_bits=True)
        numbers = np.concatenate([arrays[group] for group in LOGIT_SECTIONS], axis=1)[order].astype(np.float64)
        numbers[:, :3] = numbers[:, :3] @ self._basis
        channels = [
            requantize_channel(values, classes, codes, np.float32(values.mean() if len(values) else 0))
            for values, (_, _, codes) in zip(numbers.T, layer.headers, strict=True)
        ]
        sections = self._make_sections(0, points, data, channels)
        for residuals in layer.residuals:
            stored = residuals.encode_values(arrays[residuals.group][order], points.classes)
            sections.append(self._make_residual_section(residuals.group, 0, stored, len(model)))
        return self._encode_chunk(sections, [len(model)])

    @cached_property
    def _basis(self) -> np.ndarray:
        """The basis of colour logits, (3, 3) float64."""
        return read_basis(memoryview(self._file[COLORS].data)[:BASIS_BYTES]).astype(np.float64)

    @cached_property
    def _layers(self) -> list[LayerNumbers]:
        """The quantised numbers of each layer of the file."""
        counts, layers = self.metadata.layers or [self.metadata.gaussians], []
        for number, count in enumerate(counts):
            points = decode_points(self._file[layer_section(POSITIONS, number)].data, count)
            values, headers = [], []
            for group in LOGIT_SECTIONS:
                start = BASIS_BYTES if group == COLORS else 0
                data = memoryview(self._file[layer_section(group, number)].data)[start:]
                for _ in range(LOGIT_COLUMNS[group]):
                    headers.append(read_channel_header(data))
                    numbers, data = decode_channel(data, points.classes)
                    values.append(numbers)
            residuals = [
                LayerResiduals.from_section(
                    group, memoryview(self._file[layer_section(group, number)].data), points.classes, columns
                )
                for group, columns in self._residual_widths.items()
            ]
            layers.append(LayerNumbers(points, values, headers, residuals))
        return layers

    @cached_property
    def _residual_widths(self) -> dict[str, int]:
        """The number of columns of each section of residuals."""
        return residual_widths(self.model.config)

    def _encode_shared(self) -> bytes:
        """Return the bytes of the shared file: a model without Gaussians."""
        config = self.model.config
        empty = [Section(group, raw.CODEC_FLOAT32, b"", 0) for group in layered_groups(config)]
        sections = [self._file[tag] for tag in SHARED_SECTIONS if tag in self._file]
        for place, section in enumerate(sections):
            if section.type in TABLE_SECTIONS and section.codec == CODEC_GROUPS:
                groups = build_step_groups(section.type, config, self._layers[0].points)
                uses = encode_usage_classes(groups, grid_configs(config)[section.type].offsets, USAGE_CLASS_COUNT)
                sections[place] = replace(section, codec=CODEC_STATED_GROUPS, data=uses + bytes(section.data))
        metadata = replace(self.metadata, gaussians=0, layers=[], writer=writer_name())
        return _encode_file(metadata, [*sections, *empty], deflate=self.is_compact)

    def _make_sections(
        self, layer: int, points: LatticePoints, data: bytes, channels: Sequence[Channel]
    ) -> list[Section]:
        """Return the sections of a layer: encoded positions `data`, and the logits of `channels`."""
        count = len(points.classes)
        sections = [Section(layer_section(POSITIONS, layer), CODEC_POINTS, data, 12 * count)]
        rest = [encode_channel(channel, points.classes) for channel in channels]
        for group in LOGIT_SECTIONS:
            columns = LOGIT_COLUMNS[group]
            stored = (self._basis.astype("<f4").tobytes() if group == COLORS else b"") + b"".join(rest[:columns])
            sections.append(Section(layer_section(group, layer), CODEC_CHANNELS, stored, 4 * columns * count))
            rest = rest[columns:]
        return sections

    def _make_residual_section(self, group: str, layer: int, stored: bytes, count: int) -> Section:
        """Return the section of the encoded residuals of a layer."""
        return Section(layer_section(group, layer), CODEC_RESIDUALS, stored, 4 * self._residual_widths[group] * count)

    def _encode_raw(self, model: HybridModel) -> bytes:
        """Return the bytes of a chunk of profile "raw"."""
        sections, _ = raw.encode(model, layered_groups(model.config))
        return self._encode_chunk(sections, [len(model)])

    def _encode_chunk(self, sections: list[Section], counts: list[int]) -> bytes:
        """Return the bytes of a chunk: its own sections, and references to the shared ones."""
        shared = [self._shared.entries[tag] for tag in SHARED_SECTIONS if tag in self._shared.entries]
        references = [refer_to_section(entry, self.shared_name) for entry in shared]
        layers = counts if len(counts) > 1 else []
        metadata = replace(
            self.metadata, profile=self.profile, gaussians=sum(counts), layers=layers, settings={}, provenance={}
        )
        return _encode_file(metadata, [*references, *sections], deflate=self.is_compact)


def _exact_or_finer(mean: np.float32, weight: int, codes: np.ndarray) -> tuple[np.ndarray, np.float32, int | None]:
    """Return step codes, mean and weight that keep the numbers of a channel exactly, or with finer steps."""
    if weight == 0:
        return codes, mean, 0
    finer = codes.astype(np.int64) - _CODES_PER_OCTAVE * FINER_STEP_OCTAVES
    return np.maximum(finer, MIN_STEP_CODE).astype(np.uint8), mean, None


def _encode_file(metadata: Metadata, sections: list[Section], deflate: bool) -> bytes:
    """Return the bytes of a file of the lowest version that has these sections."""
    sections = [metadata.to_section(deflate=deflate), *sections]
    return write_container(sections, minor=lowest_minor_version(sections, metadata.config))
