"""The hot operations as calls: inputs by name, and what runs them in any implementation and precision.

For whoever times implementations or holds them against each other, on numbers of a model or any others. Needs no more
than the operations do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hyrfpack.model.field import Field
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Rasterization, rasterize
from hyrfpack.ops.shade import encode_views
from hyrfpack.ops.ssim import photometric_loss

Gradients = tuple[Tensor, ...]


@dataclass(frozen=True)
class Call:
    """An operation with its inputs.

    Attributes:
        run: takes an implementation's name, then the inputs by name in any one precision; returns one tensor.
        inputs: by name.
        wanted: names of the inputs that gradients are taken in.
        bounds: of float32 kernels against the float64 reference: the largest rms error of the values and of a
            gradient, as fractions of the reference's rms.
    """

    run: Callable[..., Tensor]
    inputs: Mapping[str, Tensor]
    wanted: tuple[str, ...]
    bounds: tuple[float, float] = (1e-4, 1e-3)

    def forward(self, *how: Any) -> Callable[[], Tensor]:
        """A task that returns the values; its arguments are those of `both`."""
        run = self._bound(*how)[0]
        return torch.no_grad()(run)

    def both(
        self,
        implementation: str,
        dtype: torch.dtype = torch.float32,
        dtypes: Mapping[str, torch.dtype] = {},
    ) -> Callable[[], tuple[Tensor, Gradients]]:
        """A task that returns the values and the gradients of `wanted`.

        Args:
            implementation: as the operation calls it.
            dtype: of all inputs, but for those in `dtypes`.
            dtypes: by name.
        """
        run, leaves = self._bound(implementation, dtype, dtypes)
        upstream = None

        def task() -> tuple[Tensor, Gradients]:
            nonlocal upstream
            with torch.enable_grad():
                values = run()
            if upstream is None:  # made in the first run, which is not measured
                upstream = cotangent(values)
            return values.detach(), torch.autograd.grad(values, leaves, upstream)

        return task

    def passes(self, *how: Any, upstream: Tensor | None = None) -> tuple[Callable[[], Tensor], Callable]:
        """Two tasks: the forward pass as training makes it, and the backward pass of one such.

        Args:
            how: the arguments of `both`.
            upstream: what the gradient of the values is multiplied by; random when None.
        """
        run, leaves = self._bound(*how)
        values = run()
        upstream = cotangent(values) if upstream is None else upstream.to(values.dtype)
        return run, lambda: torch.autograd.grad(values, leaves, upstream, retain_graph=True)

    def _bound(
        self,
        implementation: str,
        dtype: torch.dtype = torch.float32,
        dtypes: Mapping[str, torch.dtype] = {},
    ) -> tuple[Callable[[], Tensor], list[Tensor]]:
        """The operation on copies of its inputs, and those of `wanted`."""
        copies = {name: x.detach().to(dtypes.get(name, dtype), copy=True) for name, x in self.inputs.items()}
        leaves = [copies[name].requires_grad_() for name in self.wanted]
        return partial(self.run, implementation, **copies), leaves


def cotangent(values: Tensor) -> Tensor:
    """Random numbers to multiply the gradient of `values` by: the same in every precision."""
    generator = torch.Generator().manual_seed(1)
    return torch.randn(values.shape, generator=generator).to(values.device, values.dtype)


def rasterize_call(inputs: Mapping[str, Tensor], *view: Any, **options: Any) -> Call:
    """Drawing: (H, W, 4) colours and transmittance.

    Args:
        inputs: what `rasterize` takes of Gaussians, in its order.
        view, options: its other arguments.
    """

    def draw(implementation: str, **tensors: Tensor) -> Tensor:
        splats: Iterable[Any] = tensors.values()
        return picture(rasterize(*splats, *view, implementation=implementation, **options))

    # A few pixels' alpha or T falls on the other side of its threshold; their share of the length is below this.
    return Call(draw, inputs, tuple(inputs), (1e-3, 1e-2))


def picture(drawn: Rasterization) -> Tensor:
    """(H, W, 4) colours and transmittance."""
    return torch.cat((drawn.rgb, drawn.transmittance[..., None]), dim=-1)


def hash_encode_call(
    coords: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    wanted: tuple[str, ...] = ("table",),
) -> Call:
    """Looking up hash features; gradients reach the table alone, as in training, unless more is wanted."""

    def look_up(implementation: str, coords: Tensor, table: Tensor) -> Tensor:
        # A table in another precision is unpacked for every call; that belongs to its time.
        return hash_encode(coords, table.to(coords.dtype), resolutions, log2_table_size, implementation=implementation)

    return Call(look_up, {"coords": coords, "table": table}, wanted)


def mlp_call(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], mixed: bool = False) -> Call:
    """A decoder on rows of x, with gradients of all."""
    layers = len(weights)

    def decode(implementation: str, features: Tensor, **parameters: Tensor) -> Tensor:
        numbers = list(parameters.values())
        return mlp(features, numbers[:layers], numbers[layers:], mixed=mixed, implementation=implementation)

    inputs = {"features": x}
    inputs |= {f"weights {layer}": tensor for layer, tensor in enumerate(weights)}
    inputs |= {f"biases {layer}": tensor for layer, tensor in enumerate(biases)}
    # A hidden number on the edge between two bfloat16 is rounded one way here and the other way there.
    return Call(decode, inputs, tuple(inputs), (3e-3, 1e-2) if mixed else (1e-4, 1e-3))


def loss_call(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Call:
    """The photometric loss of a picture, with the picture's gradient."""

    def loss(implementation: str, image: Tensor, target: Tensor) -> Tensor:
        return photometric_loss(image, target, mask, implementation=implementation)

    return Call(loss, {"image": image, "target": target}, ("image",))


@torch.no_grad()
def splat_inputs(model: HybridModel, viewpoint: Tensor) -> dict[str, Tensor]:
    """What `rasterize` takes of all Gaussians of a model, in its order, seen from a point (3,) in local units."""
    geometry = model.decode_geometry()
    return {
        "means": model.gaussians.positions.detach(),
        "quats": geometry.quats,
        "scales": geometry.scales,
        "opacities": geometry.opacities,
        "colors": model.decode_colors(viewpoint.to(model.gaussians.positions)),
    }


@torch.no_grad()
def decoder_inputs(model: HybridModel, viewpoint: Tensor) -> Iterator[tuple[str, Field, Tensor]]:
    """Name, field and what its decoder reads (N, inputs) of all Gaussians seen from a point (3,) in local units."""
    positions = model.gaussians.positions.detach()
    seen = encode_views(positions, viewpoint.to(positions), model.config.direction_encoding)
    extra = {"geometry": None, "radiance": seen}
    for name, field in fields(model):
        yield name, field, field.features(model.cube_coords(positions), extra[name])


def fields(model: HybridModel) -> list[tuple[str, Field]]:
    """Both fields by name."""
    return [("geometry", model.geometry), ("radiance", model.radiance)]
