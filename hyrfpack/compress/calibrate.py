"""What storing a model does to pictures, measured on pictures, part by part: what sensitivities alone do not see.

A sensitivity is a derivative: it foretells the error of small errors that have nothing to do with each other. Of what
packing does, three things are neither. Gaussians that move swap their order before a camera, which adds an error in
proportion to the step and not to its square. What pruning takes away always has the same sign. And where opacity or
transmittance saturates, errors end early. So each part of a plan is tried by itself, drawn, compared with the model,
and its sensitivities are multiplied by what was found over what was foretold, until they foretell it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.view_sampling import sample_views
from hyrfpack.compress.plan import make_plan, of_each_number, worth_keeping
from hyrfpack.compress.quantize import opacity_error, quantize
from hyrfpack.compress.sensitivity import PRUNED, Sensitivity, measure_sensitivity
from hyrfpack.format.arrays import iter_parameters, to_arrays
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.format.sections import (
    COLORS,
    DECODER_SECTIONS,
    GEOMETRY_TABLE,
    LOGIT_SECTIONS,
    OPACITIES,
    POSITIONS,
    RADIANCE_TABLE,
    SCALES,
    SECTION_CONTENTS,
    TABLE_SECTIONS,
)
from hyrfpack.model import Decoded, HybridModel
from hyrfpack.parallel.pool import parallel_map
from hyrfpack.progress import Report, no_report, report_part, report_round
from hyrfpack.render import render
from hyrfpack.scene import Camera

DRAWN = 1_000_000  # Gaussians drawn in the views of one comparison, about
FEWEST, MOST = 6, 10  # views of it, half of them at cameras
ROUNDS = 5  # of correcting
CLOSE = 1.2  # factor within which the largest parts shall be foretold
MINOR = 0.03  # share of the distortion below which a part is left as it is
FARTHEST = 64.0  # factor of one correction
# What is tried by itself. A decoder has too few numbers for an error that is more than luck: it goes with its table.
Part = tuple[str, ...]
PARTS: tuple[Part, ...] = (
    (POSITIONS,),
    (COLORS,),
    (SCALES, OPACITIES),
    *zip(TABLE_SECTIONS, DECODER_SECTIONS, strict=True),
)
# Powers of found over foretold by which sensitivities are corrected. Errors of small independent numbers fall with the
# square of their steps: 1. Those of swapped orders fall with the step: up to 2. What is pruned adds up: from 1/2.
LAWS: dict[Part, float] = {(POSITIONS,): 1.5, (PRUNED,): 0.7}
LEAST_LAW, MOST_LAW = 0.25, 3.0  # that two factors are believed to tell: those near each other may tell anything


@dataclass
class Factor:
    """What a part's sensitivities are multiplied by, searched for.

    Attributes:
        law: the power of found over foretold to go on by, until two factors tell it.
        value: the factor to be tried.
        low, high: the greatest that was seen to be too small, and the least that was seen not to be.
        done: whether errors are foretold well enough.
        tried: the factor tried last, and its error found over that foretold.
    """

    law: float
    value: float = 1.0
    low: float = 0.0
    high: float = np.inf
    done: bool = False
    tried: tuple[float, float] | None = None

    def correct(self, ratio: float) -> None:
        """Go on, by the error found over the error foretold with `value`."""
        if self.tried is not None and ratio > 0:  # a secant, of logarithms
            value, before = self.tried
            told = np.log(self.value / value) / (np.log(before / ratio) or np.inf)
            self.law = float(told) if LEAST_LAW < told < MOST_LAW else self.law
        self.tried = (self.value, ratio) if ratio > 0 else None
        if ratio > 1:
            self.low = max(self.low, self.value)
        else:
            self.high = min(self.high, self.value)
        if 1 / CLOSE < ratio < CLOSE:
            self.done = True
        elif self.high < CLOSE * self.low:
            self.value, self.done = self.high, True
        else:
            further = self.value * min(max(ratio, 1 / FARTHEST), FARTHEST) ** self.law
            self.value = further if self.low < further < self.high else (self.low * self.high) ** 0.5

    @property
    def final(self) -> float:
        """The factor to take: one that was tried and is enough, where there is such a one."""
        return self.value if self.done or self.high == np.inf else self.high


@dataclass(frozen=True)
class Tried:
    """What a part adds to the pictures' mean squared error: as pictures show it, and as sensitivities foretell it."""

    found: float
    told: float


