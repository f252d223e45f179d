"""Density control: where Gaussians are added and which are removed.

Follows 3DGS (clone small ones, split large ones where the gradient of the projected centre is large, prune the
faint and the huge) with absolute gradients (AbsGS), under a budget: the count grows along a straight line to the
budget, and each round takes the Gaussians with the largest gradients first.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.render import Rendering
from hyrfpack.train.config import DensityConfig
from hyrfpack.train.optimizer import Optimizer

SPLIT_SHRINK = 1.6
FEW = 0.1  # huge Gaussians are outliers, to be removed, up to this share of all


class DensityControl:
    """Collects gradients and, at its rounds, edits the model through the optimiser.

    Attributes:
        gradients: (N,) sum over views of the mean2d gradient's norm, NDC units.
        views: (N,) in how many views each Gaussian was visible since the last round.
    """

    def __init__(
        self,
        config: DensityConfig,
        steps: int,
        budget: int,
        initial: int,
        seed: int,
        device: torch.device | None = None,
    ) -> None:
        self.config = config
        self.budget = budget
        self.initial = initial
        self.seed = seed
        self.device = device
        self.first = max(1, round(config.start * steps))
        self.last = round(config.stop * steps)
        self.interval = max(1, (self.last - self.first) // max(1, config.rounds))
        self.reset_interval = (self.last - self.first) // (config.resets + 1) if config.resets else None
        self.clear(initial)

    def clear(self, count: int) -> None:
        """Forget what was collected; there are `count` Gaussians now."""
        self.gradients = torch.zeros(count, device=self.device)
        self.views = torch.zeros(count, device=self.device)

    def watching(self, step: int) -> bool:
        """Whether gradients of this step (counted from 1) will still be used."""
        return step <= self.last

    def observe(self, rendering: Rendering, width: int, height: int) -> None:
        """Collect the gradients of one view, after backward."""
        if rendering.absgrad is None:
            return
        # To pick the visible would make the host wait for the device: zeros are added instead.
        ndc = rendering.absgrad * tensor_like((width / 2, height / 2), rendering.absgrad)
        lengths = torch.where(rendering.visible, torch.linalg.vector_norm(ndc, dim=-1), 0)
        self.gradients.index_add_(0, rendering.indices, lengths.to(self.gradients.dtype))
        self.views.index_add_(0, rendering.indices, rendering.visible.to(self.views.dtype))

    def act(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        """Run a round or a reset if one is due after this step (counted from 1)."""
        if not self.first <= step <= self.last:
            return
        since = step - self.first
        if since % self.interval == 0:
            self._round(step, model, optimizer)
        if self.reset_interval and since and since % self.reset_interval == 0 and step + self.interval < self.last:
            self._reset(model, optimizer)

    @torch.no_grad()
    def _round(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        explicit = model.gaussians
        geometry = model.decode_geometry()
        bounds = model.scale_bounds(explicit.positions)
        sizes = (geometry.scales / bounds).amax(-1)

        huge = ~(sizes <= self.config.prune_scale)  # also where it is not a number
        if huge.sum() > FEW * len(huge):  # they carry the scene, as over an even sky without a background sphere
            huge = torch.zeros_like(huge)
        alive = (geometry.opacities >= self.config.prune_opacity) & ~huge
        if not alive.any():  # never end with an empty scene: keep the most opaque
            alive[geometry.opacities.argmax()] = True

        progress = min(1.0, (step - self.first) / max(1, self.last - self.first))
        target = self.initial + (self.budget - self.initial) * progress
        room = max(0, int(target) - int(alive.sum()))
        score = torch.where(alive, self.gradients / self.views.clamp_min(1), 0.0)
        best = torch.argsort(score, descending=True, stable=True)[:room]
        best = best[score[best] > self.config.gradient].sort().values
        large = sizes[best] > self.config.split_scale
        cloned, split = best[~large], best[large]

        alive[split] = False
        keep = torch.nonzero(alive).squeeze(-1)
        clones = {name: getattr(explicit, name)[cloned] for name in Gaussians.NAMES}
        children = self._split(step, model, geometry, bounds, split)
        optimizer.replace_gaussians(keep, {name: torch.cat((clones[name], children[name])) for name in Gaussians.NAMES})
        self.clear(len(model))

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
            "opacity_logits": explicit.opacity_logits[twice],
        }

    @torch.no_grad()
    def _reset(self, model: HybridModel, optimizer: Optimizer) -> None:
        """Cap every decoded opacity at reset_opacity by lowering the explicit logit."""
        explicit = model.gaussians
        neural = model.geometry(model.cube_coords(explicit.positions))[:, :1]
        cap = logit(torch.tensor(self.config.reset_opacity))
        optimizer.reset("opacity_logits", torch.minimum(explicit.opacity_logits, cap - neural))


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors (N, 3) by quaternions (N, 4) wxyz, not necessarily unit."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = quats[:, :1], quats[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)
