"""HybridModel: explicit Gaussians, a geometry field, a radiance field and a background in one module."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hyrfpack.model.config import ModelConfig
from hyrfpack.model.exposure import ExposureMap
from hyrfpack.model.field import Field
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.residuals import add_color_residuals, add_shape_residuals
from hyrfpack.ops import activate
from hyrfpack.ops.background import BackgroundField, background_colors, background_grid
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.dispatch import is_mixed_precision_usable
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Gaussians3D
from hyrfpack.ops.rows import take_rows
from hyrfpack.ops.shade import DIRECTION_FEATURES, Shading, encode_views, shade
from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel.pool import parallel_map

# Without gradients, fields are evaluated for this many Gaussians at a time, which bounds the memory of hash features.
GAUSSIANS_PER_BLOCK = 1 << 18
# On the CPU one thread evaluates a block, and each thread should get several.
GAUSSIANS_PER_CPU_BLOCK = 1 << 15


@dataclass(frozen=True)
class Geometry:
    """Activated view-independent properties of decoded Gaussians.

    Attributes:
        scales: (N, 3) standard deviations in local units.
        quats: (N, 4) wxyz, not normalised, because the rasteriser normalises them.
        opacities: (N,) in (0, 1).
    """

    scales: Tensor
    quats: Tensor
    opacities: Tensor

    def __getitem__(self, index: Tensor) -> Geometry:
        return Geometry(self.scales[index], self.quats[index], self.opacities[index])

    def with_means(self, means: Tensor) -> Gaussians3D:
        """Return the Gaussians with this geometry and these centres (N, 3)."""
        return Gaussians3D(means, self.quats, self.scales, self.opacities)


@dataclass(frozen=True)
class Decoded:
    """The part of a model's evaluation that can be reused: for many views, or with colours for one view.

    Attributes:
        geometry: geometry of all Gaussians.
        shading: the position-dependent part of the colour decoder's first layer for all Gaussians, and the remaining
            layers; None if it would save no time.
        colors: (N, 3) the colours of all Gaussians in view of the one camera that is rendered, see `colors_in_view`;
            others are black. None if colours are computed for each view.
    """

    geometry: Geometry
    shading: Shading | None
    colors: Tensor | None = None

    def __getitem__(self, index: Tensor) -> Decoded:
        return Decoded(
            self.geometry[index],
            None if self.shading is None else self.shading.subset(index),
            None if self.colors is None else self.colors[index],
        )


def scale_bounds(positions: Tensor, config: ModelConfig) -> Tensor:
    """Return S(p), (N, 1): the largest scale, in local units, of a Gaussian at local positions (N, 3).

    S(p) = max(1, |u|) with u = p / half_extent, or 1 everywhere when `config.scale_grows` is off.
    """
    return activate.scale_bounds(positions, config.frame.half_extent if config.scale_grows else None)


class HybridModel(nn.Module):
    """A hybrid radiance field (HyRF, NeurIPS 2025).

    The properties of a Gaussian combine its explicit logits (e) with the neural fields at its position (n):

        opacity = sigmoid(a_n + a_e)      colour = sigmoid(c_n(direction) + c_e)
        scale = S(p) sigmoid(s_n + s_e)   rotation = normalize(r_n + (1, 0, 0, 0))

    with S(p) = max(1, |u|) local units. All positions are local to `config.frame`. Residuals correct shapes and colours
    of single Gaussians, see `hyrfpack.model.residuals`.

    Attributes:
        precision: precision of the decoders' products in GPU kernels, not stored in files: "mixed" rounds factors to
            bfloat16 and adds up in float32, "float32" rounds nothing. The CPU always computes in float32.
        exposure: the exposure map; None for a model of one exposure. `hyrfpack.render_view` and
            `hyrfpack.export_model` apply it.
        background_spacing: the spacing of nodes at which training evaluated the background: the tangent of their angle
            at the picture's centre. 0 if it is not known.
    """

    def __init__(self, config: ModelConfig, gaussians: Gaussians, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.config = config
        self.precision = "mixed"
        self.exposure: ExposureMap | None = None
        self.background_spacing = 0.0
        self.gaussians = gaussians
        self.geometry = Field(config.geometry, outputs=8, hidden=config.hidden, generator=generator)
        self.radiance = Field(
            config.radiance,
            outputs=3,
            hidden=config.hidden,
            extra_inputs=DIRECTION_FEATURES[config.direction_encoding],
            generator=generator,
        )

    def subset(self, index: Tensor) -> HybridModel:
        """Return a model with copies of the Gaussians at `index` (n,) int64; it shares the fields with this model."""
        return self.with_gaussians(self.gaussians.subset(index))

    def with_gaussians(self, gaussians: Gaussians, config: ModelConfig | None = None) -> HybridModel:
        """Return a model of other Gaussians; it shares the fields with this model.

        Args:
            gaussians: the Gaussians, with the residuals that the configuration asks for.
            config: the configuration, which differs at most in `residual_degree` from that of this model.
        """
        with torch.device("meta"):  # has no storage, so that no random initial values are computed
            model = HybridModel(config or self.config, gaussians)
        model.geometry, model.radiance = self.geometry, self.radiance
        model.copy_settings(self)
        return model

    def copy_settings(self, other: HybridModel) -> None:
        """Set precision, exposure map and background spacing to those of another model."""
        self.precision, self.exposure = other.precision, other.exposure
        self.background_spacing = other.background_spacing

    def cube_coords(self, positions: Tensor, used: Tensor | None = None) -> Tensor:
        """Convert local positions (N, 3) to coordinates (N, 3) in the hash grids' unit cube.

        `used` is the number of rows in use, see `hyrfpack.ops.rows`; None if all are.
        """
        return contract(positions, self.config.frame.half_extent, used=used)

    def scale_bounds(self, positions: Tensor) -> Tensor:
        """Return the largest scales S(p), (N, 1), at local positions (N, 3); see `scale_bounds`."""
        return scale_bounds(positions, self.config)

    @property
    def _mixed(self) -> bool:
        is_on_gpu = self.gaussians.positions.device.type == "cuda"
        return self.precision == "mixed" and is_on_gpu and is_mixed_precision_usable()

    def _field_positions(self, positions: Tensor) -> Tensor:
        return positions if self.config.position_gradients else positions.detach()

    @torch.no_grad()
    def decode(self) -> Decoded:
        """Evaluate the view-independent part for all Gaussians, to render many views of a model that does not change.

        The result takes 4 (hidden + 8) bytes per Gaussian, or 2 hidden + 32 with mixed precision on a GPU.
        """
        return self.add_shading(self.geometry_from_outputs(self.geometry_outputs()))

    @torch.no_grad()
    def add_shading(self, geometry: Geometry) -> Decoded:
        """Return what `decode` does, given the geometry of all Gaussians."""
        is_faster = self.gaussians.positions.device.type in ("cpu", "cuda") and not self.radiance.is_constant_zero
        return Decoded(geometry, self.compute_shading() if is_faster else None)

    @torch.no_grad()
    def compute_shading(self) -> Shading:
        """Evaluate the view-independent part of the colour decoder's first layer for all Gaussians."""
        field, explicit = self.radiance, self.gaussians
        position_inputs = field.grid.feature_count
        (weight, w2, w3), (bias, b2, b3) = self._color_layers()
        first = weight.new_empty(len(self), len(bias), dtype=torch.bfloat16 if self._mixed else None)

        def evaluate(positions: Tensor) -> Tensor:
            return mlp(
                field.grid(self.cube_coords(positions)), [weight[:, :position_inputs]], [bias], mixed=self._mixed
            )

        return Shading(
            self._fill_blocks(first, evaluate),
            weight[:, position_inputs:].contiguous(),
            (w2, w3),
            (b2, b3),
            explicit.color_logits.detach(),
            self.config.direction_encoding,
            self._mixed,
        )

    @torch.no_grad()
    def geometry_outputs(self) -> Tensor:
        """Return the raw outputs (N, 8) of the geometry field at the positions of all Gaussians."""
        outputs = self.gaussians.positions.new_empty(len(self), 8)
        return self._fill_blocks(
            outputs, lambda positions: self.geometry(self.cube_coords(positions), mixed=self._mixed)
        )

    def _fill_blocks(self, rows: Tensor, evaluate: Callable[[Tensor], Tensor]) -> Tensor:
        """Write a function of the positions of all Gaussians to `rows` (N, ...), block by block; return the rows."""
        count = GAUSSIANS_PER_CPU_BLOCK if rows.device.type == "cpu" else GAUSSIANS_PER_BLOCK

        @torch.no_grad()  # gradient mode is kept per thread
        def fill(start: int) -> None:
            block = slice(start, start + count)
            rows[block] = evaluate(self.gaussians.positions[block])

        parallel_map(fill, range(0, len(rows), count), rows.device)
        return rows

    @torch.no_grad()
    def geometry_from_outputs(self, outputs: Tensor) -> Geometry:
        """Return what `decode_geometry` does for all Gaussians, given the result (N, 8) of `geometry_outputs`."""
        explicit = self.gaussians
        if explicit.shape_residuals is not None:
            outputs = add_shape_residuals(outputs, explicit.shape_residuals)
        inputs = outputs, explicit.positions, explicit.scale_logits, explicit.opacity_logits
        if outputs.device.type != "cpu":
            return self.activate(*inputs)
        geometry = Geometry(
            outputs.new_empty(len(self), 3), outputs.new_empty(len(self), 4), outputs.new_empty(len(self))
        )

        @torch.no_grad()  # gradient mode is kept per thread
        def fill(start: int) -> None:
            block = slice(start, start + GAUSSIANS_PER_CPU_BLOCK)
            activated = self.activate(*(values[block] for values in inputs))
            geometry.scales[block], geometry.quats[block] = activated.scales, activated.quats
            geometry.opacities[block] = activated.opacities

        parallel_map(fill, range(0, len(self), GAUSSIANS_PER_CPU_BLOCK))
        return geometry

    def decode_geometry(self, index: Tensor | None = None, used: Tensor | None = None) -> Geometry:
        """Return scales, rotations and opacities of the Gaussians at `index` (n,) int64, or of all.

        `used` is the number of indices in use, see `hyrfpack.ops.rows`; None if all are.
        """
        explicit = self.gaussians

        def select(values: Tensor) -> Tensor:
            return values if index is None else take_rows(values, index, used)

        positions = self._field_positions(select(explicit.positions))
        raw = self.geometry(self.cube_coords(positions, used), mixed=self._mixed, used=used)
        if explicit.shape_residuals is not None:
            raw = add_shape_residuals(raw, select(explicit.shape_residuals))
        return self.activate(raw, positions, select(explicit.scale_logits), select(explicit.opacity_logits), used)

    def activate(
        self,
        raw: Tensor,
        positions: Tensor,
        scale_logits: Tensor,
        opacity_logits: Tensor,
        used: Tensor | None = None,
    ) -> Geometry:
        """Combine raw outputs (n, 8) of the geometry field with the explicit logits; see `activate_geometry`."""
        half_extent = self.config.frame.half_extent if self.config.scale_grows else None
        rule = self.config.scale_rule
        scales, quats, opacities = activate.activate_geometry(
            raw, positions, scale_logits, opacity_logits, half_extent=half_extent, rule=rule, used=used
        )
        return Geometry(scales, quats, opacities)

    def decode_colors(
        self,
        viewpoint: Tensor,
        index: Tensor | None = None,
        shading: Shading | None = None,
        used: Tensor | None = None,
    ) -> Tensor:
        """Return colours (n, 3), 0 or more, of the Gaussians at `index` (n,), seen from `viewpoint` (3,), local units.

        Without colour residuals they lie in (0, 1). `shading` is the result of `compute_shading()`, if known; then the
        colours are not differentiable in the fields. `used` is the number of indices in use (`hyrfpack.ops.rows`).
        """
        explicit = self.gaussians
        positions, logits, residuals = explicit.positions, explicit.color_logits, explicit.color_residuals
        if shading is not None:
            colors = shade(positions, viewpoint, shading, index)
        if index is not None:
            positions, logits = take_rows(positions, index, used), take_rows(logits, index, used)
        positions = self._field_positions(positions)
        if shading is None and self.radiance.is_constant_zero:
            colors = torch.sigmoid(logits)
        elif shading is None:
            colors = torch.sigmoid(self._radiance(positions, viewpoint, used) + logits)
        if residuals is None:
            return colors
        directions = torch.nn.functional.normalize(positions - viewpoint, dim=-1, eps=1e-12)
        return add_color_residuals(colors, residuals if index is None else residuals[index], directions)

    def decode_background(self, points: Tensor, viewport: Viewport) -> Tensor:
        """Return background colours (n, 3) in (0, 1) at points (n, 2) of the image, in pixels.

        Args:
            points: (n, 2) in pixels.
            viewport: the camera, in local units.
        """
        return background_colors(points, viewport, self._background_field())

    def background_grid(self, transmittance: Tensor, viewport: Viewport, *, threshold: float, stride: int) -> Tensor:
        """Return background colours (rows, columns, 3) of every stride-th pixel, see `ops.background`."""
        return background_grid(transmittance, viewport, self._background_field(), threshold=threshold, stride=stride)

    def _background_field(self) -> BackgroundField:
        """Return the radiance field as the background operations take it."""
        weights, biases = self._color_layers()
        return BackgroundField(
            half_extent=self.config.frame.half_extent,
            table=self.radiance.grid.table,
            resolutions=self.radiance.grid.config.resolutions,
            log2_table_size=self.radiance.grid.config.log2_table_size,
            weights=weights,
            biases=biases,
            encoding=self.config.direction_encoding,
            mixed=self._mixed,
        )

    def _color_layers(self) -> tuple[list[Tensor], list[Tensor]]:
        """Return weights and biases of the colour decoder."""
        return list(self.radiance.weights), list(self.radiance.biases)

    def _radiance(self, positions: Tensor, viewpoint: Tensor, used: Tensor | None) -> Tensor:
        encoded_views = encode_views(positions, viewpoint, self.config.direction_encoding, used=used)
        return self.radiance(self.cube_coords(positions, used), encoded_views, mixed=self._mixed, used=used)

    def __len__(self) -> int:
        return len(self.gaussians)
