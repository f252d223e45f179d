"""Density control: where Gaussians are added and which are removed.

Gaussians are cloned where they are small and split where they are large, those first whose projected centre has the
largest absolute gradients (3DGS; AbsGS), until there are more than the budget allows. Then the count falls to the
budget: in each round those go that pictures would miss least. So a budget is filled with the best of what was tried,
and not with what came first.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.render import Rendering
from hyrfpack.scene import Camera
from hyrfpack.train.config import DensityConfig
from hyrfpack.train.optimizer import Optimizer

SPLIT_SHRINK = 1.6
FADING = 0.8  # what a round leaves of the squares of those before
SATURATED = 0.02  # light that an opaque Gaussian is taken to let through: its logit hardly moves it, and yet it counts
COLLECTED = ("gradients", "views", "squares")
FAINT = 0.2  # of two this faint the error asked for more light than one sends; halved each round, they would go out
LEAST_INTERVAL = 5  # steps; after fewer, what is new has hardly moved
FEW = 0.1  # huge Gaussians are outliers, to be removed, up to this share of all


class DensityControl:
    """Collects gradients and, at its rounds, edits the model through the optimiser.

    A Gaussian of opacity o is worth to a picture about what its loss changes without it: to first order o dL/do, or
    dL/dx / (1 - o) by the opacity's logit x. The sum of its squares over views is the Gauss-Newton estimate of the
    loss's rise, up to a factor, where residuals are as good as random; a view that does not show it adds nothing.

    Each process of several collects of its own views; a round begins with the sums, so that all decide alike.

    Attributes:
        gradients: (N,) sum over views of the mean2d gradient's norm, NDC units.
        views: (N,) in how many views each Gaussian was visible since the last round.
        squares: (N,) sum over views of the squared gradient of the opacity's explicit logit; earlier rounds fade.
    """

    def __init__(
        self,
        config: DensityConfig,
        steps: int,
        budget: int,
        initial: int,
        seed: int,
        device: torch.device | None = None,
        ranks: Ranks = SINGLE_PROCESS,
    ) -> None:
        self.ranks = ranks
        self.config = config
        self.budget = budget
        self.initial = initial
        self.seed = seed
        self.device = device
        self.first = max(1, round(config.start * steps))
        self.last = round(config.stop * steps)
        self.interval = max(LEAST_INTERVAL, (self.last - self.first) // max(1, config.rounds))
        self.last -= max(0, self.last - self.first) % self.interval  # of the last round
        self.peak = min(max(self.first, round(config.peak * steps)), self.last)
        self.reset_interval = (self.peak - self.first) // (config.resets + 1) if config.resets else None
        self.squares = torch.zeros(initial, device=device)
        self.clear(initial)

    def clear(self, count: int) -> None:
        """Forget the gradients of centres; there are `count` Gaussians now."""
        self.gradients = torch.zeros(count, device=self.device)
        self.views = torch.zeros(count, device=self.device)

    def watching(self, step: int) -> bool:
        """Whether gradients of this step (counted from 1) will still be used."""
        return step <= self.last

    def observe(self, rendering: Rendering, camera: Camera, model: HybridModel) -> None:
        """Collect the gradients of one view, after backward."""
        if rendering.absgrad is None:
            return
        # To pick the visible would make the host wait for the device: zeros are added instead.
        ndc = rendering.absgrad * tensor_like((camera.width / 2, camera.height / 2), rendering.absgrad)
        lengths = torch.where(rendering.visible, torch.linalg.vector_norm(ndc, dim=-1), 0)
        self.gradients.index_add_(0, rendering.indices, lengths.to(self.gradients.dtype))
        self.views.index_add_(0, rendering.indices, rendering.visible.to(self.views.dtype))
        if (gradient := model.gaussians.opacity_logits.grad) is not None:
            self.squares += gradient[:, 0].square()

    def act(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        """Run a round or a reset if one is due after this step (counted from 1)."""
        if not self.first <= step <= self.last:
            return
        since = step - self.first
        if since % self.interval == 0:
            self._round(step, model, optimizer)
        if self.reset_interval and since and since % self.reset_interval == 0 and step + self.interval < self.peak:
            self._reset(model, optimizer)

    def target(self, step: int) -> int:
        """The most Gaussians that the round after this step leaves: up along a line until the peak, then down."""
        most = self.config.excess * self.budget
        if step < self.peak:
            return int(self.initial + (most - self.initial) * (step - self.first) / (self.peak - self.first))
        if step >= self.last:
            return self.budget
        return int(most + (self.budget - most) * (step - self.peak) / (self.last - self.peak))

    @torch.no_grad()
    def _round(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        for name in COLLECTED:
            self.ranks.all_reduce(getattr(self, name))
        explicit = model.gaussians
        geometry = model.decode_geometry()
        bounds = model.scale_bounds(explicit.positions)
        sizes = (geometry.scales / bounds).amax(-1)
        target = self.target(step)
        alive = self._alive(geometry, sizes, target)

        score = torch.where(alive, self.gradients / self.views.clamp_min(1), 0.0)
        best = torch.argsort(score, descending=True, stable=True)[: max(0, target - int(alive.sum()))]
        best = best[score[best] > self.config.gradient].sort().values
        large = sizes[best] > self.config.split_scale
        cloned, split = best[~large], best[large]

        alive[split] = False
        keep = torch.nonzero(alive).squeeze(-1)
        explicit.opacity_logits[cloned] = _dimmed(explicit, geometry, cloned)
        clones = {name: getattr(explicit, name)[cloned] for name in Gaussians.PARAMETER_NAMES}
        children = self._split(step, model, geometry, bounds, split)
        optimizer.replace_gaussians(
            keep, {name: torch.cat((clones[name], children[name])) for name in Gaussians.PARAMETER_NAMES}
        )
        # What two share is each one's half.
        self.squares[cloned] /= 2
        self.squares = FADING * torch.cat((self.squares[keep], self.squares[cloned], self.squares[split.repeat(2)] / 2))
        if not self.ranks.is_main:  # what came before is summed once
            self.squares.zero_()
        self.clear(len(model))

    def _alive(self, geometry: Geometry, sizes: Tensor, target: int) -> Tensor:
        """(N,) bool: the Gaussians to be kept, at most `target`; those that are faint or huge are not."""
        huge = ~(sizes <= self.config.prune_scale)  # also where it is not a number
        if huge.sum() > FEW * len(huge):  # they carry the scene, as over an even sky without a background sphere
            huge = torch.zeros_like(huge)
        alive = (geometry.opacities >= self.config.prune_opacity) & ~huge
        if not alive.any():  # never end with an empty scene: keep the most opaque
            alive[geometry.opacities.argmax()] = True
        if alive.sum() > target:
            worth = self.squares / (1 - geometry.opacities).clamp_min(SATURATED).square()
            worth = torch.where(alive, worth, -1.0)
            alive[torch.argsort(worth, descending=True, stable=True)[max(1, target) :]] = False
        return alive

    def _split(
        self, step: int, model: HybridModel, geometry: Geometry, bounds: Tensor, split: Tensor
    ) -> dict[str, Tensor]:
        """Two children for each Gaussian at `split`, drawn from it, 1.6 times smaller on every axis as decoded."""
        explicit = model.gaussians
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + step) % 2**64)
        twice = split.repeat(2)
        scales, quats = geometry.scales[twice], geometry.quats[twice]
        # Drawn on the CPU: the same numbers on every device.
        offsets = torch.randn(len(twice), 3, generator=generator).to(scales.device) * scales
        positions = explicit.positions[twice] + rotate(quats, offsets)

        # The neural part stays as it is, so the explicit logit alone must bring the shrinking about.
        old = explicit.scale_logits[twice]
        if model.config.scale_rule == "sum":
            fraction = scales / bounds[twice]
            shift = (logit(fraction / SPLIT_SHRINK) - logit(fraction)).mean(-1, keepdim=True)
            scale_logits = old + shift
        else:
            scale_logits = logit(torch.sigmoid(old) / SPLIT_SHRINK)
        return {
            "positions": positions,
            "color_logits": explicit.color_logits[twice],
            "scale_logits": scale_logits,
            "opacity_logits": _dimmed(explicit, geometry, twice),
        }

    def state_dict(self) -> dict[str, Tensor]:
        """What was collected."""
        return {name: getattr(self, name) for name in COLLECTED}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """The inverse of `state_dict`."""
        for name in COLLECTED:
            setattr(self, name, state[name].to(self.device))

    @torch.no_grad()
    def _reset(self, model: HybridModel, optimizer: Optimizer) -> None:
        """Cap every decoded opacity at reset_opacity by lowering the explicit logit."""
        explicit = model.gaussians
        neural = model.geometry(model.cube_coords(explicit.positions))[:, :1]
        cap = logit(torch.tensor(self.config.reset_opacity))
        optimizer.reset("opacity_logits", torch.minimum(explicit.opacity_logits, cap - neural))


def _dimmed(explicit: Gaussians, geometry: Geometry, parents: Tensor) -> Tensor:
    """(n, 1) opacity logits by which two let through what each parent does, 1 - sqrt(1 - o), but FAINT ones stay."""
    old = geometry.opacities[parents, None].double()
    new = torch.maximum(1 - (1 - old).sqrt(), old.clamp_max(FAINT))
    return explicit.opacity_logits[parents] + logit(new) - logit(old)


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors (N, 3) by quaternions (N, 4) wxyz, not necessarily unit."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = quats[:, :1], quats[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)
