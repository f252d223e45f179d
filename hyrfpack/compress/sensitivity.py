"""Measure sensitivities: mean squared derivatives of rendered pictures with respect to each number of a model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from hyrfpack.cameras.view_sampling import Windows, sample_views, sample_windows
from hyrfpack.format.arrays import SECTION_PARAMETERS
from hyrfpack.format.sections import (
    COLORS,
    DECODER_SECTIONS,
    HARMONICS,
    OPACITIES,
    POSITIONS,
    SCALES,
    SHAPES,
    TABLE_SECTIONS,
)
from hyrfpack.model import Geometry, HybridModel, expand
from hyrfpack.model.field import Field
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.parallel.pool import iterate_results, map_row_blocks, torch_on_one_thread
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import render_view
from hyrfpack.render.in_view import gaussians_in_view
from hyrfpack.scene import Camera

# The number of views is chosen so that about this many Gaussians are drawn in all views together. Of large models,
# MIN_SENSITIVITY_VIEWS views show one window each, because few whole pictures would leave out many Gaussians.
TARGET_DRAWN_GAUSSIANS = 3_000_000
MIN_SENSITIVITY_VIEWS = 48
MAX_SENSITIVITY_VIEWS = 96
# Fields need fewer views than Gaussians, because each of their numbers affects many Gaussians in a view.
FIELD_VIEW_SHARE = 1 / 2
# The estimate from size, opacity and position has the weight of this many measured views.
PRIOR_WEIGHT_VIEWS = 8.0
# The estimate is scaled to the measurement in each cell of a grid over the contracted cube.
PRIOR_CELLS_PER_AXIS = 32
MIN_CAMERA_DISTANCE_LOCAL = 0.05
MIN_PRIOR_SUM = 1e-300
# Lower bound of the sensitivity of a decoder's number, as a share of the mean of its decoder.
MIN_RELATIVE_DECODER_SENSITIVITY = 1e-2
# Setting a whole decoder to zero is assumed to add at least this error, because gradients vanish under saturation.
MIN_ZEROED_DECODER_ERROR = 1e-6
# Bound of the factor by which the sensitivity of a thin Gaussian's rotation exceeds that of its scales.
MAX_SHAPE_ANISOTROPY = 1e4
# Key of the Gaussians that are left out, beside the names of the sections.
PRUNED_KEY = "pruned"
# Lower bound of the sensitivities of a Gaussian, which is theirs where no view shows it or its neighbours.
MIN_SENSITIVITY = 1e-30


@dataclass(frozen=True)
class Sensitivity:
    """Mean squared derivatives of pictures with respect to each number of a model.

    The sensitivity of a number x is s = mean over views, pixels and channels of (d colour / d x)^2. An error e in x
    adds about s e^2 to the pictures' mean squared error. All values are float64, 0 or more.

    Attributes:
        positions: (N,) sensitivity of a coordinate in the contracted cube, mean of the three axes.
        colors: (N,) sensitivity of a colour logit, mean of the three.
        scales, opacities: (N,) sensitivities of the explicit logits.
        removals: (N,) mean squared error that leaving out a Gaussian adds, see `removal_error`.
        fields: sensitivities of each hash table and decoder by section, in the order of the file.
        shapes, harmonics: (N, 5) sensitivities of the shape residuals, and (N,) of a coefficient of the colour
            residuals, the mean of all; None for a model without residuals.
    """

    positions: np.ndarray
    colors: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    removals: np.ndarray
    fields: dict[str, np.ndarray]
    shapes: np.ndarray | None = None
    harmonics: np.ndarray | None = None

    @property
    def is_seen(self) -> bool:
        """Whether any of the measured views shows a Gaussian."""
        return bool((self.colors > MIN_SENSITIVITY).any())

    def subset(self, index: np.ndarray | slice) -> Sensitivity:
        """Return the sensitivities of the Gaussians at `index` (n,) int64, and of all fields."""
        shapes, harmonics = (None if values is None else values[index] for values in (self.shapes, self.harmonics))
        positions, colors, scales = self.positions[index], self.colors[index], self.scales[index]
        opacities, removals = self.opacities[index], self.removals[index]
        return Sensitivity(positions, colors, scales, opacities, removals, self.fields, shapes, harmonics)

    def scaled_by(self, factors: dict[str, float]) -> Sensitivity:
        """Multiply each section, and the removals (PRUNED_KEY), by its factor, which is 1 if it is not given."""
        positions, colors, scales, opacities, removals = (
            values * factors.get(group, 1.0)
            for group, values in (
                (POSITIONS, self.positions),
                (COLORS, self.colors),
                (SCALES, self.scales),
                (OPACITIES, self.opacities),
                (PRUNED_KEY, self.removals),
            )
        )
        fields = {group: values * factors.get(group, 1.0) for group, values in self.fields.items()}
        shapes, harmonics = (
            None if values is None else values * factors.get(group, 1.0)
            for group, values in ((SHAPES, self.shapes), (HARMONICS, self.harmonics))
        )
        return Sensitivity(positions, colors, scales, opacities, removals, fields, shapes, harmonics)


@torch_on_one_thread()
def measure_sensitivity(
    model: HybridModel,
    cameras: Sequence[Camera],
    seed: int = 0,
    progress: Progress = ignore_progress,
    drawn: int = TARGET_DRAWN_GAUSSIANS,
    geometry: Geometry | None = None,
) -> Sensitivity:
    """Estimate the mean squared derivatives of pictures with respect to every number of a model.

    Let v be a picture of random signs. The derivative of (picture . v) with respect to a number x is the sum of the
    pixels' derivatives with random signs. The expectation of its square is the sum of their squares (Hutchinson 1990).
    One v is drawn for each view. Half of the views are at cameras and half between them. Of a large model, each view is
    a window of a picture.

    A Gaussian may be visible in few of the measured views, or in none, and still be visible in others. So measurements
    are averaged with an estimate from size, opacity and position, which is scaled to match the measurements nearby.

    Args:
        model: the model to measure.
        cameras: viewpoints typical of how the model will be viewed; world units.
        seed: random seed of the signs, which a device draws itself, and of the views between cameras.
        progress: called with `TaskEvent`s.
        drawn: about how many Gaussians are drawn in all views together; more make the measurement less noisy.
        geometry: the geometry of all Gaussians, if it is known.

    Raises:
        HyrfError: a number of the model is NaN or infinite.
    """
    windows = choose_windows(cameras, len(model), drawn, seed)
    views, positions = windows.views, model.gaussians.positions
    field_interval = max(1, round(1 / FIELD_VIEW_SHARE))
    generator = torch.Generator(positions.device).manual_seed(seed)
    squares = {name: torch.zeros_like(parameter) for name, parameter in model.named_parameters()}
    squares |= {f"gaussians.{name}": torch.zeros_like(values) for name, values in _residuals(model).items()}
    jacobian = _cube_jacobian(model)
    frozen_fields = _freeze(model.geometry), _freeze(model.radiance)
    required = {name: parameter.requires_grad for name, parameter in model.named_parameters()}
    pixels, field_pixels, is_window = 0, 0, windows.columns * windows.rows > 1

    def iterate_jobs() -> Iterator[tuple[Camera, torch.Tensor, tuple[Field, Field] | None]]:
        nonlocal pixels, field_pixels
        for number, camera in enumerate(views):
            progress(TaskEvent(f"measuring sensitivities, view {number + 1}/{len(views)}", number / len(views)))
            signs = draw_signs(positions.new_empty(camera.height, camera.width, 3), generator)
            # Views at and between cameras alternate, so both kinds are among the views of the fields.
            with_fields = number % (2 * field_interval) < 2
            pixels += signs.numel()
            field_pixels += signs.numel() * with_fields
            yield camera, signs, None if with_fields else frozen_fields

    def measure(job: tuple[Camera, torch.Tensor, tuple[Field, Field] | None]):
        return _square_gradients(model, *job, is_window=is_window, jacobian=jacobian)

    try:
        for values in (*model.parameters(), *_residuals(model).values()):
            values.requires_grad_(True)
        # Each thread measures a whole view, and sums are made in the order of views.
        for index, added in iterate_results(measure, iterate_jobs(), positions.device):
            for name, values in added.items():
                if name.startswith("gaussians."):
                    squares[name][index] += values
                else:
                    squares[name] += values
    finally:
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(required[name])
        for values in _residuals(model).values():
            values.requires_grad_(False)
    at, _ = sample_views(cameras, len(views) // 2, seed)
    with torch.no_grad():
        geometry = model.decode_geometry() if geometry is None else geometry
    return _combine(model, geometry, squares, pixels, field_pixels, at, windows.pictures, jacobian)


@torch.enable_grad()
def _square_gradients(
    model: HybridModel,
    camera: Camera,
    signs: torch.Tensor,
    fields: tuple[Field, Field] | None,
    *,
    is_window: bool,
    jacobian: torch.Tensor,
) -> tuple[slice | torch.Tensor, dict[str, torch.Tensor]]:
    """Return the squared derivatives of a view, times signs, with respect to the numbers of a model.

    Args:
        camera: the view.
        signs: (H, W, 3) from `draw_signs`.
        fields: geometry and radiance field to render with, which get no derivatives; None for those of the model.
        is_window: whether the view shows few of the Gaussians. Then only these are rendered, so that derivatives of the
            others take no memory.
        jacobian: (N, 3, 3) from `_cube_jacobian`.

    Returns:
        The index of the Gaussians that were rendered, and the squares by parameter or buffer.
    """
    index: slice | torch.Tensor = slice(None)
    gaussians = model.gaussians
    if is_window:
        index = _indices_in_view(model, camera)
        gaussians = gaussians.subset(index)
    shown = model.with_gaussians(gaussians)
    if fields is not None:
        shown.geometry, shown.radiance = fields
    wanted: dict[str, torch.Tensor] = {
        name: values for name, values in shown.named_parameters() if values.requires_grad
    }
    wanted |= {f"gaussians.{name}": values.requires_grad_(True) for name, values in _residuals(shown).items()}
    rgb = render_view(shown, camera).rgb
    if not rgb.requires_grad:
        return index, {}
    gradients = torch.autograd.grad((rgb * signs).sum(), list(wanted.values()), allow_unused=True)
    squares = {}
    for name, gradient in zip(wanted, gradients, strict=True):
        if gradient is not None:
            if name == "gaussians.positions":
                gradient = (jacobian[index] * gradient[:, :, None]).sum(1)
            squares[name] = gradient.square()
    return index, squares


def _freeze(field: Field) -> Field:
    """Return a copy of a field with the same numbers, in the same memory, that gets no gradients."""
    shared = {id(values): nn.Parameter(values.detach(), requires_grad=False) for values in field.parameters()}
    return deepcopy(field, shared)


def draw_signs(image: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Draw a random sign, 1 or -1, for each number of an image, on the device of the image and of the generator."""
    bits = torch.randint(0, 2, image.shape, generator=generator, dtype=torch.int8, device=image.device)
    return bits.to(image.dtype) * 2 - 1


