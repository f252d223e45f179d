"""Baking of a hybrid model to explicit Gaussians with spherical harmonics, for programs without neural fields."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.errors import HyrfError
from hyrfpack.export.exposure import BakeGains
from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.exposure import apply_exposure_gains, clamp_colors
from hyrfpack.model.residuals import add_color_residuals
from hyrfpack.ops.harmonics import harmonics_basis, num_sh_bases
from hyrfpack.ops.least_squares import least_squares
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize.blend_weights import sum_blend_weights
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.rasterize.reference import ALPHA_MIN
from hyrfpack.ops.shade import Shading, encode_directions
from hyrfpack.parallel.pool import parallel_map, run_tasks, torch_on_one_thread
from hyrfpack.progress import Progress, count_calls, ignore_progress
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.splats.harmonics import fibonacci_sphere
from hyrfpack.splats.splats import Splats, normalize_quats

SPHERE_DIRECTIONS = 32
SPHERE_WEIGHT = 3e-3  # total weight of all SPHERE_DIRECTIONS, where all cameras together weigh 1
# Used instead for models with an exposure map. Their colours differ more between directions, so harmonics overshoot
# along directions from which no camera looks. The larger weight gives 1.9 to 3.7 dB at degree 3 far from all cameras
# (indoor_room, gerrard_hall, drone_caliterra), and -0.2 to 0.4 dB at cameras that are not fitted.
EXPOSED_SPHERE_WEIGHT = 3e-2
RIDGE_WEIGHT = 1e-5
TRANSMITTANCE_STRIDE_PIXELS = 2
# A thread fits one block of Gaussians at a time; with 128 cameras each Gaussian takes 24 kB. In smaller blocks most of
# the time goes to Python, which runs in one thread only.
MIN_BLOCK_GAUSSIANS = 2048
MAX_BLOCK_GAUSSIANS = 8192
MIN_BLOCKS = 8  # gives all threads work, if the model has enough Gaussians


@torch_on_one_thread()
@torch.no_grad()
def bake(
    model: HybridModel,
    cameras: Sequence[Camera],
    degrees: Sequence[int] = (3,),
    visibility: Sequence[CameraVisibility] | None = None,
    progress: Progress = ignore_progress,
) -> dict[int, Splats]:
    """Bake a model to explicit Gaussians in world units, in the model's order, for each degree of spherical harmonics.

    Scales, rotations and opacities are the model's own. The light w_v that a Gaussian sends to camera v, along the
    direction d_v, is the sum of T alpha over pixels, scaled so that sum_v w_v = 1. Its harmonics h minimise

        sum_v w_v |f(d_v) - color(d_v)|^2
            + SPHERE_WEIGHT mean_s |f(d_s) - color(d_s)|^2
            + RIDGE_WEIGHT sum_{k > 0} |h_k|^2

    with f(d) = 0.5 + sum_k h_k Y_k(d) and SPHERE_DIRECTIONS directions d_s that cover the sphere evenly. The second
    term keeps the colours close to the model's along directions from which no camera looks. It changes the colours that
    the cameras see only slightly.

    If the model has an exposure map, color(d_v) is exposed by the gains of camera v. color(d_s) is exposed by the mean
    gains of the cameras that see the Gaussian or its neighbours (`BakeGains`), and EXPOSED_SPHERE_WEIGHT replaces
    SPHERE_WEIGHT. The splats then look as photographed, because their harmonics hold a part of the map.

    One difference between renderers is corrected. Training culls Gaussians whose centres project far outside the
    picture (`RenderSettings.cull_tolerance`). Many programs draw these, and large ones near a camera would cover its
    picture. So opacities are multiplied by 1 - s^2, where s is the share of a Gaussian's light, without culling, that
    goes to cameras for which the model culls it. Most Gaussians have s = 0. Those that become invisible are dropped.

    Args:
        model: a model on the CPU.
        cameras: cameras from which the model was photographed, world units. Without any, colours are fitted on the
            sphere alone, at the mean gains of the exposure map if there is one, and opacities do not change.
        degrees: degrees of the harmonics, each 0 to 3. Several degrees take little longer than one.
        visibility: result of `compute_visibility` for these cameras, if it is known already.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: a number of the model, or a camera's pose, is NaN, infinite or beyond float32.
    """
    geometry, positions = model.decode_geometry(), model.gaussians.positions.detach()
    scales = geometry.scales * model.config.frame.scale
    for name, values in {**vars(geometry), "positions": positions, "scales": scales}.items():
        check_finite(name, values)
    visibility = compute_visibility(model, cameras) if visibility is None else visibility
    light, culled_light = _sum_light(len(model), visibility)
    opacities, keep = _correct_opacities(geometry.opacities, light, culled_light)

    frame = model.config.frame
    shared = (
        positions.double().numpy() * frame.scale,
        scales.numpy(),
        normalize_quats(geometry.quats.numpy()),
        opacities.numpy(),
    )
    fitted = _fit_harmonics(model, visibility, light, BakeGains.predict(model, cameras, visibility), degrees, progress)
    baked = {}
    for degree in list(fitted):  # one at a time, because the harmonics of many Gaussians take much memory
        harmonics = fitted.pop(degree)
        check_finite("colors", harmonics)
        splats = Splats(*shared, harmonics.numpy(), model.config.antialiased)
        if frame.is_rotated:  # so far, all axes are local
            splats = splats.rotated(frame.axes)
        splats = replace(splats, positions=splats.positions + np.array(frame.center))
        baked[degree] = splats if keep.all() else splats[keep]
    return baked


@torch.no_grad()
def keep_mask(model: HybridModel, visibility: Sequence[CameraVisibility]) -> np.ndarray:
    """Return a mask (N,) of the Gaussians that `bake` keeps, given the result of `compute_visibility`."""
    return _correct_opacities(model.decode_geometry().opacities, *_sum_light(len(model), visibility))[1]


def _sum_light(count: int, visibility: Sequence[CameraVisibility]) -> tuple[Tensor, Tensor]:
    """Return the light (N,) that each Gaussian sends to all cameras, and that of cameras that cull it."""
    light, culled_light = torch.zeros(2, count, dtype=torch.float64)
    for view in visibility:
        light[view.index] += view.light
        culled_light[view.culled_index] += view.culled_light
    return light, culled_light


def _correct_opacities(opacities: Tensor, light: Tensor, culled_light: Tensor) -> tuple[Tensor, np.ndarray]:
    """Return the opacities (N,) corrected for culling, see `bake`, and a mask of the Gaussians that stay visible."""
    share = culled_light / (light + culled_light).clamp_min(torch.finfo().tiny)
    corrected = opacities * (1 - share.float().square())
    return corrected, ((share == 0) | (corrected >= ALPHA_MIN)).numpy()


@dataclass(frozen=True)
class CameraVisibility:
    """The light that each Gaussian sends to one camera's picture: the sum over its pixels of T alpha.

    Attributes:
        viewpoint: (3,) position of the camera, local units.
        index: (n,) int32 ascending indices of the Gaussians that the model draws and that send light.
        light: (n,) float32 light that each of these sends, in pixels.
        culled_index: (m,) int32 ascending indices of the Gaussians that the model culls for this camera.
        culled_light: (m,) float32 light that each of these would send if nothing were culled, in pixels.
        transmittance: (H / stride, W / stride) transmittance of the drawn Gaussians, at every
            TRANSMITTANCE_STRIDE_PIXELS-th pixel in both directions.
    """

    viewpoint: Tensor
    index: Tensor
    light: Tensor
    culled_index: Tensor
    culled_light: Tensor
    transmittance: Tensor


@torch_on_one_thread()
@torch.no_grad()
def compute_visibility(
    model: HybridModel, cameras: Sequence[Camera], progress: Progress = ignore_progress
) -> list[CameraVisibility]:
    """Compute the light that the Gaussians of a model send to each camera.

    Args:
        model: a model on the CPU.
        cameras: cameras in world units.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: a camera's pose is NaN, infinite or beyond float32.
    """
    # Cameras are processed in parallel, because much of the work for one camera uses one core only.
    see = count_calls(
        partial(_compute_camera_visibility, model, model.decode_geometry()),
        progress,
        "measuring visibility from each camera",
        len(cameras),
    )
    return parallel_map(see, cameras)


@torch.no_grad()  # because torch keeps this setting per thread
def _compute_camera_visibility(model: HybridModel, geometry: Geometry, camera: Camera) -> CameraVisibility:
    settings, positions = RenderSettings(), model.gaussians.positions.detach()
    camera = shrink_camera(camera)
    viewport = model.config.frame.local_viewport(camera)
    check_finite("camera poses", viewport.pose)
    raster_settings = settings.raster_settings(model.config.antialiased)
    drawn = frustum_cull(positions, viewport, settings.near, settings.cull_tolerance)
    gaussians = geometry.with_means(positions)
    culled_light, transmittance = sum_blend_weights(gaussians, viewport, raster_settings)
    light = culled_light[drawn]
    culled_light[drawn] = 0
    culled_index = torch.nonzero(culled_light).squeeze(-1)
    if len(culled_index):  # the culled Gaussians no longer block the light of the others
        light, transmittance = sum_blend_weights(gaussians.select(drawn), viewport, raster_settings)
    lit = light > 0
    stride = TRANSMITTANCE_STRIDE_PIXELS
    return CameraVisibility(
        camera_center(viewport.pose),
        drawn[lit].int(),
        light[lit],
        culled_index.int(),
        culled_light[culled_index],
        transmittance[::stride, ::stride].clone(),
    )


def _fit_harmonics(
    model: HybridModel,
    visibility: Sequence[CameraVisibility],
    light: Tensor,
    gains: BakeGains | None,
    degrees: Iterable[int],
    progress: Progress,
) -> dict[int, Tensor]:
    """Fit the harmonics (N, K, 3) of all Gaussians for each degree."""
    shading, positions = model.compute_shading(), model.gaussians.positions.detach()
    residuals = model.gaussians.color_residuals
    fitted = {degree: positions.new_empty(len(model), num_sh_bases(degree), 3) for degree in degrees}
    highest = max(fitted)
    sphere = fibonacci_sphere(SPHERE_DIRECTIONS).float()
    terms = num_sh_bases(highest)
    sphere_basis = harmonics_basis(sphere, highest)
    sphere_weight = SPHERE_WEIGHT if gains is None else EXPOSED_SPHERE_WEIGHT
    weighted_sphere_basis = (sphere_weight / len(sphere) * sphere_basis.T).contiguous()
    ridge = torch.full((terms,), RIDGE_WEIGHT, dtype=torch.float64)
    ridge[0] = 0
    gram = weighted_sphere_basis.double() @ sphere_basis.double() + ridge.diag()
    size = min(max(len(model) // MIN_BLOCKS, MIN_BLOCK_GAUSSIANS), MAX_BLOCK_GAUSSIANS)
    edges = torch.arange(0, len(model) + size, size, dtype=torch.int32)
    ranges = [torch.searchsorted(view.index, edges) for view in visibility]

    def fit_block(block: int) -> None:
        start, stop = block * size, min((block + 1) * size, len(model))
        block_slice = slice(start, stop)
        mean_gains = None if gains is None else gains.gaussians[block_slice]
        sphere_colors = torch.stack(
            [
                _evaluate_centered_colors(direction[None], shading, residuals, block_slice, mean_gains)
                for direction in sphere
            ]
        ).flatten(1)
        right_sides = (weighted_sphere_basis @ sphere_colors).reshape(terms, stop - start, 3).transpose(0, 1)
        rows = [
            (
                torch.empty(0, dtype=torch.int64),
                sphere_basis[:0],
                sphere_basis.new_empty(0, 3),
                sphere_basis.new_empty(0),
            )
        ]
        for number, (view, bounds) in enumerate(zip(visibility, ranges, strict=True)):
            view_slice = slice(int(bounds[block]), int(bounds[block + 1]))
            index = view.index[view_slice].long()
            directions = torch.nn.functional.normalize(positions[index] - view.viewpoint, dim=-1, eps=1e-12)
            camera_gains = None if gains is None else gains.cameras[number]
            colors = _evaluate_centered_colors(directions, shading, residuals, index, camera_gains)
            weights = (view.light[view_slice] / light[index]).float()
            rows.append((index - start, harmonics_basis(directions, highest), colors, weights))
        owners, basis, colors, weights = map(torch.cat, zip(*rows, strict=True))
        for degree, harmonics in fitted.items():
            terms_slice = slice(num_sh_bases(degree))
            harmonics[block_slice] = least_squares(
                owners,
                basis[:, terms_slice],
                colors,
                weights,
                gram[terms_slice, terms_slice],
                right_sides[:, terms_slice],
            )

    blocks = len(edges) - 1
    run_tasks(count_calls(fit_block, progress, "fitting colours", blocks), blocks)
    return fitted


def _evaluate_centered_colors(
    directions: Tensor, shading: Shading, residuals: Tensor | None, index: Tensor | slice, gains: Tensor | None
) -> Tensor:
    """Evaluate colours minus 0.5 (n, 3) of Gaussians along directions, exposed by `gains` (3,) or (n, 3) if given.

    Args:
        directions: (n, 3), one for each Gaussian at `index`; or (1, 3) if `index` is a slice.
        residuals: (N, 3 K) colour residuals of all Gaussians, if the model has any.
    """
    encoded = encode_directions(directions, shading.encoding)
    if isinstance(index, slice):
        hidden = shading.first_layer[index] + encoded @ shading.direction_weight.T
    else:
        hidden = shading.first_layer[index].addmm_(encoded, shading.direction_weight.T)
    logits = mlp(hidden.relu_(), shading.weights, shading.biases)
    colors = logits.add_(shading.color_logits[index]).sigmoid_()
    if residuals is not None:
        colors = add_color_residuals(colors, residuals[index], directions)
    return (colors if gains is None else apply_exposure_gains(clamp_colors(colors), gains)).sub_(0.5)


def check_finite(name: str, values: Tensor) -> None:
    """Raise HyrfError, with the name of the values, unless all are finite."""
    if not values.isfinite().all():
        raise HyrfError(
            f"the bake's {name} hold NaN or infinity, from a broken model or numbers beyond float32",
            fix="train the model again or correct the cameras",
        )
