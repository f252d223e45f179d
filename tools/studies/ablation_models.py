"""Define the variants of `tools/studies/ablations.py`: models without one part, each with a fair start of training.

Everything else is that of hyrfpack: photos, first Gaussians, budget, density control, losses and schedules.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from hyrfpack.config.train import FIELD_WARMUP_STEPS, LearningRates, TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.model import Decoded, Geometry, HybridModel, ModelConfig
from hyrfpack.model.field import Field
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.rows import take_rows
from hyrfpack.ops.shade import DIRECTION_FEATURES, Shading, spherical_harmonics
from hyrfpack.scene import Scene
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.trainer import Trainer

EXPLICIT_LOGITS = ("color_logits", "scale_logits", "opacity_logits")
SH_CONSTANT = 0.28209479177387814  # value of the constant spherical harmonic, 1 / sqrt(4 pi)
SH_COEFFICIENTS = 16  # bands 0 to 3 have this many coefficients for each colour channel
SH_REST_RATE_RATIO = 1 / 20  # the learning rate of bands 1 to 3 over that of band 0, as in 3DGS


class SingleField(HybridModel):
    """A model with one grid and one decoder for geometry and radiance.

    The table has twice the rows of the radiance table on levels that fill it, as in the paper. That is at most a third
    more rows than both tables have together. Geometry does not depend on the view, because it is evaluated with the
    direction's inputs at zero.
    """

    def __init__(self, config: ModelConfig, gaussians: Gaussians, generator: torch.Generator | None = None) -> None:
        super().__init__(config, gaussians, generator)
        grid = replace(config.radiance, log2_table_size=config.radiance.log2_table_size + 1)
        directions = DIRECTION_FEATURES[config.direction_encoding]
        self.radiance = Field(grid, 3 + 8, config.hidden, extra_inputs=directions, generator=generator)
        self.geometry = _GeometryOutputs(self.radiance, directions)

    def _radiance(self, positions: Tensor, viewpoint: Tensor, used: Tensor | None) -> Tensor:
        return super()._radiance(positions, viewpoint, used)[:, :3]

    def _color_layers(self) -> tuple[list[Tensor], list[Tensor]]:
        *weights, weight = self.radiance.weights
        *biases, bias = self.radiance.biases
        return [*weights, weight[:3]], [*biases, bias[:3]]


class _GeometryOutputs(nn.Module):
    """The geometry outputs of a single field, without parameters of their own."""

    def __init__(self, field: Field, directions: int) -> None:
        super().__init__()
        self._field = (field,)  # the tuple keeps torch from registering the field as a submodule again
        self._directions = directions

    def forward(self, coords: Tensor, *, mixed: bool = False, used: Tensor | None = None) -> Tensor:
        return self._field[0](coords, coords.new_zeros(len(coords), self._directions), mixed=mixed, used=used)[:, 3:]


class IsotropicDiffuse(HybridModel):
    """A model of isotropic Gaussians with one colour for all views, without fields.

    The background sphere, if there is one, keeps its radiance field. Unused parameters are frozen.
    """

    def __init__(self, config: ModelConfig, gaussians: Gaussians, generator: torch.Generator | None = None) -> None:
        super().__init__(config, gaussians, generator)
        self.geometry.requires_grad_(False)
        self.radiance.requires_grad_(config.background)

    def decode_geometry(self, index: Tensor | None = None, used: Tensor | None = None) -> Geometry:
        explicit = self.gaussians
        select = (lambda values: values) if index is None else (lambda values: take_rows(values, index, used))
        positions = self._field_positions(select(explicit.positions))
        nothing = positions.new_zeros(len(positions), 8)
        return self.activate(nothing, positions, select(explicit.scale_logits), select(explicit.opacity_logits), used)

    def decode(self) -> Decoded:
        return Decoded(self.decode_geometry(), None)  # no field predicts colours

    def decode_colors(
        self,
        viewpoint: Tensor,
        index: Tensor | None = None,
        shading: Shading | None = None,
        used: Tensor | None = None,
    ) -> Tensor:
        logits = self.gaussians.color_logits
        return torch.sigmoid(logits if index is None else take_rows(logits, index, used))


class HarmonicColors(HybridModel):
    """A model whose Gaussians store the 48 harmonics of 3DGS: colour = max(0, 1/2 + sum_k h_k Y_k(direction)).

    They replace the colour logits as (N, 48), so that density control and the optimiser handle them. For bands 1 to 3
    the stored number is 20 h. Adam's step does not depend on the gradient's magnitude, so h changes at 1/20 of the
    learning rate, as in 3DGS. The radiance field colours only the background sphere.
    """

    def __init__(self, config: ModelConfig, gaussians: Gaussians, generator: torch.Generator | None = None) -> None:
        super().__init__(config, gaussians, generator)
        with torch.no_grad():
            constant = (torch.sigmoid(gaussians.color_logits) - 0.5) / SH_CONSTANT
            stored = torch.cat((constant, constant.new_zeros(len(constant), 3 * (SH_COEFFICIENTS - 1))), dim=1)
        gaussians.color_logits = nn.Parameter(stored)

    def decode(self) -> Decoded:
        return Decoded(self.decode_geometry(), None)  # no field predicts colours

    def decode_colors(
        self,
        viewpoint: Tensor,
        index: Tensor | None = None,
        shading: Shading | None = None,
        used: Tensor | None = None,
    ) -> Tensor:
        positions, stored = self.gaussians.positions, self.gaussians.color_logits
        if index is not None:
            positions, stored = take_rows(positions, index, used), take_rows(stored, index, used)
        offsets = self._field_positions(positions) - viewpoint
        basis = evaluate_harmonics_to_degree_3(torch.nn.functional.normalize(offsets, dim=-1, eps=1e-12))
        rates = basis.new_full((SH_COEFFICIENTS,), SH_REST_RATE_RATIO)
        rates[0] = 1
        coefficients = stored.view(-1, SH_COEFFICIENTS, 3)
        return (torch.einsum("nk,nkc->nc", basis * rates, coefficients) + 0.5).clamp_min(0)


def evaluate_harmonics_to_degree_3(directions: Tensor) -> Tensor:
    """Return the orthonormal real spherical harmonics of bands 0 to 3, (N, 16), at unit vectors (N, 3)."""
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


class OptimizerWithoutLogits(Optimizer):
    """Adam for a model that lacks some explicit logits; these stay zero, also for new Gaussians.

    Density control scores the importance of Gaussians by the gradients of opacity logits. So these are computed even if
    the opacity logits are missing, and cleared before each step.
    """

    def __init__(self, model: HybridModel, rates: LearningRates, missing_logits: tuple[str, ...]) -> None:
        super().__init__(model, rates, warmup_steps=FIELD_WARMUP_STEPS)
        self.missing_logits = missing_logits
        for name in missing_logits:
            self.reset(name, torch.zeros_like(getattr(model.gaussians, name)))

    def step(self, step: int, steps: int, enabled: Tensor | None = None) -> Tensor:
        for name in self.missing_logits:
            getattr(self.model.gaussians, name).grad = None
        return super().step(step, steps, enabled)

    def _edit(self, name: str, values: Callable[[Tensor], Tensor], moments: Callable[[Tensor], Tensor]) -> None:
        super()._edit(name, values, moments)
        if name in self.missing_logits:
            nn.init.zeros_(getattr(self.model.gaussians, name)).requires_grad_(name == "opacity_logits")


@dataclass(frozen=True)
class Variant:
    """One row of the ablation.

    Attributes:
        name: the missing part.
        paper_psnr: the paper's change of PSNR in dB; None if the paper has no such row.
        paper_size: the paper's size over that of its full model.
        paper_frames: the paper's frames per second over those of its full model.
        model: the class of the model.
        missing_logits: explicit logits that are fixed at zero.
        changes: changed settings of the training run.
        can_save: whether a `.hyrf` file can store the model without unused parts.
        has_culling: whether Gaussians are culled before they are decoded.
    """

    name: str
    paper_psnr: float | None = None
    paper_size: float | None = None
    paper_frames: float | None = None
    model: type[HybridModel] = HybridModel
    missing_logits: tuple[str, ...] = ()
    changes: dict = field(default_factory=dict)
    can_save: bool = True
    has_culling: bool = True


# The paper measures the key components on Tanks & Temples (24.07 dB, 41 MB, 106 frames/s), and the explicit properties
# and spherical harmonics on Deep Blending (30.37 dB, 34 MB).
NO_SPHERE_SETTINGS = {"background": False}
FULL_VARIANT = Variant("full")
TRAINED_VARIANTS = (
    FULL_VARIANT,
    Variant("single field", 23.78 - 24.07, 37 / 41, 101 / 106, model=SingleField, can_save=False),
    Variant("no explicit properties", 23.45 - 24.07, 27 / 41, 121 / 106, missing_logits=EXPLICIT_LOGITS),
    Variant(
        "no neural fields", 22.22 - 24.07, 14 / 41, 127 / 106, IsotropicDiffuse, (), NO_SPHERE_SETTINGS, can_save=False
    ),
    Variant("no neural Gaussians, sphere kept", model=IsotropicDiffuse, can_save=False),
    Variant("no background sphere", 23.43 - 24.07, 41 / 41, 112 / 106, changes=NO_SPHERE_SETTINGS),
    Variant("no explicit colour", 29.18 - 30.37, missing_logits=("color_logits",)),
    Variant("no explicit scale", 28.74 - 30.37, missing_logits=("scale_logits",)),
    Variant("no explicit opacity", 30.21 - 30.37, missing_logits=("opacity_logits",)),
    Variant("spherical harmonics for colour", 30.12 - 30.37, 267 / 34, model=HarmonicColors, can_save=False),
    # The paper does not say whether its row was trained without culling too.
    Variant("no pre-culling, in training neither", 24.06 - 24.07, 41 / 41, 27 / 106, has_culling=False),
)
NO_CULLING_VARIANT = Variant(
    "no pre-culling", 24.06 - 24.07, 41 / 41, 27 / 106, has_culling=False
)  # this row renders the full model


def build_trainer(scene: Scene, config: TrainConfig, variant: Variant, cache: PictureCache | None = None) -> Trainer:
    """Return hyrfpack's trainer with a variant's model and optimiser."""
    trainer = Trainer(scene, replace(config, **variant.changes), cache)
    if variant.model is not HybridModel:
        trainer.model = _replace_model(trainer.model, variant.model, config.seed)
    for name in variant.missing_logits:
        _start_from_mean(trainer.model, name)
    trainer.optimizer = OptimizerWithoutLogits(trainer.model, trainer.learning_rates, variant.missing_logits)
    return trainer


@torch.no_grad()
def _replace_model(model: HybridModel, kind: type[HybridModel], seed: int) -> HybridModel:
    """Return an untrained model of another kind with the same Gaussians, which start with the same colours.

    The radiance field starts at the colour that `build_model` chose. It colours the background sphere in all kinds of
    models, and Gaussians only in a SingleField.
    """
    start = model.radiance.biases[-1].detach()
    if kind is not SingleField:
        model.gaussians.color_logits.add_(start)
    replaced = kind(model.config, model.gaussians, torch.Generator().manual_seed(seed))
    replaced.radiance.biases[-1][: len(start)] = start
    replaced.copy_settings(model)
    return replaced


@torch.no_grad()
def _start_from_mean(model: HybridModel, name: str) -> None:
    """Add the mean of the explicit logits that the variant lacks to the field's output bias."""
    geometry, radiance = model.geometry.biases[-1], model.radiance.biases[-1]
    bias = {"opacity_logits": geometry[:1], "scale_logits": geometry[1:4], "color_logits": radiance}[name]
    bias.add_(getattr(model.gaussians, name).mean(0).expand_as(bias))