@dataclass(frozen=True)
class Originals:
    """A model's pictures, that those of what is stored of it are compared with.

    Attributes:
        views: where from.
        pictures: of each, (H, W, 3) in [0, 1].
    """

    views: list[Camera]
    pictures: list[Tensor]

    @classmethod
    def of(cls, model: HybridModel, cameras: Sequence[Camera], seed: int = 1) -> Originals:
        """Of a model: half at some of its cameras, half between them."""
        count = int(np.clip(DRAWN // max(len(model), 1), FEWEST, MOST)) // 2
        at, between = sample_views(cameras, count, seed)
        return cls.seen([*at, *between], model)

    @classmethod
    def seen(cls, views: list[Camera], model: HybridModel, decoded: Decoded | None = None) -> Originals:
        """A model's pictures from these views; `decoded` as in `error`."""
        return cls(views, _pictures(model, views, decoded))

    def error(self, model: HybridModel, decoded: Decoded | None = None) -> float:
        """Mean squared difference of colours in the median view: in a single one a Gaussian may come too close.

        Args:
            model: whose pictures are compared.
            decoded: what `decode` says of it, where that is known.
        """
        pairs = zip(_pictures(model, self.views, decoded), self.pictures, strict=True)
        return float(np.median([float((mine - theirs).square().mean()) for mine, theirs in pairs]))


def calibrated(
    model: HybridModel,
    cameras: Sequence[Camera],
    distortion: float,
    prune: bool = True,
    report: Report = no_report,
) -> tuple[Sensitivity, Originals]:
    """A model's sensitivities for about so large a distortion, calibrated, and the pictures that they are by.

    Args:
        cameras: where pictures will be looked at from, about; world units.
        distortion, prune: as `make_plan` takes them.
        report: called with what is being done and the share of the work that is done, 0 to 1.

    Raises:
        HyrfError: a number of the model is NaN or infinite.
    """
    sensitivity = measure_sensitivity(model, cameras, report=report_part(report, 0.0, 0.5))
    report("drawing what files are compared with", 0.5)
    originals = Originals.of(model, cameras)
    return calibrate(model, sensitivity, originals, distortion, prune, report_part(report, 0.55, 1.0)), originals


def calibrate(
    model: HybridModel,
    sensitivity: Sensitivity,
    originals: Originals,
    distortion: float,
    prune: bool = True,
    report: Report = no_report,
) -> Sensitivity:
    """Sensitivities by which a plan for about so large a distortion foretells what its pictures show.

    Args:
        sensitivity: first-order, from `measure_sensitivity`.
        originals: pictures of the model.
        distortion, prune: as `make_plan` takes them.
        report: called with what is being done and the share of the work that is done, 0 to 1.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    each, decoded_all = of_each_number(model, distortion), model.decode()

    def part_of(kept: np.ndarray) -> tuple[HybridModel, Decoded]:
        index = torch.as_tensor(kept, device=model.gaussians.positions.device)
        return model.part(index), decoded_all[index]

    # Pruning first: what the others do depends on what is left.
    def without_pruned(scaled: Sensitivity, _: list[Part], report: Report) -> dict[Part, Tried]:
        report("calibrating what may be pruned", 0.0)
        kept = worth_keeping(scaled, each)
        return {(PRUNED,): Tried(originals.error(*part_of(kept)), float(np.delete(scaled.removals, kept).sum()))}

    if prune:
        sensitivity = _corrected(sensitivity, ((PRUNED,),), distortion, without_pruned, report_part(report, 0.0, 0.2))
    left, decoded = part_of(worth_keeping(sensitivity, each, prune))
    whole = Originals.seen(originals.views, left, decoded)
    placed: tuple[np.ndarray, Plan, HybridModel] | None = None

    def as_stored(scaled: Sensitivity, parts: list[Part], report: Report) -> dict[Part, Tried]:
        nonlocal placed
        if placed is None or not np.array_equal(placed[0], scaled.positions):
            plan = make_plan(model, scaled, distortion, prune)
            placed = scaled.positions, plan, plan.apply(model)
        _, plan, planned = placed
        quantized = quantize(planned, plan, scaled, sections=[name for part in parts for name in part])
        told, stored = _added(planned, quantized, scaled), quantized.arrays()
        # In the order of those that are left, so that what they decode to but for the part that changes serves again.
        order = np.argsort(plan.kept)
        stored = {name: values[order] if name in LOGIT_SECTIONS else values for name, values in stored.items()}

        def found(part: Part) -> float:
            if part == (POSITIONS,):
                return whole.error(planned)
            changed = _changed(left, {name: stored[name] for name in part})
            return whole.error(changed, _decoded_anew(changed, decoded, part))

        tried = {}
        for number, part in enumerate(parts):
            report(f"calibrating {' and '.join(SECTION_CONTENTS[name] for name in part)}", number / len(parts))
            tried[part] = Tried(found(part), sum(told[name] for name in part))
        return tried

    return _corrected(sensitivity, PARTS, distortion, as_stored, report_part(report, 0.2, 1.0))


def foretold(
    model: HybridModel, planned: HybridModel, quantized: QuantizedModel, sensitivity: Sensitivity
) -> dict[str, float]:
    """What storing a model adds to the pictures' mean squared error, by section and by what is pruned; by estimate."""
    removed = np.delete(sensitivity.removals, quantized.plan.kept)
    return {PRUNED: float(removed.sum()), **_added(planned, quantized, sensitivity)}


def _added(planned: HybridModel, quantized: QuantizedModel, sensitivity: Sensitivity) -> dict[str, float]:
    """As `foretold`, by the sections that are quantised and by positions."""
    plan = quantized.plan
    wanted, stored, s = to_arrays(planned), quantized.arrays(), sensitivity.of(plan.kept)
    weights = {COLORS: np.repeat(s.colors, 3), SCALES: s.scales, **s.fields}
    # A point is anywhere in its cell.
    bits = np.concatenate([layer.points.bits[layer.points.classes] for layer in plan.layers])
    errors = {POSITIONS: float((s.positions * 3 / 12 * 4.0**-bits).sum())}
    for group, values in stored.items():
        if group == OPACITIES:
            _, error = opacity_error(planned, wanted[group][:, 0].astype(np.float64), s.opacities)
            errors[group] = float(error(slice(None), values[:, 0]).sum())
        else:
            difference = values.ravel().astype(np.float64) - wanted[group].ravel()
            errors[group] = float((weights[group] * difference**2).sum())
    return errors


def _corrected(
    sensitivity: Sensitivity,
    parts: Sequence[Part],
    distortion: float,
    attempt: Callable[[Sensitivity, list[Part], Report], dict[Part, Tried]],
    report: Report,
) -> Sensitivity:
    """Sensitivities whose parts foretell what is found.

    Args:
        attempt: what is found and foretold of parts with these sensitivities.
    """

    def scaled(factors: dict[Part, float]) -> Sensitivity:
        return sensitivity.times({name: factor for part, factor in factors.items() for name in part})

    factors = {part: Factor(LAWS.get(part, 1.0)) for part in parts}
    for number in range(ROUNDS):
        waiting = [part for part, factor in factors.items() if not factor.done]
        if not waiting:
            break
        values = scaled({part: factor.value for part, factor in factors.items()})
        for part, tried in attempt(values, waiting, report_round(report, number)).items():
            if tried.told > 0 and max(tried.found, tried.told) > MINOR * distortion:
                factors[part].correct(tried.found / tried.told)
            else:
                factors[part].done = True
    return scaled({part: factor.final for part, factor in factors.items()})


def _changed(model: HybridModel, arrays: dict[str, np.ndarray]) -> HybridModel:
    """A model with other numbers in some sections."""
    changed = deepcopy(model)
    changed.load_state_dict(dict(iter_parameters(arrays, changed)), strict=False)
    return changed


def _decoded_anew(model: HybridModel, before: Decoded, part: Part) -> Decoded:
    """What a model decodes to, by what it did before these of its sections changed."""
    if GEOMETRY_TABLE in part or OPACITIES in part:
        return replace(before, geometry=model.decode_geometry())
    if before.shading is None:
        return before
    if RADIANCE_TABLE in part:
        return replace(before, shading=model.shading())
    return replace(before, shading=replace(before.shading, color_logits=model.gaussians.color_logits.detach()))


@torch.no_grad()
def _pictures(model: HybridModel, cameras: Sequence[Camera], decoded: Decoded | None = None) -> list[Tensor]:
    decoded = decoded or model.decode()

    @torch.no_grad()  # of this thread
    def picture(camera: Camera) -> Tensor:
        return render(model, camera, decoded=decoded).rgb

    return parallel_map(picture, cameras, model.gaussians.positions.device)