def _residuals(model: HybridModel) -> dict[str, torch.Tensor]:
    """Return the residuals of a model's Gaussians by name."""
    return {name: values for name, values in model.gaussians.named_buffers() if name in Gaussians.RESIDUAL_NAMES}


def _indices_in_view(model: HybridModel, camera: Camera) -> torch.Tensor:
    """Return the Gaussians that a camera shows; all of them if a position is not finite, which rendering reports."""
    try:
        return gaussians_in_view(model, camera)
    except FloatingPointError:
        return torch.arange(len(model), device=model.gaussians.positions.device)


def choose_windows(
    cameras: Sequence[Camera], gaussians: int, drawn: int = TARGET_DRAWN_GAUSSIANS, seed: int = 0
) -> Windows:
    """Choose the views in which a model of so many Gaussians is measured.

    Args:
        cameras, seed: as `sample_windows` takes them.
        gaussians: number of Gaussians of the model.
        drawn: about how many Gaussians are drawn in all views together.
    """
    count = int(np.clip(drawn // max(gaussians, 1), MIN_SENSITIVITY_VIEWS, MAX_SENSITIVITY_VIEWS))
    return sample_windows(cameras, count, round(count * gaussians / drawn), seed)


@torch.no_grad()
def _combine(
    model: HybridModel,
    geometry: Geometry,
    squares: dict[str, torch.Tensor],
    pixels: int,
    field_pixels: int,
    cameras: Sequence[Camera],
    views: float,
    jacobian: torch.Tensor,
) -> Sensitivity:
    """Average the accumulated squared gradients, combine them with the prior estimate, and apply lower bounds."""
    expected, cells = _expected_sensitivity(model, geometry, cameras, jacobian), prior_cells(model)
    explicit = []
    for name, guess in expected.items():
        measured = squares[f"gaussians.{name}"].double().mean(dim=1).cpu().numpy() / pixels
        explicit.append(combine_with_prior(cells, measured, guess, views))
    fields = {
        group: np.concatenate([squares[name].double().cpu().numpy().ravel() for name in SECTION_PARAMETERS[group]])
        / field_pixels
        for group in (*TABLE_SECTIONS, *DECODER_SECTIONS)
    }
    # Both numbers of a row are read together, so they get the same sensitivity.
    fields |= {group: fields[group].reshape(-1, 2).mean(axis=1).repeat(2) for group in TABLE_SECTIONS}
    parameters = dict(model.named_parameters())
    for group in DECODER_SECTIONS:
        size = sum(float(parameters[name].detach().double().square().sum()) for name in SECTION_PARAMETERS[group])
        fields[group] = np.maximum(
            fields[group],
            max(MIN_RELATIVE_DECODER_SENSITIVITY * fields[group].mean(), MIN_ZEROED_DECODER_ERROR / max(size, 1e-30)),
        )
    positions, colors, scales, opacities = explicit
    removals = removal_error(geometry.opacities.double().cpu().numpy(), opacities)
    if model.gaussians.shape_residuals is None:
        return Sensitivity(positions, colors, scales, opacities, removals, fields)
    measured = squares["gaussians.shape_residuals"].double().cpu().numpy() / pixels
    guesses = _expected_shape_sensitivity(geometry, expected["scale_logits"])
    pairs = zip(measured.T, guesses.T, strict=True)
    shapes = np.stack([combine_with_prior(cells, values, guess, views) for values, guess in pairs], axis=1)
    measured = squares["gaussians.color_residuals"].mean(dim=1).double().cpu().numpy() / pixels
    harmonics = combine_with_prior(cells, measured, expected["color_logits"], views)
    return Sensitivity(positions, colors, scales, opacities, removals, fields, shapes, harmonics)


def _expected_shape_sensitivity(geometry: Geometry, scale_sensitivity: np.ndarray) -> np.ndarray:
    """Estimate the sensitivities (N, 5) of shape residuals, up to a factor for each column.

    Turning a Gaussian about an axis changes its covariance in proportion to the difference of the other two variances.
    """
    scales = geometry.scales.double().cpu().numpy()
    ratios = np.roll(scales, -1, axis=1) / np.maximum(np.roll(scales, -2, axis=1), 1e-12)
    turns = np.minimum((ratios - 1 / np.maximum(ratios, 1e-12)) ** 2, MAX_SHAPE_ANISOTROPY)
    return scale_sensitivity[:, None] * np.concatenate((np.ones((len(scales), 2)), turns), axis=1)


def combine_with_prior(cells: np.ndarray, measured: np.ndarray, guess: np.ndarray, views: float) -> np.ndarray:
    """Average sensitivities (N,) measured in a number of views with estimates, which are known up to a factor.

    Few views give a noisy measurement, and a Gaussian that none of them shows may be visible in others.

    Args:
        cells: (N,) the cell of each Gaussian, see `prior_cells`.
        measured: (N,) sensitivities measured in the views.
        guess: (N,) estimates.
        views: the number of views.
    """
    prior = _fit_prior(cells, measured, guess)
    return np.maximum((views * measured + PRIOR_WEIGHT_VIEWS * prior) / (views + PRIOR_WEIGHT_VIEWS), MIN_SENSITIVITY)


def removal_error(opacities: np.ndarray, logit_sensitivity: np.ndarray) -> np.ndarray:
    """Estimate the mean squared error (N,) that leaving out each Gaussian adds to the pictures.

    If s is the sensitivity of the opacity logit, that of the opacity o itself is s / (o (1 - o))^2. Setting o to 0 adds
    o^2 times that.

    Args:
        opacities: (N,) in [0, 1].
        logit_sensitivity: (N,) sensitivities of the explicit opacity logits.
    """
    return logit_sensitivity / np.maximum(opacities * (1 - opacities), 1e-4) ** 2 * opacities**2


def prior_cells(model: HybridModel) -> np.ndarray:
    """Return the cell (N,) of the cube in which each Gaussian lies; estimates are scaled by cells."""
    cube = model.cube_coords(model.gaussians.positions.detach()).cpu().numpy()
    return np.minimum((cube * PRIOR_CELLS_PER_AXIS).astype(np.int64), PRIOR_CELLS_PER_AXIS - 1) @ np.array(
        (1, PRIOR_CELLS_PER_AXIS, PRIOR_CELLS_PER_AXIS**2)
    )


def _fit_prior(cells: np.ndarray, measured: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Scale the estimate (N,) so that it matches the measurements (N,) in each cell of the cube and overall.

    If the estimate is almost zero everywhere, as for Gaussians that are far too small to be seen, the mean of the
    measurements takes its place.
    """
    if not len(guess):
        return guess
    if not guess.sum() > MIN_PRIOR_SUM:
        guess = np.ones_like(guess)
    sums = [np.bincount(cells, values, PRIOR_CELLS_PER_AXIS**3) for values in (measured, guess)]
    overall = measured.sum() / max(guess.sum(), 1e-300)
    # A cell with few measurements takes the ratio of all cells.
    weight = guess.sum() / max(np.count_nonzero(sums[1]), 1)
    return guess * ((sums[0] + overall * weight) / (sums[1] + weight))[cells]


def _cube_jacobian(model: HybridModel) -> torch.Tensor:
    """Return d local position / d cube coordinate, (N, 3, 3): rows are local axes, columns are cube axes."""
    positions = model.gaussians.positions.detach()

    @torch.enable_grad()
    def differentiate(rows: slice) -> torch.Tensor:
        cube = model.cube_coords(positions[rows].double()).requires_grad_()
        local = expand(cube) * cube.new_tensor(model.config.frame.half_extent)
        axes = [torch.autograd.grad(local[:, axis].sum(), cube, retain_graph=True)[0] for axis in range(3)]
        return torch.stack(axes, dim=1).float()

    return map_row_blocks(differentiate, len(positions), positions.device)


@torch.no_grad()
def _expected_sensitivity(
    model: HybridModel, geometry: Geometry, cameras: Sequence[Camera], jacobian: torch.Tensor
) -> dict[str, np.ndarray]:
    """Estimate the sensitivities (N,) of each kind of number of unoccluded Gaussians, up to a common factor.

    A Gaussian of opacity o and standard deviations a, b (the larger two) at depth z covers pi f^2 a b / z^2 pixels.
    The derivative of such a pixel is at most o with respect to the Gaussian's colour. With respect to its opacity logit
    it is at most o (1 - o), and with respect to its position o / (a b)^(1/2).
    """
    seen, area = _expected_light(model, geometry, cameras)
    stretched = jacobian.double().square().sum(dim=(1, 2))
    guesses = {
        "positions": seen * stretched / area.clamp_min(1e-12),
        "color_logits": seen,
        "scale_logits": seen,
        "opacity_logits": _opacity_sensitivity(seen, geometry),
    }
    return {name: values.cpu().numpy() for name, values in guesses.items()}


@torch.no_grad()
def expected_opacity_sensitivity(model: HybridModel, geometry: Geometry, cameras: Sequence[Camera]) -> np.ndarray:
    """Estimate the sensitivity (N,) of the opacity logits of unoccluded Gaussians, up to a factor."""
    seen, _ = _expected_light(model, geometry, cameras)
    return _opacity_sensitivity(seen, geometry).cpu().numpy()


def _opacity_sensitivity(seen: torch.Tensor, geometry: Geometry) -> torch.Tensor:
    return seen * (1 - geometry.opacities.double()).clamp_min(1e-3) ** 2


def _expected_light(
    model: HybridModel, geometry: Geometry, cameras: Sequence[Camera]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sum over cameras of the share of the picture times opacity squared (N,), and the area (N,)."""
    positions, frame = model.gaussians.positions.detach(), model.config.frame
    places = [
        torch.as_tensor(frame.to_local(camera.position)).to(positions.device, torch.float64) for camera in cameras
    ]
    shares = [camera.fx * camera.fy / (camera.width * camera.height) for camera in cameras]

    def measure_light_and_area(rows: slice) -> torch.Tensor:
        sides = geometry.scales[rows].double().sort(dim=1).values
        area, points = sides[:, 1] * sides[:, 2], positions[rows].double()
        total = torch.zeros_like(area)
        for place, share in zip(places, shares, strict=True):
            distance = torch.linalg.vector_norm(points - place, dim=1).clamp_min(MIN_CAMERA_DISTANCE_LOCAL)
            total += (area * share / distance**2).clamp_max(1)
        return torch.stack((total * geometry.opacities[rows].double() ** 2, area), dim=1)

    light, area = map_row_blocks(measure_light_and_area, len(positions), positions.device).unbind(dim=1)
    return light, area
