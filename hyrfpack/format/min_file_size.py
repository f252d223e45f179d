"""Lower bound of the size of packed `.hyrf` files, and the check of a target size against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from hyrfpack.errors import HyrfError
from hyrfpack.format.codec import encode_model
from hyrfpack.format.compact.channels import Channel
from hyrfpack.format.compact.groups import ENTROPY_MODEL_COUNT, GroupSymbols, StepGroups
from hyrfpack.format.compact.plan import Layer, Plan, build_step_groups
from hyrfpack.format.compact.quantized import LOGIT_COLUMNS, QuantizedModel
from hyrfpack.format.container import Section, write_container
from hyrfpack.format.part_names import CODEC_PART_FILE, write_part_names
from hyrfpack.format.sections import DECODER_SECTIONS, TABLE_SECTIONS, part_section
from hyrfpack.format.versions import MERGED_MINOR_VERSION
from hyrfpack.model import ExposureMap, Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.quant.points import LatticePoints, sort_points
from hyrfpack.quant.steps import ALL_ZERO_CODE

# A table of zeros takes the same number of bytes at any size. The smallest table is encoded fastest.
MIN_LOG2_TABLE_SIZE = 4
# A target size below this many bytes was most likely meant in megabytes or in kilobytes.
MEGABYTE_HINT_BELOW_BYTES = 100
KILOBYTE_HINT_BELOW_BYTES = 1_000


def min_file_bytes(provenance: dict | None = None, exposure: ExposureMap | None = None) -> int:
    """Return the size in bytes of the smallest `.hyrf` file that packing can write.

    It encodes, with profile "compact", a model without Gaussians whose fields are zero. Such a file consists of the
    headers of all sections and the metadata, which every file has, and of the exposure map.

    Args:
        provenance: provenance in the file; None for none.
        exposure: exposure map in the file; None for none.

    Example:
        >>> min_file_bytes() < min_file_bytes({"source": "a drone"}) < 2000
        True
    """
    table = HashGridConfig(MIN_LOG2_TABLE_SIZE)
    config = ModelConfig(Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0)), table, table, background=False)
    triple, single = torch.zeros(0, 3), torch.zeros(0, 1)
    model = HybridModel(config, Gaussians(triple, triple, single, single), torch.Generator().manual_seed(0))
    model.exposure = exposure
    no_points = LatticePoints(np.zeros((0, 3), np.int64), np.zeros(0, np.uint8), np.ones(1, np.int64))
    _, points, base_bits = sort_points(no_points)
    groups = {group: build_step_groups(group, config, points) for group in (*TABLE_SECTIONS, *DECODER_SECTIONS)}
    plan = Plan(np.zeros(0, np.int64), (Layer(points, base_bits),), np.eye(3, dtype=np.float32), groups, 0.0, 0)
    empty = Channel(np.float32(0), 0, np.zeros(1, np.uint8), np.zeros(0, np.int64), np.zeros(0))
    channels = {group: [empty] * count for group, count in LOGIT_COLUMNS.items()}
    symbols = {group: _zero_symbols(members) for group, members in groups.items()}
    return len(encode_model(model, "compact", provenance, quantized=QuantizedModel(plan, [channels], symbols)))


def min_merged_file_bytes(parts: Sequence[tuple[str, dict | None, ExposureMap | None]]) -> int:
    """Return the size in bytes of the smallest merged file that packing can write.

    Args:
        parts: name, provenance and exposure map of each part, see `min_file_bytes`.
    """
    sections = [write_part_names([name for name, _, _ in parts])]
    for number, (_, provenance, exposure) in enumerate(parts):
        part = bytes(min_file_bytes(provenance, exposure))
        sections.append(Section(part_section(number), CODEC_PART_FILE, part, len(part)))
    return len(write_container(sections, minor=MERGED_MINOR_VERSION))


def check_target_bytes(target_bytes: int, provenance: dict | None = None, exposure: ExposureMap | None = None) -> None:
    """Raise an error if a target size is below the smallest possible file, see `check_target_above`.

    Args:
        target_bytes: largest allowed size of the packed file, bytes.
        provenance: provenance that the file will have, if known.
        exposure: exposure map that the file will have, if known.

    Raises:
        HyrfError: no packed file can be that small.
    """
    check_target_above(target_bytes, min_file_bytes(provenance, exposure))


def check_target_above(target_bytes: int, min_bytes: int) -> None:
    """Raise an error if a target size is below a lower bound of the size of the file; both are in bytes.

    Raises:
        HyrfError: the size is below it. The message suggests a unit if it seems to be missing.
    """
    if target_bytes >= min_bytes:
        return
    if target_bytes < MEGABYTE_HINT_BELOW_BYTES:
        fix = f"did you mean {target_bytes}MB?"
    elif target_bytes < KILOBYTE_HINT_BELOW_BYTES:
        fix = f"did you mean {target_bytes}kB?"
    else:
        fix = (
            f"use a larger `target_bytes`; {min_bytes:,} is a lower bound, which only a model without Gaussians reaches"
        )
    raise HyrfError(
        f"a target size of {target_bytes:,} bytes is below the smallest possible file, about {min_bytes:,} bytes",
        fix=fix,
    )


def _zero_symbols(groups: StepGroups) -> GroupSymbols:
    """Return the symbols of groups in which all numbers are zero."""
    count = len(groups.index)
    codes = np.full(groups.count, ALL_ZERO_CODE, np.uint8)
    models = np.full(groups.count, ENTROPY_MODEL_COUNT - 1, np.uint8)
    return GroupSymbols(codes, models, np.zeros(count, np.int64), np.zeros(count, np.float32))
