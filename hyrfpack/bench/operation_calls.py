"""Call the hot operations with named inputs, in any implementation and precision.

Benchmarks and GPU checks use these calls to time implementations and to compare them with each other. This module needs
no packages beyond those of the operations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hyrfpack.model.field import Field
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, RasterSettings, rasterize
from hyrfpack.ops.shade import encode_views
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.ops.viewport import Viewport

Gradients = tuple[Tensor, ...]


@dataclass(frozen=True)
class OperationCall:
    """An operation with its inputs.

    Attributes:
        run: function of an implementation's name and the inputs by name, all in the same precision; returns one tensor.
        inputs: input tensors by name.
        gradient_inputs: names of the inputs whose gradients are computed.
        error_bounds: largest allowed rms errors of the values and of a gradient of float32 kernels against the float64
            reference, as fractions of the reference's rms.
    """

    run: Callable[..., Tensor]
    inputs: Mapping[str, Tensor]
    gradient_inputs: tuple[str, ...]
    error_bounds: tuple[float, float] = (1e-4, 1e-3)

    def forward_task(self, *options: Any) -> Callable[[], Tensor]:
        """Return a task that computes the values; the arguments are those of `forward_backward_task`."""
        run = self._bind(*options)[0]
        return torch.no_grad()(run)

    def forward_backward_task(
        self,
        implementation: str,
        dtype: torch.dtype = torch.float32,
        dtypes: Mapping[str, torch.dtype] = {},
    ) -> Callable[[], tuple[Tensor, Gradients]]:
        """Return a task that computes the values and the gradients of `gradient_inputs`.

        Args:
            implementation: name of the operation's implementation.
            dtype: dtype of all inputs but those in `dtypes`.
            dtypes: dtypes of single inputs, by name.
        """
        run, leaves = self._bind(implementation, dtype, dtypes)
        upstream = None

        def task() -> tuple[Tensor, Gradients]:
            nonlocal upstream
            with torch.enable_grad():
                values = run()
            if upstream is None:  # This is so only in the first run, which is not timed.
                upstream = make_random_cotangent(values)
            return values.detach(), torch.autograd.grad(values, leaves, upstream)

        return task

    def separate_tasks(self, *options: Any, upstream: Tensor | None = None) -> tuple[Callable[[], Tensor], Callable]:
        """Return two tasks: the forward pass with recorded gradients, as in training, and its backward pass.

        Args:
            options: the arguments of `forward_backward_task`.
            upstream: gradient with respect to the values, which the backward pass starts from; random when None.
        """
        run, leaves = self._bind(*options)
        values = run()
        upstream = make_random_cotangent(values) if upstream is None else upstream.to(values.dtype)
        return run, lambda: torch.autograd.grad(values, leaves, upstream, retain_graph=True)

    def _bind(
        self,
        implementation: str,
        dtype: torch.dtype = torch.float32,
        dtypes: Mapping[str, torch.dtype] = {},
    ) -> tuple[Callable[[], Tensor], list[Tensor]]:
        """Return the operation bound to copies of its inputs, and the copies of `gradient_inputs`."""
        copies = {name: x.detach().to(dtypes.get(name, dtype), copy=True) for name, x in self.inputs.items()}
        leaves = [copies[name].requires_grad_() for name in self.gradient_inputs]
        return partial(self.run, implementation, **copies), leaves


def make_random_cotangent(values: Tensor) -> Tensor:
    """Return a random upstream gradient for `values`; it has the same numbers in every precision."""
    generator = torch.Generator().manual_seed(1)
    return torch.randn(values.shape, generator=generator).to(values.device, values.dtype)


def make_rasterize_call(
    inputs: Mapping[str, Tensor],
    viewport: Viewport,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
) -> OperationCall:
    """Return the call of `rasterize`; its values are (H, W, 4) colours and transmittance.

    Args:
        inputs: the Gaussians' tensors by name, see `collect_splat_inputs`.
        viewport, settings: as in `rasterize`.
    """

    def draw(implementation: str, **tensors: Tensor) -> Tensor:
        *gaussians, colors = tensors.values()
        image = rasterize(Gaussians3D(*gaussians), colors, viewport, settings, implementation=implementation)
        return join_color_and_transmittance(image)

    # In a few pixels, rounding moves alpha or transmittance across a threshold. These bounds allow for that.
    return OperationCall(draw, inputs, tuple(inputs), (1e-3, 1e-2))


def join_color_and_transmittance(rasterization: Rasterization) -> Tensor:
    """Return (H, W, 4) colours and transmittance."""
    return torch.cat((rasterization.rgb, rasterization.transmittance[..., None]), dim=-1)


def make_hash_encode_call(
    coords: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    gradient_inputs: tuple[str, ...] = ("table",),
) -> OperationCall:
    """Return the call of `hash_encode`; by default it computes only the gradient of the table, as in training."""

    def look_up(implementation: str, coords: Tensor, table: Tensor) -> Tensor:
        # A table in another precision is converted in every call, and this is part of the measured time.
        return hash_encode(coords, table.to(coords.dtype), resolutions, log2_table_size, implementation=implementation)

    return OperationCall(look_up, {"coords": coords, "table": table}, gradient_inputs)


def make_mlp_call(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], mixed: bool = False) -> OperationCall:
    """Return the call of `mlp` on the rows of x, with the gradients of all inputs."""
    layers = len(weights)

    def decode(implementation: str, features: Tensor, **parameters: Tensor) -> Tensor:
        numbers = list(parameters.values())
        return mlp(features, numbers[:layers], numbers[layers:], mixed=mixed, implementation=implementation)

    inputs = {"features": x}
    inputs |= {f"weights {layer}": tensor for layer, tensor in enumerate(weights)}
    inputs |= {f"biases {layer}": tensor for layer, tensor in enumerate(biases)}
    # Implementations may round a hidden value halfway between two bfloat16 numbers in different directions.
    return OperationCall(decode, inputs, tuple(inputs), (3e-3, 1e-2) if mixed else (1e-4, 1e-3))


def make_loss_call(image: Tensor, target: Tensor, mask: Tensor | None = None) -> OperationCall:
    """Return the call of the photometric loss of an image, with the gradient of the image."""

    def loss(implementation: str, image: Tensor, target: Tensor) -> Tensor:
        return photometric_loss(image, target, mask, implementation=implementation)

    return OperationCall(loss, {"image": image, "target": target}, ("image",))


@torch.no_grad()
def collect_splat_inputs(model: HybridModel, viewpoint: Tensor) -> dict[str, Tensor]:
    """Return the tensors of `Gaussians3D` and the colours by name, in this order, for all Gaussians of a model.

    The colours are those seen from a point (3,) in local units.
    """
    gaussians = model.decode_geometry().with_means(model.gaussians.positions.detach())
    return gaussians._asdict() | {"colors": model.decode_colors(viewpoint.to(gaussians.means))}


@torch.no_grad()
def iterate_decoder_inputs(model: HybridModel, viewpoint: Tensor) -> Iterator[tuple[str, Field, Tensor]]:
    """Yield the name of each field, the field, and the inputs (N, inputs) of its decoder for all Gaussians.

    The Gaussians are seen from `viewpoint` (3,) in local units.
    """
    positions = model.gaussians.positions.detach()
    encoded_views = encode_views(positions, viewpoint.to(positions), model.config.direction_encoding)
    extra_inputs = {"geometry": None, "radiance": encoded_views}
    for name, field in list_named_fields(model):
        yield name, field, field.features(model.cube_coords(positions), extra_inputs[name])


def list_named_fields(model: HybridModel) -> list[tuple[str, Field]]:
    """Return both fields with their names."""
    return [("geometry", model.geometry), ("radiance", model.radiance)]
