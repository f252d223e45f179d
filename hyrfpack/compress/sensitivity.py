"""How much each number of a model matters to pictures, measured on renders: the weights of rate and distortion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hyrfpack.cameras.view_sampling import sample_views
from hyrfpack.format.arrays import SECTION_PARAMETERS
from hyrfpack.format.sections import COLORS, DECODER_SECTIONS, OPACITIES, POSITIONS, SCALES, TABLE_SECTIONS
from hyrfpack.model import Geometry, HybridModel, expand
from hyrfpack.progress import Report, no_report
from hyrfpack.render import render
from hyrfpack.scene import Camera

DRAWN = 3_000_000  # Gaussians drawn in all views together, about: more views of smaller models
FEWEST, MOST = 6, 96  # views
FIELD_VIEWS = 1 / 2  # share of the views that the fields are measured on; each counts for many Gaussians there
TRUSTED = 8.0  # views that the guess from size, opacity and place counts for
CELLS = 32  # of the cube, along each axis, in which guess and measurement are brought together
NEAREST = 0.05  # local units
LEAST = 1e-2  # of a decoder's number, against the mean of its decoder
WITHOUT = 1e-6  # error that zeros for a whole decoder add at least: where all is saturated, no slope tells
PRUNED = "pruned"  # what is not stored, beside the sections


@dataclass(frozen=True)
class Sensitivity:
    """Mean squared derivatives of pictures by each number of a model.

    For a number x it is s = mean over views, pixels and channels of (d colour / d x)^2, so that an error e in x adds
    about s e^2 to the pictures' mean squared error. All are float64, 0 or more.

    Attributes:
        positions: (N,) by a coordinate in the contracted cube, mean of the three axes.
        colors: (N,) by a colour logit, mean of the three.
        scales, opacities: (N,) by the explicit logits.
        removals: (N,) what leaving out a Gaussian adds to the mean squared error itself, see `removal_error`.
        fields: by the numbers of each hash table and decoder, laid out as in the file, by section.
    """

    positions: np.ndarray
    colors: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    removals: np.ndarray
    fields: dict[str, np.ndarray]

    def of(self, index: np.ndarray | slice) -> Sensitivity:
        """That of the Gaussians at `index` (n,) int64, and of all fields."""
        positions, colors, scales = self.positions[index], self.colors[index], self.scales[index]
        return Sensitivity(positions, colors, scales, self.opacities[index], self.removals[index], self.fields)

    def times(self, factors: dict[str, float]) -> Sensitivity:
        """Each section's, and what is PRUNED, multiplied by its factor; 1 where there is none."""
        positions, colors, scales, opacities, removals = (
            values * factors.get(group, 1.0)
            for group, values in (
                (POSITIONS, self.positions),
                (COLORS, self.colors),
                (SCALES, self.scales),
                (OPACITIES, self.opacities),
                (PRUNED, self.removals),
            )
        )
        fields = {group: values * factors.get(group, 1.0) for group, values in self.fields.items()}
        return Sensitivity(positions, colors, scales, opacities, removals, fields)


