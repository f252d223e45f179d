"""The hot operations on a model's own numbers: each implementation against the reference in float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from hyrfpack.bench.rows import Row, difference, relative_difference, worst
from hyrfpack.bench.subject import Subject
from hyrfpack.measure.timing import take_turns
from hyrfpack.model import HybridModel, viewpoint_of
from hyrfpack.model.field import Field
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.ops.shade import encode_directions
from hyrfpack.scene import Camera


@dataclass(frozen=True)
class Way:
    """A way to run an operation.

    Attributes:
        name: for people.
        implementation: as the operation calls it.
        dtype: of all tensors, but for those in `dtypes`.
    """

    name: str
    implementation: str
    dtype: torch.dtype
    dtypes: Mapping[str, torch.dtype] = field(default_factory=dict)

    def cast(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: tensor.to(self.dtypes.get(name, self.dtype)) for name, tensor in inputs.items()}


# The first is what the others are measured against.
EXACT = Way("float64 reference", "reference", torch.float64)
RASTERIZE_WAYS = (
    EXACT,
    Way("float32 reference", "reference", torch.float32),
    Way("cpu", "cpu", torch.float32),
)
HASH_WAYS = (*RASTERIZE_WAYS, Way("cpu, bfloat16 table", "cpu", torch.float32, {"table": torch.bfloat16}))
MLP_WAYS = (*RASTERIZE_WAYS, Way("bfloat16 reference", "reference", torch.bfloat16))
DEFAULT_WAY = "cpu"


@torch.no_grad()
def rasterize_rows(subject: Subject, repeats: int, note: Callable[[str], None]) -> Iterator[Row]:
    """Draw the model's Gaussians as one view sees them; antialiased and not, forward and with all gradients."""
    model, camera, pose = _one_view(subject)
    geometry = model.decode_geometry()
    inputs = {
        "means": model.gaussians.positions,
        "quats": geometry.quats,
        "scales": geometry.scales,
        "opacities": geometry.opacities,
        "colors": model.decode_colors(viewpoint_of(pose).float()),
    }

    def draw(antialiased: bool, implementation: str, **tensors: Tensor) -> Tensor:
        view = (pose, camera.intrinsics, camera.width, camera.height)
        picture = rasterize(*tensors.values(), *view, antialiased=antialiased, implementation=implementation)
        return torch.cat((picture.rgb, picture.transmittance[..., None]), dim=-1)

    for antialiased in (False, True):
        name = "antialiased, " if antialiased else ""
        yield from _compare(
            "rasterize", name, partial(draw, antialiased), inputs, tuple(inputs), RASTERIZE_WAYS, difference, repeats
        )


@torch.no_grad()
def hash_encode_rows(subject: Subject, repeats: int, note: Callable[[str], None]) -> Iterator[Row]:
    """Look up both fields' features at all Gaussians; gradients reach the table, as in training."""
    coords = subject.model.cube_coords(subject.model.gaussians.positions)
    for name, part in _fields(subject):
        grid = part.grid.config

        def look_up(implementation: str, coords: Tensor, table: Tensor, grid=grid) -> Tensor:
            # A table in another precision is unpacked for every call; that belongs to its time.
            table = table.to(coords.dtype)
            return hash_encode(coords, table, grid.resolutions, grid.log2_table_size, implementation=implementation)

        inputs = {"coords": coords, "table": part.grid.table}
        yield from _compare(
            "hash_encode", f"{name}, ", look_up, inputs, ("table",), HASH_WAYS, relative_difference, repeats
        )


@torch.no_grad()
def mlp_rows(subject: Subject, repeats: int, note: Callable[[str], None]) -> Iterator[Row]:
    """Run both fields' decoders on the features of all Gaussians; the radiance field's as one view sees them."""
    model, _, pose = _one_view(subject)
    positions = model.gaussians.positions
    directions = torch.nn.functional.normalize(positions - viewpoint_of(pose).float(), dim=-1, eps=1e-12)
    extra = {"geometry": None, "radiance": encode_directions(directions, model.config.direction_encoding)}
    for name, part in _fields(subject):
        layers = len(part.weights)
        inputs = {
            "features": part.features(model.cube_coords(positions), extra[name]),
            **{f"weights {layer}": part.weights[layer] for layer in range(layers)},
            **{f"biases {layer}": part.biases[layer] for layer in range(layers)},
        }

        def decode(implementation: str, layers: int = layers, **tensors: Tensor) -> Tensor:
            x, *parameters = tensors.values()
            return mlp(x, parameters[:layers], parameters[layers:], implementation=implementation)

        yield from _compare("mlp", f"{name}, ", decode, inputs, tuple(inputs), MLP_WAYS, relative_difference, repeats)


def _one_view(subject: Subject) -> tuple[HybridModel, Camera, Tensor]:
    """The model, a camera, and its pose (4, 4) camera_from_local, float64."""
    camera = subject.cameras[len(subject.cameras) // 2]
    return subject.model, camera, torch.as_tensor(subject.model.config.frame.local_pose(camera))


def _fields(subject: Subject) -> list[tuple[str, Field]]:
    return [("geometry", subject.model.geometry), ("radiance", subject.model.radiance)]


def _compare(
    group: str,
    prefix: str,
    operation: Callable[..., Tensor],
    inputs: Mapping[str, Tensor],
    trained: tuple[str, ...],
    ways: tuple[Way, ...],
    compare: Callable[[Tensor, Tensor, str], object],
    repeats: int,
) -> Iterator[Row]:
    """Rows of one operation, forward alone and with the gradients of `trained`; all ways take turns."""
    cotangent = torch.empty(0)

    def forward(way: Way, tensors: dict[str, Tensor]) -> Tensor:
        with torch.no_grad():
            return operation(way.implementation, **tensors)

    def with_gradients(way: Way, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        with torch.enable_grad():
            result = operation(way.implementation, **tensors)
            wanted = [tensors[name] for name in trained]
            return dict(zip(trained, torch.autograd.grad(result, wanted, cotangent.to(result.dtype)), strict=True))

    for setting, run in (("forward", forward), ("forward + backward", with_gradients)):
        setting = prefix + setting
        tasks = {}
        for way in ways:
            tensors = {name: tensor.detach().clone() for name, tensor in way.cast(inputs).items()}
            for name in trained:
                tensors[name].requires_grad_(run is with_gradients)
            tasks[way.name] = partial(run, way, tensors)
            if way.implementation == "cpu":
                tasks[way.name]()  # compiles kernels that are not cached: not to be taken for a slow first run
        times, results = take_turns(tasks, repeats)
        exact = results[ways[0].name]
        if run is forward:
            cotangent = torch.randn(exact.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        for way in ways:
            what, result = f"{group}, {setting}, {way.name}", results[way.name]
            parts = {}
            if run is with_gradients:
                parts = {name: relative_difference(result[name], exact[name], what) for name in trained}
            yield Row(
                group=group,
                setting=setting,
                value=way.name,
                is_reference=way is ways[0],
                is_default=way.name == DEFAULT_WAY,
                time=times[way.name],
                ratio=times[way.name].over(times[ways[0].name]),
                error=worst(list(parts.values())) if parts else compare(result, exact, what),
                parts=parts,
            )
