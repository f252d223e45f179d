"""Plans of one model, of which the last one is kept until another one is needed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format.compact.plan import Plan
from hyrfpack.model import HybridModel


@dataclass(frozen=True)
class PlannedModel:
    """A plan and the model that it stores, before quantisation.

    Attributes:
        plan: the plan.
        model: the result of `plan.apply`.
        geometry_outputs: (M, 8) the result of `model.geometry_outputs()`.
    """

    plan: Plan
    model: HybridModel
    geometry_outputs: torch.Tensor


@dataclass
class Planner:
    """Makes plans of one model, and makes one again only if it would differ from the last one.

    The sensitivities of all plans must be those of one measurement, each section multiplied by a factor. Then a plan
    depends on the factors of positions and removals alone, because importance classes depend on ratios.

    Attributes:
        model: the model before pruning.
        prune: as `make_plan` takes it.
    """

    model: HybridModel
    prune: bool = True
    _last: tuple[float, Sensitivity, PlannedModel] | None = field(default=None, init=False)

    def plan(self, sensitivity: Sensitivity, distortion: float) -> PlannedModel:
        """Plan the model; see `make_plan`."""
        if self._last is not None:
            last_distortion, last, planned = self._last
            if (
                distortion == last_distortion
                and np.array_equal(sensitivity.positions, last.positions)
                and np.array_equal(sensitivity.removals, last.removals)
            ):
                return planned
            self._last = None  # frees its memory before the next one is made
        plan = make_plan(self.model, sensitivity, distortion, self.prune)
        stored = plan.apply(self.model)
        planned = PlannedModel(plan, stored, stored.geometry_outputs())
        self._last = distortion, sensitivity, planned
        return planned
