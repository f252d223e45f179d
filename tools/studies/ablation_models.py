"""The variants of `tools/studies/ablations.py`: a HybridModel with one part taken out, and a fair start for each.

Everything else stays the product's own: photos, first Gaussians, budget, density control, losses, schedules.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from hyrfpack.data import PictureCache
from hyrfpack.model import Decoded, Geometry, HybridModel, ModelConfig
from hyrfpack.model.field import Field
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.shade import DIRECTION_FEATURES, spherical_harmonics
from hyrfpack.scene import Scene
from hyrfpack.train.config import LearningRates, TrainConfig
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.trainer import Trainer

EXPLICIT = ("color_logits", "scale_logits", "opacity_logits")
Y00 = 0.28209479177387814  # the constant spherical harmonic
SH_NUMBERS = 16  # of bands 0 to 3, for each colour channel
SH_REST_RATE = 1 / 20  # learning rate of bands 1 to 3 as a part of band 0's (3DGS)


class SingleField(HybridModel):
    """One grid and one decoder predict everything.

    The table has twice the radiance table's rows, so a third more than both tables had, as in the paper. Geometry
    stays the same from everywhere: it is read with the direction's inputs at zero.
    """

    def __init__(self, config: ModelConfig, gaussians: Gaussians, generator: torch.Generator | None = None) -> None:
        super().__init__(config, gaussians, generator)
        grid = replace(config.radiance, log2_table_size=config.radiance.log2_table_size + 1)
        directions = DIRECTION_FEATURES[config.direction_encoding]
        self.radiance = Field(grid, 3 + 8, config.hidden, extra_inputs=directions, generator=generator)
        self.geometry = _GeometryOf(self.radiance, directions)

    def _radiance(self, positions: Tensor, viewpoint: Tensor) -> Tensor:
        return super()._radiance(positions, viewpoint)[:, :3]

    def _color_layers(self) -> tuple[list[Tensor], list[Tensor]]:
        *weights, weight = self.radiance.weights
        *biases, bias = self.radiance.biases
        return [*weights, weight[:3]], [*biases, bias[:3]]


class _GeometryOf(nn.Module):
    """The geometry outputs of a single field; owns none of its parameters."""

    def __init__(self, field: Field, directions: int) -> None:
        super().__init__()
        self._field = (field,)  # in a tuple it is not registered again as a part of this module
        self._directions = directions

    def forward(self, coords: Tensor, *, mixed: bool = False) -> Tensor:
        return self._field[0](coords, coords.new_zeros(len(coords), self._directions), mixed=mixed)[:, 3:]


class IsotropicDiffuse(HybridModel):
    """Gaussians that no field has a say in: round, and of one colour from everywhere.

    The background sphere, where there is one, keeps its radiance field. What is left unused is frozen.
    """

    def __init__(self, config: ModelConfig, gaussians: Gaussians, generator: torch.Generator | None = None) -> None:
        super().__init__(config, gaussians, generator)
        self.geometry.requires_grad_(False)
        self.radiance.requires_grad_(config.background)

    def decode_geometry(self, index: Tensor | None = None) -> Geometry:
        explicit = self.gaussians
        pick = (lambda values: values) if index is None else (lambda values: values[index])
        positions = self._field_positions(pick(explicit.positions))
        nothing = positions.new_zeros(len(positions), 8)
        return self.activate(nothing, positions, pick(explicit.scale_logits), pick(explicit.opacity_logits))

    def decode(self) -> Decoded:
        return Decoded(self.decode_geometry(), None)  # colours are no field's

    def decode_colors(self, viewpoint: Tensor, index: Tensor | None = None) -> Tensor:
        logits = self.gaussians.color_logits
        return torch.sigmoid(logits if index is None else logits[index])


class HarmonicColors(HybridModel):
    """Each Gaussian stores the 48 numbers of 3DGS: colour = max(0, 1/2 + sum_k h_k Y_k(direction)), bands 0 to 3.

    They take the place of the colour logits, (N, 48), so density control and the optimiser carry them along. What is
    stored of bands 1 to 3 is 20 h: Adam's steps do not follow the gradient's size, so h moves at a twentieth of the
    rate, as in 3DGS. The radiance field colours the background sphere alone.
    """

    def __init__(self, config: ModelConfig, gaussians: Gaussians, generator: torch.Generator | None = None) -> None:
        super().__init__(config, gaussians, generator)
        with torch.no_grad():
            constant = (torch.sigmoid(gaussians.color_logits) - 0.5) / Y00
            stored = torch.cat((constant, constant.new_zeros(len(constant), 3 * (SH_NUMBERS - 1))), dim=1)
        gaussians.color_logits = nn.Parameter(stored)

    def decode(self) -> Decoded:
        return Decoded(self.decode_geometry(), None)  # colours are no field's

    def decode_colors(self, viewpoint: Tensor, index: Tensor | None = None) -> Tensor:
        positions, stored = self.gaussians.positions, self.gaussians.color_logits
        if index is not None:
            positions, stored = positions[index], stored[index]
        offsets = self._field_positions(positions) - viewpoint
        basis = harmonics_to_degree_3(torch.nn.functional.normalize(offsets, dim=-1, eps=1e-12))
        rates = basis.new_full((SH_NUMBERS,), SH_REST_RATE)
        rates[0] = 1
        coefficients = stored.view(-1, SH_NUMBERS, 3)
        return (torch.einsum("nk,nkc->nc", basis * rates, coefficients) + 0.5).clamp_min(0)


def harmonics_to_degree_3(directions: Tensor) -> Tensor:
    """Real spherical harmonics of bands 0 to 3, orthonormal, at unit vectors (N, 3): (N, 16)."""
    x, y, z = directions.unbind(-1)
    band = torch.stack(
        (
            0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            0.5900435899266435 * x * (x * x - 3 * y * y),
        ),
        dim=-1,
    )
    return torch.cat((spherical_harmonics(directions), band), dim=-1)


class WithoutLogits(Optimizer):
    """Adam for a model that lacks some explicit logits: they are zero and stay so, for new Gaussians too."""

    def __init__(self, model: HybridModel, rates: LearningRates, lacking: tuple[str, ...]) -> None:
        super().__init__(model, rates)
        self.lacking = lacking
        for name in lacking:
            self.reset(name, torch.zeros_like(getattr(model.gaussians, name)))

    def _edit(self, name: str, values: Callable[[Tensor], Tensor], moments: Callable[[Tensor], Tensor]) -> None:
        super()._edit(name, values, moments)
        if name in self.lacking:
            nn.init.zeros_(getattr(self.model.gaussians, name)).requires_grad_(False)


@dataclass(frozen=True)
class Variant:
    """One row of the ablation.

    Attributes:
        name: what is missing.
        paper_psnr: what the paper loses by it, dB; None where it has no such row.
        paper_size, paper_frames: the paper's size and frames per second, as parts of its full model's.
        model: the class that decodes.
        lacking: explicit logits that are held at zero.
        changes: settings of the run.
        saves: whether a `.hyrf` file holds it without ballast.
        culling: whether views are culled before they are decoded.
    """

    name: str
    paper_psnr: float | None = None
    paper_size: float | None = None
    paper_frames: float | None = None
    model: type[HybridModel] = HybridModel
    lacking: tuple[str, ...] = ()
    changes: dict = field(default_factory=dict)
    saves: bool = True
    culling: bool = True


# The paper's differences: Tanks & Temples (24.07 dB, 41 MB, 106 frames/s) for the key components, Deep Blending
# (30.37 dB, 34 MB) for the explicit properties and for spherical harmonics.
NO_SPHERE = {"background": False}
FULL = Variant("full")
TRAINED = (
    FULL,
    Variant("single field", 23.78 - 24.07, 37 / 41, 101 / 106, model=SingleField, saves=False),
    Variant("no explicit properties", 23.45 - 24.07, 27 / 41, 121 / 106, lacking=EXPLICIT),
    Variant("no neural fields", 22.22 - 24.07, 14 / 41, 127 / 106, IsotropicDiffuse, (), NO_SPHERE, saves=False),
    Variant("no neural Gaussians, sphere kept", model=IsotropicDiffuse, saves=False),
    Variant("no background sphere", 23.43 - 24.07, 41 / 41, 112 / 106, changes=NO_SPHERE),
    Variant("no explicit colour", 29.18 - 30.37, lacking=("color_logits",)),
    Variant("no explicit scale", 28.74 - 30.37, lacking=("scale_logits",)),
    Variant("no explicit opacity", 30.21 - 30.37, lacking=("opacity_logits",)),
    Variant("spherical harmonics for colour", 30.12 - 30.37, 267 / 34, model=HarmonicColors, saves=False),
    # The paper does not say whether its row was trained without culling too.
    Variant("no pre-culling, in training neither", 24.06 - 24.07, 41 / 41, 27 / 106, culling=False),
)
NO_CULLING = Variant("no pre-culling", 24.06 - 24.07, 41 / 41, 27 / 106, culling=False)  # renders the full model


def build_trainer(scene: Scene, config: TrainConfig, variant: Variant, cache: PictureCache | None = None) -> Trainer:
    """The product's trainer with a variant's model and optimiser in it, ready to run."""
    trainer = Trainer(scene, replace(config, **variant.changes), cache)
    if variant.model is not HybridModel:
        product = trainer.model
        trainer.model = variant.model(product.config, product.gaussians, torch.Generator().manual_seed(config.seed))
    for name in variant.lacking:
        _start_from_mean(trainer.model, name)
    trainer.optimizer = WithoutLogits(trainer.model, config.learning_rates, variant.lacking)
    return trainer


@torch.no_grad()
def _start_from_mean(model: HybridModel, name: str) -> None:
    """Start the field's output at the mean of the explicit logits that it will have to do without."""
    geometry, radiance = model.geometry.biases[-1], model.radiance.biases[-1]
    bias = {"opacity_logits": geometry[:1], "scale_logits": geometry[1:4], "color_logits": radiance}[name]
    bias.copy_(getattr(model.gaussians, name).mean(0).expand_as(bias))
