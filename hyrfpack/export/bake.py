"""Bake: a hybrid model as explicit Gaussians with spherical harmonics, for programs that know no neural field."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.errors import HyrfError
from hyrfpack.export.exposure import BakeGains
from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.ops.least_squares import least_squares
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.rasterize.light import sent_light
from hyrfpack.ops.rasterize.reference import ALPHA_MIN
from hyrfpack.ops.shade import Shading, encode_directions
from hyrfpack.parallel.pool import parallel_map, run_tasks, torch_on_one_thread
from hyrfpack.progress import Report, no_report, report_each_call
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.splats.harmonics import fibonacci_sphere, harmonics_basis, num_sh_bases
from hyrfpack.splats.splats import Splats, normalized_quats

SPHERE_DIRECTIONS = 32
SPHERE_WEIGHT = 3e-3  # of all these together, against 1 for all cameras
# Of a model with an exposure map. What cameras see differs more by the direction there, and harmonics of it go astray
# where no camera looks along: far from all cameras this gives 1.9 to 3.7 dB at degree 3 (indoor_room, gerrard_hall,
# drone_caliterra), and -0.2 to 0.4 dB at cameras that are not fitted.
EXPOSED_SPHERE_WEIGHT = 3e-2
RIDGE = 1e-5
STRIDE = 2
# Gaussians that a thread fits together, 24 kB each with 128 cameras: of fewer at once Python itself takes longest, and
# one thread at a time can run that. BLOCKS of them at least, where there are enough, so that all threads have some.
LEAST_BLOCK, LARGEST_BLOCK, BLOCKS = 2048, 8192, 8


@torch_on_one_thread()
@torch.no_grad()
def bake(
    model: HybridModel,
    cameras: Sequence[Camera],
    degrees: Sequence[int] = (3,),
    sights: Sequence[Sight] | None = None,
    report: Report = no_report,
) -> dict[int, Splats]:
    """A model as explicit Gaussians in world units, in the model's order, for each degree of spherical harmonics.

    Scales, rotations and opacities are the model's own. Colours minimise, for each Gaussian over the cameras v that it
    sends light w_v to (the sum over pixels of T alpha; sum_v w_v = 1), seen along the directions d_v,

        sum_v w_v |f(d_v) - color(d_v)|^2 + SPHERE_WEIGHT mean_s |f(d_s) - color(d_s)|^2 + RIDGE sum_{k > 0} |h_k|^2

    with f(d) = 0.5 + sum_k h_k Y_k(d) and directions d_s that cover the sphere evenly: from where no camera stood the
    colours follow the model, too, as far as that costs the cameras' views nothing.

    Of a model with an exposure map, color(d_v) is exposed by the gains of camera v, and color(d_s) by the mean gains of
    the cameras that see the Gaussian or its neighbours (`BakeGains`), with EXPOSED_SPHERE_WEIGHT. The splats then look
    as photographed: their harmonics hold a part of the map.

    One thing is corrected. The model is trained with Gaussians left out whose centres project far outside the picture
    (`RenderSettings.cull_tolerance`). Many programs draw these, and large ones near a camera would cover its picture.
    So opacities are multiplied by 1 - s^2, where s is the share of a Gaussian's light, were nothing left out, that
    would go to cameras which the model draws without it; most have s = 0, and those that this makes invisible are
    dropped.

    Args:
        model: on the CPU.
        cameras: from where it was photographed, world units; when there are none, colours are fitted on the sphere
            alone, at the mean gains of the exposure map if there is one, and no opacity changes.
        degrees: of the harmonics, each 0 to 3. More than one costs little more.
        sights: what `sights_of` told of these cameras, where it is known already.
        report: called with what is being done and the share of the work that is done, 0 to 1.

    Raises:
        HyrfError: a number of the model, or a camera's pose, is NaN, infinite or beyond float32.
    """
    geometry, positions = model.decode_geometry(), model.gaussians.positions.detach()
    scales = geometry.scales * model.config.frame.scale
    for name, values in {**vars(geometry), "positions": positions, "scales": scales}.items():
        refuse_nonfinite(name, values)
    views = sights_of(model, cameras) if sights is None else sights
    light, stray = torch.zeros(2, len(model), dtype=torch.float64)
    for view in views:
        light[view.index] += view.light
        stray[view.left_out] += view.stray
    share = stray / (light + stray).clamp_min(torch.finfo().tiny)
    opacities = geometry.opacities * (1 - share.float().square())
    keep = ((share == 0) | (opacities >= ALPHA_MIN)).numpy()

    shared = (
        model.config.frame.to_world(positions.numpy()),
        scales.numpy(),
        normalized_quats(geometry.quats.numpy()),
        opacities.numpy(),
    )
    fitted = _fit(model, views, light, BakeGains.of(model, cameras, views), degrees, report)
    baked = {}
    for degree in list(fitted):  # one at a time: all harmonics of many Gaussians are a lot
        harmonics = fitted.pop(degree)
        refuse_nonfinite("colors", harmonics)
        splats = Splats(*shared, harmonics.numpy(), model.config.antialiased)
        baked[degree] = splats if keep.all() else splats[keep]
    return baked


@dataclass(frozen=True)
class Sight:
    """The light that Gaussians send to a picture: the sum over its pixels of T alpha.

    Attributes:
        viewpoint: (3,) where the camera stands, local units.
        index, light: (n,) int32 ascending and float32: of those that the model draws.
        left_out, stray: (m,) the same of those that it leaves out, were all drawn.
        passed: (H / STRIDE, W / STRIDE) the share of a pixel's light that passes those that it draws, of every
            STRIDE-th pixel in both directions.
    """

    viewpoint: Tensor
    index: Tensor
    light: Tensor
    left_out: Tensor
    stray: Tensor
    passed: Tensor


@torch_on_one_thread()
@torch.no_grad()
def sights_of(model: HybridModel, cameras: Sequence[Camera], report: Report = no_report) -> list[Sight]:
    """What each camera sees of a model.

    Args:
        report: told of each camera, and the share of the work that is done.

    Raises:
        HyrfError: a camera's pose is NaN, infinite or beyond float32.
    """
    # Much of one runs on one core only.
    see = report_each_call(
        partial(_sight, model, model.decode_geometry()), report, "looking from each camera", len(cameras)
    )
    return parallel_map(see, cameras)


@torch.no_grad()  # of each thread
def _sight(model: HybridModel, geometry: Geometry, camera: Camera) -> Sight:
    settings, positions = RenderSettings(), model.gaussians.positions.detach()
    camera = shrink_camera(camera)
    pose = torch.as_tensor(model.config.frame.local_pose(camera), dtype=torch.float32)
    refuse_nonfinite("camera poses", pose)
    view = pose, camera.intrinsics, camera.width, camera.height
    how: dict[str, Any] = {"near": settings.near, "antialiased": model.config.antialiased}
    drawn = frustum_cull(positions, *view, settings.near, settings.cull_tolerance)

    def light(means: Tensor, some: Geometry) -> tuple[Tensor, Tensor]:
        return sent_light(means, some.quats, some.scales, some.opacities, *view, **how)

    stray, passed = light(positions, geometry)
    received = stray[drawn]
    stray[drawn] = 0
    left_out = torch.nonzero(stray).squeeze(-1)
    if len(left_out):  # they took light from others
        received, passed = light(positions[drawn], geometry[drawn])
    lit = received > 0
    left_out_light, some = stray[left_out], passed[::STRIDE, ::STRIDE].clone()
    return Sight(camera_center(pose), drawn[lit].int(), received[lit], left_out.int(), left_out_light, some)


def _fit(
    model: HybridModel,
    views: Sequence[Sight],
    light: Tensor,
    gains: BakeGains | None,
    degrees: Iterable[int],
    report: Report,
) -> dict[int, Tensor]:
    """Harmonics (N, K, 3) of all Gaussians by degree."""
    shading, positions = model.shading(), model.gaussians.positions.detach()
    fitted = {degree: positions.new_empty(len(model), num_sh_bases(degree), 3) for degree in degrees}
    highest = max(fitted)
    sphere = fibonacci_sphere(SPHERE_DIRECTIONS).float()
    terms = num_sh_bases(highest)
    net = harmonics_basis(sphere, highest)
    sphere_weight = SPHERE_WEIGHT if gains is None else EXPOSED_SPHERE_WEIGHT
    around = (sphere_weight / len(sphere) * net.T).contiguous()
    ridge = torch.full((terms,), RIDGE, dtype=torch.float64)
    ridge[0] = 0
    gram = around.double() @ net.double() + ridge.diag()
    size = min(max(len(model) // BLOCKS, LEAST_BLOCK), LARGEST_BLOCK)
    edges = torch.arange(0, len(model) + size, size, dtype=torch.int32)
    ranges = [torch.searchsorted(view.index, edges) for view in views]

    def fit_block(block: int) -> None:
        start, stop = block * size, min((block + 1) * size, len(model))
        here = slice(start, stop)
        mean_gains = None if gains is None else gains.gaussians[here]
        far = torch.stack([_colors(direction[None], shading, here, mean_gains) for direction in sphere]).flatten(1)
        right = (around @ far).reshape(terms, stop - start, 3).transpose(0, 1)
        rows = [(torch.empty(0, dtype=torch.int64), net[:0], net.new_empty(0, 3), net.new_empty(0))]
        for number, (view, bounds) in enumerate(zip(views, ranges, strict=True)):
            seen = slice(int(bounds[block]), int(bounds[block + 1]))
            index = view.index[seen].long()
            directions = torch.nn.functional.normalize(positions[index] - view.viewpoint, dim=-1, eps=1e-12)
            camera_gains = None if gains is None else gains.cameras[number]
            colors = _colors(directions, shading, index, camera_gains)
            weights = (view.light[seen] / light[index]).float()
            rows.append((index - start, harmonics_basis(directions, highest), colors, weights))
        owners, basis, colors, weights = map(torch.cat, zip(*rows, strict=True))
        for degree, harmonics in fitted.items():
            some = slice(num_sh_bases(degree))
            harmonics[here] = least_squares(owners, basis[:, some], colors, weights, gram[some, some], right[:, some])

    blocks = len(edges) - 1
    run_tasks(report_each_call(fit_block, report, "fitting colours", blocks), blocks)
    return fitted


def _colors(directions: Tensor, shading: Shading, index: Tensor | slice, gains: Tensor | None) -> Tensor:
    """Colours (n, 3) less 0.5 of the Gaussians at `index` along directions (n, 3), or of a slice along one (1, 3).

    They are exposed by `gains`, (3,) or (n, 3), if there are any.
    """
    encoded = encode_directions(directions, shading.encoding)
    if isinstance(index, slice):
        first = shading.first_layer[index] + encoded @ shading.direction_weight.T
    else:
        first = shading.first_layer[index].addmm_(encoded, shading.direction_weight.T)
    rest = mlp(first.relu_(), shading.weights, shading.biases)
    colors = rest.add_(shading.color_logits[index]).sigmoid_()
    return (colors if gains is None else apply_exposure_gains(colors, gains)).sub_(0.5)


def refuse_nonfinite(name: str, values: Tensor) -> None:
    """Raise HyrfError, naming what they are, unless all values are finite."""
    if not values.isfinite().all():
        raise HyrfError(
            f"the bake's {name} hold NaN or infinity, from a broken model or numbers beyond float32; "
            "train the model again or correct the cameras"
        )