def measure_sensitivity(
    model: HybridModel, cameras: Sequence[Camera], seed: int = 0, report: Report = no_report
) -> Sensitivity:
    """Estimate the mean squared derivatives of pictures by every number of a model.

    With v a picture of random signs, the derivative of (picture . v) by a number x is a sum of random signs times the
    pixels' derivatives by x; its square is on average the sum of their squares (Hutchinson 1990). One such v a view,
    half of the views at cameras and half between them.

    A Gaussian is measured in few views, or in none, and still may be seen in others. So what is measured is blended
    with a guess from its size, opacity and place, which is right on average where it stands.

    Args:
        cameras: where pictures will be looked at from, about; world units.
        seed: of the signs and of the views between cameras.
        report: told of each view, and the share of the work that is done.

    Raises:
        HyrfError: a number of the model is NaN or infinite.
    """
    count = int(np.clip(DRAWN // max(len(model), 1), FEWEST, MOST)) // 2
    at, between = sample_views(cameras, count, seed)
    views = [view for pair in zip(at, between, strict=True) for view in pair]
    every = max(1, round(1 / FIELD_VIEWS))
    generator = torch.Generator().manual_seed(seed)
    squares = {name: torch.zeros_like(parameter) for name, parameter in model.named_parameters()}
    stretch = _stretch(model)
    wanted = {name: parameter.requires_grad for name, parameter in model.named_parameters()}
    pixels, field_pixels = 0, 0
    for number, camera in enumerate(views):
        report(f"measuring sensitivities, view {number + 1} of {len(views)}", number / len(views))
        # Pairs alternate, so a field's views fall on cameras and between them.
        with_fields = number % (2 * every) < 2
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(with_fields or name.startswith("gaussians"))
            parameter.grad = None
        rgb = render(model, camera).rgb
        signs = torch.randint(0, 2, rgb.shape, generator=generator).to(rgb) * 2 - 1
        if rgb.requires_grad:
            (rgb * signs).sum().backward()
        pixels += rgb.numel()
        field_pixels += rgb.numel() * with_fields
        for name, parameter in model.named_parameters():
            gradient = parameter.grad
            if gradient is None:
                continue
            if name == "gaussians.positions":
                gradient = (stretch * gradient[:, :, None]).sum(1)
            squares[name] += gradient.square()
            parameter.grad = None
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(wanted[name])
    return _gathered(model, squares, pixels, field_pixels, at, stretch)


@torch.no_grad()
def _gathered(
    model: HybridModel,
    squares: dict[str, torch.Tensor],
    pixels: int,
    field_pixels: int,
    cameras: Sequence[Camera],
    stretch: torch.Tensor,
) -> Sensitivity:
    geometry = model.decode_geometry()
    expected = _expected(model, geometry, cameras, stretch)
    views = len(cameras) * 2
    explicit = []
    for name, guess in expected.items():
        measured = squares[f"gaussians.{name}"].double().mean(dim=1).cpu().numpy() / pixels
        # What is measured in few views is shaky, and a Gaussian that none shows may be seen in others.
        explicit.append(
            np.maximum((views * measured + TRUSTED * _local(model, measured, guess)) / (views + TRUSTED), 1e-30)
        )
    fields = {
        group: np.concatenate([squares[name].double().cpu().numpy().ravel() for name in SECTION_PARAMETERS[group]])
        / field_pixels
        for group in (*TABLE_SECTIONS, *DECODER_SECTIONS)
    }
    # Both numbers of a row are read together.
    fields |= {group: fields[group].reshape(-1, 2).mean(axis=1).repeat(2) for group in TABLE_SECTIONS}
    parameters = dict(model.named_parameters())
    for group in DECODER_SECTIONS:
        size = sum(float(parameters[name].detach().double().square().sum()) for name in SECTION_PARAMETERS[group])
        fields[group] = np.maximum(fields[group], max(LEAST * fields[group].mean(), WITHOUT / max(size, 1e-30)))
    positions, colors, scales, opacities = explicit
    removals = removal_error(geometry.opacities.double().cpu().numpy(), opacities)
    return Sensitivity(positions, colors, scales, opacities, removals, fields)


def removal_error(opacities: np.ndarray, by_logit: np.ndarray) -> np.ndarray:
    """(N,) what leaving out each Gaussian adds to the pictures' mean squared error.

    By the opacity o itself the sensitivity is s / (o (1 - o))^2, s being that by its logit.

    Args:
        opacities: (N,) in [0, 1].
        by_logit: (N,) sensitivities by explicit opacity logits.
    """
    return by_logit / np.maximum(opacities * (1 - opacities), 1e-4) ** 2 * opacities**2


def _local(model: HybridModel, measured: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """The guess (N,), scaled so that it agrees with what was measured (N,) in each part of space and in all."""
    cube = model.cube_coords(model.gaussians.positions.detach()).cpu().numpy()
    cells = np.minimum((cube * CELLS).astype(np.int64), CELLS - 1) @ np.array((1, CELLS, CELLS**2))
    sums = [np.bincount(cells, values, CELLS**3) for values in (measured, guess)]
    overall = measured.sum() / max(guess.sum(), 1e-300)
    # A part where little was seen leans on all of space.
    weight = guess.sum() / max(np.count_nonzero(sums[1]), 1)
    return guess * ((sums[0] + overall * weight) / (sums[1] + weight))[cells]


@torch.enable_grad()
def _stretch(model: HybridModel) -> torch.Tensor:
    """(N, 3, 3): d local position / d cube coordinate, rows local axes, columns cube axes."""
    cube = model.cube_coords(model.gaussians.positions.detach().double()).requires_grad_()
    local = expand(cube) * cube.new_tensor(model.config.frame.half_extent)
    rows = [torch.autograd.grad(local[:, axis].sum(), cube, retain_graph=True)[0] for axis in range(3)]
    return torch.stack(rows, dim=1).float()


@torch.no_grad()
def _expected(
    model: HybridModel, geometry: Geometry, cameras: Sequence[Camera], stretch: torch.Tensor
) -> dict[str, np.ndarray]:
    """(N,) each: what a Gaussian's numbers would do to pictures, up to a factor, if nothing stood before it.

    Each pixel under a Gaussian of opacity o and standard deviations a, b (the larger two) depends on its colour by o at
    most, and there are pi f^2 a b / z^2 of them; on its opacity logit by o (1 - o); on its place by o / (a b)^(1/2).
    """
    sides = geometry.scales.double().sort(dim=1).values
    area, opacities = sides[:, 1] * sides[:, 2], geometry.opacities.double()
    total = torch.zeros_like(area)
    frame = model.config.frame
    positions = model.gaussians.positions.double()
    for camera in cameras:
        place = torch.as_tensor((camera.position - np.array(frame.center)) / frame.scale).to(positions)
        distance = torch.linalg.vector_norm(positions - place, dim=1).clamp_min(NEAREST)
        total += (area * (camera.fx * camera.fy / (camera.width * camera.height)) / distance**2).clamp_max(1)
    seen = total * opacities**2
    stretched = stretch.double().square().sum(dim=(1, 2))
    guesses = {
        "positions": seen * stretched / area.clamp_min(1e-12),
        "color_logits": seen,
        "scale_logits": seen,
        "opacity_logits": seen * (1 - opacities).clamp_min(1e-3) ** 2,
    }
    return {name: values.cpu().numpy() for name, values in guesses.items()}
