"""Quantisation of a model's fields before anything else, so that other numbers can correct what it changes."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hyrfpack.compress.groups import quantize_groups
from hyrfpack.compress.plan import distortion_per_number
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format.arrays import grid_configs, iter_parameters, to_arrays
from hyrfpack.format.compact.groups import StepGroups
from hyrfpack.format.compact.plan import build_step_groups
from hyrfpack.format.sections import DECODER_SECTIONS, TABLE_SECTIONS
from hyrfpack.model import HybridModel


@dataclass(frozen=True)
class FieldCodes:
    """The step codes of fields whose numbers are multiples of their steps.

    Attributes:
        codes: uint8 codes of the levels of each hash table, and of the groups of each decoder, by section.
    """

    codes: dict[str, np.ndarray]

    def of_groups(self, section: str, groups: StepGroups) -> np.ndarray:
        """Return the code (count,) of each group of a plan, given the section that the groups are of."""
        codes = self.codes[section]
        return np.repeat(codes, groups.count // len(codes))


def quantize_fields(model: HybridModel, sensitivity: Sensitivity, distortion: float) -> tuple[HybridModel, FieldCodes]:
    """Quantise the fields of a model; return a copy of the model with these fields, and their step codes.

    Each level of a hash table has one step, which no plan changes.

    Args:
        model: the model.
        sensitivity: its sensitivities.
        distortion: mean squared error that the fields may add to pictures; the share of each number is that which it
            has in `make_plan`.
    """
    arrays, d = to_arrays(model), distortion_per_number(model, distortion)
    codes, values = {}, {}
    for section in (*TABLE_SECTIONS, *DECODER_SECTIONS):
        if section in DECODER_SECTIONS:
            groups = build_step_groups(section, model.config)
        else:
            grid = grid_configs(model.config)[section]
            sizes = [2 * (last - first) for first, last in pairwise(grid.offsets)]
            groups = StepGroups(np.repeat(np.arange(len(sizes)), sizes), len(sizes))
        numbers = arrays[section].ravel().astype(np.float64)
        chosen = quantize_groups(numbers, groups, sensitivity.fields[section], d)
        codes[section], values[section] = np.maximum(chosen.codes, 1), chosen.values
    changed = deepcopy(model)
    changed.load_state_dict(dict(iter_parameters(values, changed)), strict=False)
    return changed, FieldCodes(codes)
