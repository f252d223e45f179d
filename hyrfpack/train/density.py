"""Density control decides where Gaussians are added and which ones are pruned.

Gaussians with the largest absolute gradients of their projected centres are cloned if they are small and split if they
are large (3DGS; AbsGS), until their number exceeds the budget. Then each round prunes the Gaussians with the lowest
importance scores, until their number equals the budget. So the budget is filled with the best candidates instead of the
first ones. After each round the Gaussians are sorted by place.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.config.train import DensityConfig
from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.quant.morton import MAX_BITS_PER_AXIS, spread_bits
from hyrfpack.render import Rendering
from hyrfpack.scene import Camera
from hyrfpack.train.optimizer import Optimizer

SPLIT_SHRINK = 1.6
SQUARED_GRADIENT_DECAY = 0.8  # Each round multiplies the sums of earlier rounds by this factor.
# The importance score divides by the transmittance of a Gaussian. The logit of an opaque Gaussian hardly changes its
# opacity, so without this bound its score would be noise.
MIN_SCORE_TRANSMITTANCE = 0.02
STATE_NAMES = ("gradients", "views", "squares")
# A Gaussian of lower opacity keeps its opacity when it is cloned or split. The picture needs more light there, and
# Gaussians whose opacity is reduced in each round would vanish.
MIN_HALVED_OPACITY = 0.2
MIN_ROUND_INTERVAL_STEPS = 5  # After fewer steps, new Gaussians have hardly moved.
# If more Gaussians than this are huge, they are kept, because they show the scene itself, such as an even sky without a
# background sphere.
MAX_OUTLIER_SHARE = 0.1


class DensityControl:
    """Collects gradients in each step, and adds and prunes Gaussians in rounds.

    Removing a Gaussian of opacity o changes a view's loss L by about o dL/do. With the logit x of its opacity, that is
    dL/dx / (1 - o). The importance score is the sum of the squares of this change over views. Where residuals are
    random, it is the Gauss-Newton estimate of the rise of the loss, up to a factor. Views that do not show the
    Gaussian add nothing.

    Each of several processes observes its own views. A round first sums the observations of all processes, so that all
    take the same decisions.

    Attributes:
        gradients: (N,) sum over views, since the last round, of the norm of the means2d gradient, NDC units.
        views: (N,) number of views in which each Gaussian was visible since the last round.
        squares: (N,) sum over views of the squared gradient of the explicit opacity logit; sums of earlier rounds decay
            by `SQUARED_GRADIENT_DECAY`.
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
        self.interval = max(MIN_ROUND_INTERVAL_STEPS, (self.last - self.first) // max(1, config.rounds))
        self.last -= max(0, self.last - self.first) % self.interval  # The last round may come before `stop`.
        self.peak = min(max(self.first, round(config.peak * steps)), self.last)
        self.reset_interval = (self.peak - self.first) // (config.resets + 1) if config.resets else None
        self.squares = torch.zeros(initial, device=device)
        self.clear(initial)

    def clear(self, count: int) -> None:
        """Reset the gradient sums and view counts to zero, for `count` Gaussians."""
        self.gradients = torch.zeros(count, device=self.device)
        self.views = torch.zeros(count, device=self.device)

    def watching(self, step: int) -> bool:
        """Return whether a later round uses the gradients of this step, counted from 1."""
        return step <= self.last

    def observe(self, rendering: Rendering, camera: Camera, model: HybridModel) -> None:
        """Collect the gradients of one view, after its backward pass."""
        if rendering.absgrad is None:
            return
        # Selecting the visible Gaussians would make the host wait for the device. Instead, zeros are added for the
        # invisible ones, and for all if the rendering is not valid.
        visible, valid = rendering.visible, rendering.valid
        if valid is not None:
            visible = visible & valid
        ndc = rendering.absgrad * tensor_like((camera.width / 2, camera.height / 2), rendering.absgrad)
        lengths = torch.where(visible, torch.linalg.vector_norm(ndc, dim=-1), 0)
        self.gradients.index_add_(0, rendering.indices, lengths.to(self.gradients.dtype))
        self.views.index_add_(0, rendering.indices, visible.to(self.views.dtype))
        if (gradient := model.gaussians.opacity_logits.grad) is not None:
            squares = gradient[:, 0].square()
            self.squares += squares if valid is None else torch.where(valid, squares, 0)

    def acting(self, step: int) -> bool:
        """Return whether a round or a reset is due after this step (counted from 1)."""
        return self._has_round(step) or self._has_reset(step)

    def act(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        """Run the round and the reset that are due after this step (counted from 1)."""
        if self._has_round(step):
            self._round(step, model, optimizer)
        if self._has_reset(step):
            self._reset(model, optimizer)

    def _has_round(self, step: int) -> bool:
        return self.first <= step <= self.last and (step - self.first) % self.interval == 0

    def _has_reset(self, step: int) -> bool:
        if not self.reset_interval or not self.first < step <= self.last:
            return False
        return (step - self.first) % self.reset_interval == 0 and step + self.interval < self.peak

    def target(self, step: int) -> int:
        """Return the largest number of Gaussians after a round at this step.

        It grows linearly up to the peak, and falls linearly to the budget after it.
        """
        most = self.config.excess * self.budget
        if step < self.peak:
            return int(self.initial + (most - self.initial) * (step - self.first) / (self.peak - self.first))
        if step >= self.last:
            return self.budget
        return int(most + (self.budget - most) * (step - self.peak) / (self.last - self.peak))

    @torch.no_grad()
    def _round(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        for name in STATE_NAMES:
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
        # The children of one Gaussian share its sum equally.
        self.squares[cloned] /= 2
        self.squares = SQUARED_GRADIENT_DECAY * torch.cat(
            (self.squares[keep], self.squares[cloned], self.squares[split.repeat(2)] / 2)
        )
        order = spatial_order(model)
        optimizer.reorder_gaussians(order)
        self.squares = self.squares[order]
        if not self.ranks.is_main:  # The sum over all ranks stays on rank 0, so that the next round counts it once.
            self.squares.zero_()
        self.clear(len(model))

    def _alive(self, geometry: Geometry, sizes: Tensor, target: int) -> Tensor:
        """Return the mask (N,) of the Gaussians to keep: neither faint nor huge, and at most `target` of them."""
        huge = ~(sizes <= self.config.prune_scale)  # This way NaN counts as huge.
        if huge.sum() > MAX_OUTLIER_SHARE * len(huge):
            huge = torch.zeros_like(huge)
        alive = (geometry.opacities >= self.config.prune_opacity) & ~huge
        if not alive.any():  # The scene must not become empty, so the most opaque Gaussian is kept.
            alive[geometry.opacities.argmax()] = True
        if alive.sum() > target:
            importance = self.squares / (1 - geometry.opacities).clamp_min(MIN_SCORE_TRANSMITTANCE).square()
            importance = torch.where(alive, importance, -1.0)
            alive[torch.argsort(importance, descending=True, stable=True)[max(1, target) :]] = False
        return alive

    def _split(
        self, step: int, model: HybridModel, geometry: Geometry, bounds: Tensor, split: Tensor
    ) -> dict[str, Tensor]:
        """Return the parameters of two children sampled from each Gaussian at `split` (n,) int64.

        The decoded scales of children are those of their parent divided by `SPLIT_SHRINK`.
        """
        explicit = model.gaussians
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + step) % 2**64)
        twice = split.repeat(2)
        scales, quats = geometry.scales[twice], geometry.quats[twice]
        # Sampling on the CPU gives the same numbers for all devices.
        offsets = torch.randn(len(twice), 3, generator=generator).to(scales.device) * scales
        positions = explicit.positions[twice] + rotate(quats, offsets)

        return {
            "positions": positions,
            "color_logits": explicit.color_logits[twice],
            "scale_logits": _shrink(explicit.scale_logits[twice], scales / bounds[twice]),
            "opacity_logits": _dimmed(explicit, geometry, twice),
        }

    def state_dict(self) -> dict[str, Tensor]:
        """Return the sums observed so far, by name."""
        return {name: getattr(self, name) for name in STATE_NAMES}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for name in STATE_NAMES:
            setattr(self, name, state[name].to(self.device))

    @torch.no_grad()
    def _reset(self, model: HybridModel, optimizer: Optimizer) -> None:
        """Cap every decoded opacity at reset_opacity by lowering the explicit logit."""
        explicit = model.gaussians
        neural = model.geometry(model.cube_coords(explicit.positions))[:, :1]
        cap = logit(torch.tensor(self.config.reset_opacity))
        optimizer.reset("opacity_logits", torch.minimum(explicit.opacity_logits, cap - neural))


def spatial_order(model: HybridModel) -> Tensor:
    """Return the indices (N,) int64 of a model's Gaussians in Morton order in the contracted cube.

    Neighbours in this order are close in space, so that they read and change the same rows of the hash tables.
    Gaussians at the same place keep their order.
    """
    limit = 1 << MAX_BITS_PER_AXIS
    cells = (model.cube_coords(model.gaussians.positions.detach()) * limit).long().clamp_(0, limit - 1)
    codes = torch.zeros_like(cells[:, 0])
    for axis, bits in enumerate(cells.unbind(1)):
        codes |= spread_bits(bits.clone()) << axis
    return torch.argsort(codes, stable=True)


def _shrink(scale_logits: Tensor, fractions: Tensor) -> Tensor:
    """Return scale logits (n, 1) that divide decoded scales by `SPLIT_SHRINK`, in the mean over the axes.

    Args:
        scale_logits: (n, 1) stored logits. They alone must reduce the scales, because the neural part stays the same.
        fractions: (n, 3) decoded scales as fractions of the largest scale S(p).
    """
    return scale_logits + (logit(fractions / SPLIT_SHRINK) - logit(fractions)).mean(-1, keepdim=True)


def _dimmed(explicit: Gaussians, geometry: Geometry, parents: Tensor) -> Tensor:
    """Return opacity logits (n, 1) with which two Gaussians transmit as much light as their parent.

    The parent's opacity o becomes 1 - sqrt(1 - o), but at least min(o, `MIN_HALVED_OPACITY`).
    """
    old = geometry.opacities[parents, None].double()
    new = torch.maximum(1 - (1 - old).sqrt(), old.clamp_max(MIN_HALVED_OPACITY))
    return explicit.opacity_logits[parents] + logit(new) - logit(old)


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors (N, 3) by quaternions (N, 4) wxyz, not necessarily unit."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = quats[:, :1], quats[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)
