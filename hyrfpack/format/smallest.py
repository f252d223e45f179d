"""The smallest file that a model can be packed into, and the check of a target size against it."""

from __future__ import annotations

import numpy as np
import torch

from hyrfpack.errors import HyrfError
from hyrfpack.format.codec import encode_model
from hyrfpack.format.compact.channels import Channel
from hyrfpack.format.compact.groups import MODELS, GroupSymbols, StepGroups
from hyrfpack.format.compact.plan import Layer, Plan, groups_of
from hyrfpack.format.compact.quantized import COLUMNS, Quantized
from hyrfpack.format.sections import MLPS, TABLES
from hyrfpack.model import ExposureMap, Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.quant.points import Points, encode_points
from hyrfpack.quant.steps import NOT_CODED

MIN_LOG2_TABLE_SIZE = 4  # the size of a table of zeros does not change the file: the smallest is made fastest
MAX_MEGABYTES_SUGGESTED = 100  # a target size below this many bytes was most likely meant in megabytes
MAX_KILOBYTES_SUGGESTED = 1_000  # and one below this in kilobytes


def min_file_bytes(provenance: dict | None = None, exposure: ExposureMap | None = None) -> int:
    """Count the bytes of the smallest `.hyrf` file that packing can write.

    It is the encoded file, profile "compact", of a model without Gaussians whose fields are zero: what is left are the
    headers of all sections and the metadata, which every file has, and the exposure map.

    Args:
        provenance: that the file carries; None for none.
        exposure: the exposure map that the file carries; None for none.

    Example:
        >>> min_file_bytes() < min_file_bytes({"source": "a drone"}) < 2000
        True
    """
    table = HashGridConfig(MIN_LOG2_TABLE_SIZE)
    config = ModelConfig(Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0)), table, table, background=False)
    triple, single = torch.zeros(0, 3), torch.zeros(0, 1)
    model = HybridModel(config, Gaussians(triple, triple, single, single), torch.Generator().manual_seed(0))
    model.exposure = exposure
    data, _, points = encode_points(Points(np.zeros((0, 3), np.int64), np.zeros(0, np.uint8), np.ones(1, np.int64)))
    groups = {group: groups_of(group, config, points) for group in (*TABLES, *MLPS)}
    plan = Plan(np.zeros(0, np.int64), (Layer(points, data),), np.eye(3, dtype=np.float32), groups, 0.0)
    empty = Channel(np.float32(0), 0, np.zeros(1, np.uint8), np.zeros(0, np.int64), np.zeros(0))
    channels = {group: [empty] * count for group, count in COLUMNS.items()}
    symbols = {group: _all_zero(members) for group, members in groups.items()}
    return len(encode_model(model, "compact", provenance, quantized=Quantized(plan, [channels], symbols)))


def check_target_bytes(target_bytes: int, provenance: dict | None = None, exposure: ExposureMap | None = None) -> None:
    """Refuse a target size below the smallest file.

    Args:
        target_bytes: bytes that the packed file may have.
        provenance: that the file will carry, as far as it is known.
        exposure: the exposure map that the file will carry, as far as it is known.

    Raises:
        HyrfError: no packed file is so small. The message suggests a unit where it looks forgotten.
    """
    smallest = min_file_bytes(provenance, exposure)
    if target_bytes >= smallest:
        return
    unit = "MB" if target_bytes < MAX_MEGABYTES_SUGGESTED else "kB" if target_bytes < MAX_KILOBYTES_SUGGESTED else None
    remedy = f"did you mean {target_bytes}{unit}?" if unit else "ask for more"
    raise HyrfError(
        f"a target size of {target_bytes:,} bytes is below the smallest possible file, about {smallest:,} bytes; "
        f"{remedy}"
    )


def _all_zero(groups: StepGroups) -> GroupSymbols:
    count = len(groups.index)
    codes, models = np.full(groups.count, NOT_CODED, np.uint8), np.full(groups.count, MODELS - 1, np.uint8)
    return GroupSymbols(codes, models, np.zeros(count, np.int64), np.zeros(count, np.float32))
