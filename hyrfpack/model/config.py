"""Configuration of a model: everything that is chosen before training and stored in the file."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from hyrfpack.model.frame import Frame
from hyrfpack.model.hash_grid import HashGridConfig
from hyrfpack.ops.harmonics import MAX_DEGREE
from hyrfpack.rotations import Quaternion


@dataclass(frozen=True)
class ModelConfig:
    """The configuration of a HybridModel.

    Attributes:
        frame: the box of the scene.
        geometry, radiance: hash grids of the two fields.
        hidden: width of the decoders' two hidden layers.
        background: whether a background sphere, coloured by the radiance field, lies behind the Gaussians.
        solid: RGB in [0, 1] of the background if there is no background sphere.
        scale_rule: "sum" S * sigmoid(s_n + s_e), or "product" S * sigmoid(s_n) * sigmoid(s_e).
        scale_grows: whether the largest scale S(p) grows with max(1, |u|) outside the box.
        direction_encoding: "frequency" (NeRF, 4 octaves) or "sh" (real spherical harmonics, bands 0 to 2).
        position_gradients: whether gradients flow from the fields to the Gaussians' positions (training only).
        antialiased: whether opacity is compensated for the rasteriser's low-pass filter.
        residual_degree: degree of the harmonics of colour residuals; None without residuals
            (`hyrfpack.model.residuals`).
    """

    frame: Frame
    geometry: HashGridConfig
    radiance: HashGridConfig
    hidden: int = 64
    background: bool = True
    solid: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale_rule: str = "sum"
    scale_grows: bool = True
    direction_encoding: str = "frequency"
    position_gradients: bool = False
    antialiased: bool = False
    residual_degree: int | None = None

    def to_dict(self) -> dict:
        """Return the configuration as plain numbers, strings, lists and dictionaries, ready for JSON.

        The frame has a rotation only if it is not the identity, and `residual_degree` is left out if it is None.
        """
        values = asdict(self)
        if not self.frame.is_rotated:
            del values["frame"]["rotation"]
        if self.residual_degree is None:
            del values["residual_degree"]
        return values

    @classmethod
    def from_dict(cls, values: dict) -> ModelConfig:
        """Build a configuration from a dictionary: the inverse of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: a field is missing, unknown or has a wrong value.
        """
        parts = dict(values)
        frame = dict(parts["frame"])
        for name, convert in (("center", _to_triple), ("scale", float), ("half_extent", _to_triple)):
            frame[name] = convert(frame[name])
        if "rotation" in frame:
            frame["rotation"] = _to_quaternion(frame["rotation"])
        parts["frame"] = Frame(**frame)
        for name in ("geometry", "radiance"):
            parts[name] = HashGridConfig(**parts[name])
        parts["solid"] = _to_triple(parts["solid"])
        return cls(**parts)

    def __post_init__(self) -> None:
        if self.scale_rule not in ("sum", "product"):
            raise ValueError(f"scale_rule is '{self.scale_rule}'; it must be 'sum' or 'product'")
        if self.direction_encoding not in ("sh", "frequency"):
            raise ValueError(f"direction_encoding is '{self.direction_encoding}'; it must be 'sh' or 'frequency'")
        if self.residual_degree not in (None, *range(MAX_DEGREE + 1)):
            raise ValueError(f"residual_degree is {self.residual_degree}; it must lie in [0, {MAX_DEGREE}]")
        if not 1 <= self.hidden <= 1024:
            raise ValueError(f"hidden is {self.hidden}; it must lie in [1, 1024]")
        if not (self.frame.scale > 0 and all(h > 0 for h in self.frame.half_extent)):
            raise ValueError("the frame's scale and half extents must be positive")


def _to_quaternion(values: list[float]) -> Quaternion:
    """Convert a list of four numbers to a tuple of floats."""
    w, x, y, z = map(float, values)
    return w, x, y, z


def _to_triple(values: list[float]) -> tuple[float, float, float]:
    """Convert a list of three numbers to a tuple of floats."""
    x, y, z = map(float, values)
    return x, y, z
