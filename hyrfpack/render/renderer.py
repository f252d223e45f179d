"""Renders a view: culls, decodes, projects and blends Gaussians, sorted into tiles, and adds the background."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf

import torch
from torch import Tensor

from hyrfpack.cameras.sampling import MAX_BACKGROUND_STRIDE
from hyrfpack.checks import check_choice, check_float, check_int, check_type
from hyrfpack.choices import AS_PHOTOGRAPHED, RENDER_EXPOSURES
from hyrfpack.errors import HyrfError
from hyrfpack.measure.stages import add_seconds
from hyrfpack.model import Decoded, HybridModel
from hyrfpack.model.merged import MergedModel, scene_of
from hyrfpack.ops.composite import composite
from hyrfpack.ops.finite import all_finite
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, Viewport, rasterize
from hyrfpack.ops.rasterize.cull import frustum_cull, frustum_cull_into
from hyrfpack.ops.rasterize.inputs import LOW_PASS_VARIANCE, TRANSMITTANCE_MIN
from hyrfpack.ops.rows import take_rows
from hyrfpack.ops.shade import Shading
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.ops.viewport import PackedCamera
from hyrfpack.out_of_memory import explain_out_of_memory
from hyrfpack.parallel.pool import torch_on_one_thread
from hyrfpack.render.exposure import apply_exposure_map
from hyrfpack.render.parts import camera_frame, expose_parts, gather_parts, nearest_plane
from hyrfpack.render.reserve import Reserve
from hyrfpack.render.sampling import background_stride, widen_to_photos
from hyrfpack.scene import Camera

MIN_LOW_PASS_VARIANCE = 1e-3  # Narrower filters let Gaussians fall between pixel centres.


@dataclass(frozen=True)
class RenderSettings:
    """Settings that trade accuracy for speed. `docs/research/speed-and-accuracy.md` lists their errors and times.

    Attributes:
        near: Gaussians nearer than this are culled, in local units (the frame's longest half-axis is 1).
        cull_tolerance: how far outside the image a centre may project, as a fraction of half the image size; infinite
            keeps every Gaussian in front of the camera.
        background_threshold: pixels with at most this transmittance get no background (tau in the paper).
        background_stride: the background is evaluated at every background_stride-th pixel of each axis and
            interpolated between them; 1 evaluates every pixel, and 64 is the largest. None has the spacing of training,
            at any size of view.
        transmittance_min: blending of a pixel stops when its transmittance is at most this; 0 blends every Gaussian.
        exposure: "as-photographed" applies the model's exposure map, so that a view looks like the photos taken near
            it; "consistent" renders all views at the model's own exposure. Without a map, both are the same.
        low_pass_variance: variance in px^2 of the filter that widens projected Gaussians. Models are trained for the
            default; a reduced image needs less, see `hyrfpack.train.resolution.reduced_low_pass_variance`.
    """

    near: float = 0.01
    cull_tolerance: float = 0.3
    background_threshold: float = 1 / 512
    background_stride: int | None = None
    transmittance_min: float = TRANSMITTANCE_MIN
    exposure: str = AS_PHOTOGRAPHED
    low_pass_variance: float = LOW_PASS_VARIANCE

    def __post_init__(self) -> None:
        for name in ("near", "background_threshold"):
            check_float(name, getattr(self, name))
        check_float("low_pass_variance", self.low_pass_variance, MIN_LOW_PASS_VARIANCE)
        check_float("cull_tolerance", self.cull_tolerance, maximum=inf)
        if self.background_stride is not None:
            check_int("background_stride", self.background_stride, 1, MAX_BACKGROUND_STRIDE)
        check_choice("exposure", self.exposure, RENDER_EXPOSURES)
        check_float("transmittance_min", self.transmittance_min, 0, 1)
        if self.transmittance_min == 1:
            raise ValueError("transmittance_min is 1; it must lie in [0, 1), for at 1 nothing is drawn")

    def raster_settings(self, antialiased: bool, depth: bool = False) -> RasterSettings:
        """Return the settings of the rasteriser."""
        return RasterSettings(
            self.near, antialiased, self.transmittance_min, depth, self.cull_tolerance, self.low_pass_variance
        )


@dataclass(frozen=True)
class Rendering:
    """A rendered view.

    Attributes:
        rgb: (H, W, 3) display-referred colour, background included; within [0, 1] up to rounding, and above 1 only in
            models with colour residuals.
        alpha: (H, W) coverage by Gaussians, 1 - transmittance.
        depth: (H, W) expected depth along the view axis in world units, 0 where no Gaussian is hit; None unless
            requested.
        indices: (n,) indices of the Gaussians that were decoded: those in view, or on a GPU all if `decoded` has a
            shading but no colours, and the model has no colour residuals.
        visible: (n,) bool, whether each of these touches the image.
        absgrad: (n, 2) sums over pixels of |dL/d mean2d| in 1/px; zero until backward has run; None unless requested.
        pairs: number of blended tile-Gaussian pairs, or of those reserved.
        demand: None, or with a `Reserve`, (4,) int64 on the device: not 0 if a position is NaN or infinite; number of
            Gaussians in view; not 0 if another number is NaN or infinite; number of tile-Gaussian pairs. Values above
            `Reserve.limits` mean that the rendering is invalid. Only the first indices, as many as there are Gaussians
            in view, then count; the others belong to Gaussians that are not visible.
        valid: bool scalar on the device, False if the rendering is incomplete and what is learnt from it must be
            dropped, see `demand`; None if it is known to be complete.
        seconds: wall time of each stage in seconds.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    indices: Tensor
    visible: Tensor
    absgrad: Tensor | None
    pairs: int
    seconds: dict[str, float] = field(default_factory=dict)
    demand: Tensor | None = None
    valid: Tensor | None = None


@dataclass(frozen=True)
class RenderedPicture:
    """A render of a view.

    Attributes:
        rgb: (H, W, 3) colours.
        depth: (H, W) median depth along the view axis in world units, 0 where there is no surface; None unless
            requested.
        normals: (H, W, 3) unit normals in world axes, (0, 0, 0) where there is no surface; None unless requested.
    """

    rgb: Tensor
    depth: Tensor | None = None
    normals: Tensor | None = None


@explain_out_of_memory("render a smaller picture or a model of fewer Gaussians")
@torch_on_one_thread()
def render_view(
    model: HybridModel | MergedModel,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    *,
    decoded: Decoded | None = None,
    depth: bool = False,
    absgrad: bool = False,
    solid: Tensor | None = None,
    background: bool = True,
    reserve: Reserve | None = None,
    packed: PackedCamera | None = None,
) -> Rendering:
    """Render one view; differentiable in the model's parameters.

    Args:
        model: the model to render. Each part of a merged model has its own exposure.
        camera: the camera, in world units.
        settings: render settings.
        decoded: result of `model.decode()`. It does not depend on the view, so callers who render many views of an
            unchanged model compute it once. A rendering with `decoded` is not differentiable. With `Decoded.colors`
            it holds only for the camera of these colours and the default `near` and `cull_tolerance`.
        depth: whether to return depth.
        absgrad: whether to collect absolute gradients of the projected centres during backward.
        solid: (3,) colour behind everything instead of the model's own; for models without a background sphere.
        background: whether to render the background sphere.
        reserve: memory for which a HybridModel is rendered without waiting for the GPU, if `can_reserve` and without
            `decoded`; then check `Rendering.demand`.
        packed: the result of `pack_camera` for this camera and these settings, for a HybridModel on a GPU; None if the
            operations are to upload the camera's numbers.

    Raises:
        HyrfError: a number that the view needs is NaN or infinite. On a GPU, while gradients are recorded, the
            background is not checked: check that the loss is finite before an optimiser step.
        TypeError: the model, the camera or the settings have a wrong type.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load_model("bonsai.hyrf")
        >>> camera = hyrfpack.load_scene("photos/bonsai").test[0].camera
        >>> hyrfpack.render_view(model, camera).rgb.shape
        torch.Size([48, 48, 3])
    """
    if not isinstance(model, MergedModel):
        check_type("model", model, HybridModel)
    check_type("camera", camera, Camera)
    check_type("settings", settings, RenderSettings)
    seconds: dict[str, float] = {}
    scene = scene_of(model)
    positions = scene.gaussians.positions
    viewport = replace(scene.config.frame.local_viewport(camera, positions.dtype), packed=packed)
    _check_finite(pose=viewport.pose)
    colors: Tensor | Shading
    used, cull_demand = None, None
    try:
        if isinstance(model, MergedModel):
            reserve = None
            raster_viewport = camera_frame(model, camera).local_viewport(camera, positions.dtype)
            index, gaussians, colors = gather_parts(model, camera, settings.near, settings.cull_tolerance, decoded)
        else:
            raster_viewport = viewport
            index, gaussians, colors, used, cull_demand = _select_gaussians(
                model, viewport, settings, decoded, reserve, seconds
            )
            if (sizes := model.gaussians.pixel_sizes) is not None:
                gaussians = widen_to_photos(gaussians, sizes[index], viewport, antialiased=model.config.antialiased)
        gradients = positions.new_zeros(len(index), 2) if absgrad else None
        raster_settings = make_raster_settings(model, settings, depth)
        is_shaded = isinstance(colors, Shading)  # and has no gradients
        raster = rasterize(
            gaussians, colors, raster_viewport, raster_settings, absgrad=None if is_shaded else gradients, used=used,
            reserve=None if is_shaded or reserve is None else reserve.pairs,
        )  # fmt: skip
    except FloatingPointError:
        raise _nonfinite_error("positions") from None
    if raster.nonfinite:
        raise _nonfinite_error(raster.nonfinite[0])
    seconds.update(raster.seconds)
    with add_seconds(seconds, "background"):
        if scene.config.background and background:
            light, threshold = raster.transmittance, settings.background_threshold
            stride = settings.background_stride or background_stride(scene.background_spacing, viewport)
            behind = scene.background_grid(light, viewport, threshold=threshold, stride=stride)
            rgb = composite(raster.rgb, light, behind, stride)
        else:
            behind = tensor_like(scene.config.solid, positions) if solid is None else solid
            rgb = raster.rgb + raster.transmittance[..., None] * behind
        # Each check on a GPU waits for the device. So only the image is checked there, and not even the image in
        # training, where the caller checks the loss.
        on_cpu = positions.device.type == "cpu"
        if on_cpu or not rgb.requires_grad:
            _check_finite(background=behind if on_cpu else rgb)
    if settings.exposure == AS_PHOTOGRAPHED:
        if isinstance(model, MergedModel):
            rgb = expose_parts(model, camera, rgb, index, gaussians, raster_viewport, raster_settings)
        else:
            rgb = apply_exposure_map(model, camera, rgb)
    return Rendering(
        rgb=rgb,
        alpha=1 - raster.transmittance,
        depth=None if raster.depth is None else raster.depth * scene.config.frame.scale,
        indices=index,
        visible=raster.visible,
        absgrad=gradients,
        pairs=raster.pairs,
        seconds=seconds,
        demand=None if cull_demand is None or raster.demand is None else torch.cat((cull_demand, raster.demand)),
    )


def make_raster_settings(
    model: HybridModel | MergedModel, settings: RenderSettings, depth: bool = False
) -> RasterSettings:
    """Return the settings with which `render_view` rasterises a model in the local units of its frame."""
    raster_settings = settings.raster_settings(scene_of(model).config.antialiased, depth)
    if isinstance(model, MergedModel):
        raster_settings = replace(raster_settings, near=nearest_plane(model, settings.near))
    return raster_settings


def pack_camera(model: HybridModel, camera: Camera, settings: RenderSettings) -> PackedCamera:
    """Upload the numbers of a camera that GPU kernels read, for a model on a GPU.

    Args:
        settings: those of the rendering; they state the stride of the background.

    Raises:
        HyrfError: the pose is NaN or infinite.
    """
    from hyrfpack.ops.background.gpu import pack_rays
    from hyrfpack.ops.rasterize import gpu_project

    positions = model.gaussians.positions
    viewport = model.config.frame.local_viewport(camera, positions.dtype)
    _check_finite(pose=viewport.pose)
    tolerance, low_pass = settings.cull_tolerance, settings.low_pass_variance
    record = gpu_project.pack_camera(viewport, settings.near, positions.device, tolerance, low_pass)
    stride = settings.background_stride or background_stride(model.background_spacing, viewport)
    return PackedCamera(record, pack_rays(viewport, stride, positions.device))


def _select_gaussians(
    model: HybridModel,
    viewport: Viewport,
    settings: RenderSettings,
    decoded: Decoded | None,
    reserve: Reserve | None,
    seconds: dict[str, float],
) -> tuple[Tensor, Gaussians3D, Tensor | Shading, Tensor | None, Tensor | None]:
    """Return indices (n,) of the Gaussians to rasterise, these Gaussians, and their colours as `rasterize` takes them.

    With a reserve, also the number of indices in use and what the reserve must have, as `frustum_cull_into` returns
    them; otherwise None, None.

    On a GPU, with precomputed shading and without colours or colour residuals, `rasterize` gets all Gaussians and culls
    them itself. Otherwise only those in view are shaded.

    Raises:
        FloatingPointError: a position is NaN or infinite.
    """
    positions = model.gaussians.positions
    shading, known_colors = (None, None) if decoded is None else (decoded.shading, decoded.colors)
    has_residuals = model.gaussians.color_residuals is not None
    is_shaded_by_kernel = positions.is_cuda and known_colors is None and not has_residuals
    if decoded is not None and shading is not None and is_shaded_by_kernel:
        return (
            torch.arange(len(model), device=positions.device),
            decoded.geometry.with_means(positions),
            shading,
            None,
            None,
        )
    used, demand = None, None
    with add_seconds(seconds, "cull"), torch.no_grad():
        frustum = positions, viewport, settings.near, settings.cull_tolerance
        if reserve is None:
            index = frustum_cull(*frustum)
        else:
            index, used, demand = frustum_cull_into(*frustum, reserve.gaussians)
    with add_seconds(seconds, "decode"):
        geometry = model.decode_geometry(index, used) if decoded is None else decoded.geometry[index]
        if known_colors is None:
            colors = model.decode_colors(_viewpoint(viewport, positions), index, shading, used)
        else:
            colors = known_colors[index]
        return index, geometry.with_means(take_rows(positions, index, used)), colors, used, demand


def _viewpoint(viewport: Viewport, positions: Tensor) -> Tensor:
    """Return the camera's centre (3,) as a tensor like the positions."""
    if viewport.packed is not None:
        return viewport.packed.viewpoint.to(positions.dtype)
    return camera_center(viewport.pose).to(positions.device, non_blocking=positions.is_cuda)


def _check_finite(**values: Tensor) -> None:
    """Raise HyrfError for NaN and infinity.

    Later stages would silently drop such values, because they fail every comparison.
    """
    for name, tensor in values.items():
        if not all_finite(tensor):
            raise _nonfinite_error(name)


def _nonfinite_error(name: str) -> HyrfError:
    """Return the error for numbers of a view that are not finite."""
    name = "positions" if name == "means" else name
    return HyrfError(
        f"the view's {name}: a number is NaN or infinite, in a broken model or a pose beyond float32",
        fix="correct the pose" if name == "pose" else "train the model again or correct the pose",
    )
