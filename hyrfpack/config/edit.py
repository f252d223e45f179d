"""Actions that edit a model, as values: what each does and its numbers, without torch.

Positions and lengths are in the world units of the file that is edited. `hyrfpack.edit_model` applies actions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from hyrfpack.checks import check_finite, check_float, check_int, check_positive
from hyrfpack.config.settings import Range, check_settings
from hyrfpack.counts import format_count

Vector = tuple[float, float, float]
DEFAULT_MIN_OPACITY_SHARE = 0.35
DEFAULT_MIN_LIGHT_SHARE = 0.5
MIN_POLYGON_POINTS, MAX_POLYGON_POINTS = 3, 10_000
UPRIGHT_AXES = ("y", "z")
DEFAULT_REFIT_STEPS = 500
MIN_MARGIN = -0.99  # a hull of no size would keep nothing


def _check_direction(name: str, values: Sequence[float]) -> None:
    _check_vector(name, values)
    if not any(values):
        raise ValueError(f"{name} is (0, 0, 0); it must have a length")


def _check_vector(name: str, values: Sequence[float], *, may_be_infinite: bool = False) -> None:
    if len(values) != 3 or any(math.isnan(value) or (math.isinf(value) and not may_be_infinite) for value in values):
        raise ValueError(f"{name} is {values!r}; it must be three {'' if may_be_infinite else 'finite '}numbers")


@dataclass(frozen=True)
class CropBox:
    """Keep the Gaussians whose centres lie in a box.

    Attributes:
        low, high: minimum and maximum corner. Infinite numbers leave a side open.
        degrees: turns the box about its centre and the scene's up direction, by the right-hand rule.
    """

    low: Vector
    high: Vector
    degrees: float = 0.0

    def __post_init__(self) -> None:
        check_finite("degrees", self.degrees)
        if self.degrees and not all(map(math.isfinite, (*self.low, *self.high))):
            raise ValueError(f"the box from {self.low} to {self.high} has no centre, about which it could be turned")
        for name in ("low", "high"):
            _check_vector(name, getattr(self, name), may_be_infinite=True)
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"the box from {self.low} to {self.high} has a minimum above its maximum")

    def __str__(self) -> str:
        turn = f", turned by {self.degrees:g} degrees" if self.degrees else ""
        return f"crop to the box from {_format(self.low)} to {_format(self.high)}{turn}"


@dataclass(frozen=True)
class CropSphere:
    """Keep the Gaussians whose centres lie in a sphere.

    Attributes:
        center: its centre.
        radius: its radius, above 0.
    """

    center: Vector
    radius: float

    def __post_init__(self) -> None:
        _check_vector("center", self.center)
        check_positive("radius", self.radius)

    def __str__(self) -> str:
        return f"crop to the sphere of radius {self.radius:g} around {_format(self.center)}"


@dataclass(frozen=True)
class CropCameras:
    """Keep the Gaussians that the training cameras surround.

    Seen from above, these are the Gaussians in the convex hull of the cameras' positions. Their height does not matter.

    Attributes:
        margin: enlarges the hull about its centre by this fraction of its size; -0.2 makes it smaller.
    """

    margin: float = 0.0

    def __post_init__(self) -> None:
        check_float("margin", self.margin, MIN_MARGIN)

    def __str__(self) -> str:
        return f"crop to what the cameras surround, with a margin of {self.margin:g}"


@dataclass(frozen=True)
class CropMasks:
    """Keep the Gaussians that masks of the photos show, such as those of one object. This needs photos.

    Attributes:
        folder: the folder of masks: pictures with the names of their photos. Black pixels are outside the object.
            Photos without a mask are not used.
        min_light_share: a Gaussian is kept if at least this share of its light in these photos falls into their masks,
            in [0, 1].
    """

    folder: str
    min_light_share: float = DEFAULT_MIN_LIGHT_SHARE

    def __post_init__(self) -> None:
        check_float("min_light_share", self.min_light_share, 0, 1)

    def __str__(self) -> str:
        return f"crop to what the masks in {self.folder} show"


@dataclass(frozen=True)
class CropPolygon:
    """Keep the Gaussians whose centres lie above or below a polygon on the ground.

    The polygon is seen from above, along the scene's up direction. It may be concave, but its sides may not cross.

    Attributes:
        points: the corners in order, at least three.
        min_height, max_height: heights along the up direction, relative to the mean height of the corners. Infinite
            numbers leave a side open.
    """

    points: tuple[Vector, ...]
    min_height: float = -math.inf
    max_height: float = math.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", tuple(tuple(point) for point in self.points))
        for point in self.points:
            _check_vector("a point of the polygon", point)
        if len(set(self.points)) < MIN_POLYGON_POINTS:
            raise ValueError(
                f"the polygon has {format_count(len(set(self.points)), 'different point')}; it needs at least three"
            )
        if len(self.points) > MAX_POLYGON_POINTS:
            raise ValueError(
                f"the polygon has {len(self.points):,} points; at most {MAX_POLYGON_POINTS:,} are possible"
            )
        if not self.min_height < self.max_height:
            raise ValueError(
                f"min_height is {self.min_height:g} and max_height {self.max_height:g}; the first must be lower"
            )

    def __str__(self) -> str:
        bounds = {"above": self.min_height, "below": self.max_height}
        heights = " and ".join(f"{side} {bound:g}" for side, bound in bounds.items() if math.isfinite(bound))
        return f"crop to the polygon of {len(self.points)} points" + (f", heights {heights}" if heights else "")


Crop = CropBox | CropSphere | CropCameras | CropPolygon | CropMasks


@dataclass(frozen=True)
class Remove:
    """Remove the Gaussians that a crop would keep.

    Attributes:
        crop: the crop.
    """

    crop: Crop

    def __str__(self) -> str:
        return str(self.crop).replace("crop to", "remove", 1)


@dataclass(frozen=True)
class MinOpacity:
    """Remove the Gaussians with a lower opacity.

    Attributes:
        opacity: the limit, in [0, 1].
    """

    opacity: float

    def __post_init__(self) -> None:
        check_float("opacity", self.opacity, 0, 1)

    def __str__(self) -> str:
        return f"remove opacities below {self.opacity:g}"


@dataclass(frozen=True)
class MaxScale:
    """Remove the Gaussians whose longest axis is longer.

    Attributes:
        scale: the limit, a standard deviation.
    """

    scale: float

    def __post_init__(self) -> None:
        check_float("scale", self.scale)

    def __str__(self) -> str:
        return f"remove Gaussians longer than {self.scale:g}"


@dataclass(frozen=True)
class RemoveFloaters:
    """Remove floaters: Gaussians in front of the surfaces whose light the photos contradict. This needs photos.

    Attributes:
        min_opacity_share: a Gaussian may be a floater if the photos leave it less than this share of its opacity, in
            (0, 1). A higher one removes more.
    """

    min_opacity_share: float = DEFAULT_MIN_OPACITY_SHARE

    def __post_init__(self) -> None:
        check_float("min_opacity_share", self.min_opacity_share, 0, 1)
        if self.min_opacity_share in (0, 1):
            raise ValueError(f"min_opacity_share is {self.min_opacity_share:g}; it must lie between 0 and 1")

    def __str__(self) -> str:
        return f"remove floaters that keep less than {self.min_opacity_share:g} of their opacity"


@dataclass(frozen=True)
class Refit:
    """Train the Gaussians of a region again, on the photos, while all others stay as they are. This needs photos.

    Positions, colours, scales and opacities are trained. Hash grids and decoders belong to all Gaussians and stay.

    Attributes:
        region: a crop; the Gaussians that it would keep are trained. With `Remove`, those that it would remove.
        steps: training steps, each on one photo.
    """

    region: Crop | Remove
    steps: int = DEFAULT_REFIT_STEPS

    def __post_init__(self) -> None:
        check_int("steps", self.steps, 1)

    def __str__(self) -> str:
        where = str(self.region).replace("crop to ", "").replace("remove", "all but", 1)
        return f"refit {where} for {format_count(self.steps, 'step')}"


@dataclass(frozen=True)
class KeepGaussians:
    """Keep a number of Gaussians: those whose removal would change renders at the training cameras most.

    Attributes:
        count: the number to keep, at least 1. A model with fewer Gaussians stays as it is.
    """

    count: int

    def __post_init__(self) -> None:
        check_int("count", self.count, 1)

    def __str__(self) -> str:
        return f"keep the {self.count:,} most important Gaussians"


@dataclass(frozen=True)
class Background:
    """Replace the background sphere, or the background colour, by a colour.

    Attributes:
        color: RGB in [0, 1].
    """

    color: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _check_vector("color", self.color)
        for value in self.color:
            check_float("color", value, 0, 1)

    def __str__(self) -> str:
        return f"use the background colour {_format(self.color)}"


@dataclass(frozen=True)
class Translate:
    """Move the scene.

    Attributes:
        offset: added to all positions.
    """

    offset: Vector

    def __post_init__(self) -> None:
        _check_vector("offset", self.offset)

    def __str__(self) -> str:
        return f"move by {_format(self.offset)}"


@dataclass(frozen=True)
class Scale:
    """Scale the scene about the origin, such as to metres.

    Attributes:
        factor: multiplies all positions and lengths, above 0.
    """

    factor: float

    def __post_init__(self) -> None:
        check_positive("factor", self.factor)

    def __str__(self) -> str:
        return f"scale by {self.factor:g}"


@dataclass(frozen=True)
class Rotate:
    """Rotate the scene about an axis through the origin, by the right-hand rule.

    Attributes:
        axis: direction of the axis, of any length above 0.
        degrees: the angle.
    """

    axis: Vector
    degrees: float

    def __post_init__(self) -> None:
        _check_direction("axis", self.axis)
        check_finite("degrees", self.degrees)

    def __str__(self) -> str:
        return f"rotate by {self.degrees:g} degrees about {_format(self.axis)}"


@dataclass(frozen=True)
class Upright:
    """Rotate the scene about the origin so that its up direction becomes a coordinate axis.

    Attributes:
        axis: "y" or "z", the axis that points up afterwards.
    """

    axis: str

    def __post_init__(self) -> None:
        if self.axis not in UPRIGHT_AXES:
            raise ValueError(f"axis is {self.axis!r}; it must be {' or '.join(map(repr, UPRIGHT_AXES))}")

    def __str__(self) -> str:
        return f"turn upright, with +{self.axis} up"


@dataclass(frozen=True)
class Center:
    """Move the scene so that the point that its cameras look at becomes the origin."""

    def __str__(self) -> str:
        return "move the centre to the origin"


@dataclass(frozen=True)
class Up:
    """State which direction is up. Viewers turn about it, and exports to formats with an up axis are turned by it.

    Attributes:
        direction: the direction in the file's axes, of any length above 0.
    """

    direction: Vector

    def __post_init__(self) -> None:
        _check_direction("direction", self.direction)

    def __str__(self) -> str:
        return f"take {_format(self.direction)} as up"


@dataclass(frozen=True)
class EstimateUp:
    """State which direction is up, as `Up`, by an estimate from the cameras."""

    def __str__(self) -> str:
        return "estimate up from the cameras"


Move = Translate | Rotate | Scale
Action = (
    Crop
    | Remove
    | MinOpacity
    | MaxScale
    | RemoveFloaters
    | Refit
    | KeepGaussians
    | Background
    | Move
    | Upright
    | Center
    | Up
    | EstimateUp
)


@dataclass(frozen=True)
class EditLimits:
    """Limits of the file that an edit writes, of which it takes one. They need profile "compact".

    Attributes:
        target_bytes: best quality within this file size, such as 2MB.
        max_psnr_drop: smallest file that loses at most this PSNR, in dB, on the held-out photos of `data`, compared
            with the edited model. Where the edit changed a picture, its pixels do not count.
    """

    target_bytes: Annotated[int | None, Range(1, unit="bytes")] = None
    max_psnr_drop: Annotated[float | None, Range(0, unit="dB")] = None

    def __post_init__(self) -> None:
        check_settings(self)


def _format(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"
