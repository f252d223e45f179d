"""The cases of the self-test: each GPU operation on a small random input, larger than one block of its kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from hyrfpack.ops.activate import activate_geometry
from hyrfpack.ops.adam import adam_step
from hyrfpack.ops.background import BackgroundField, background_grid, grid_size
from hyrfpack.ops.composite import composite
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.dispatch import MIXED_PRECISION
from hyrfpack.ops.hash_encode import hash_encode, level_offsets, level_resolutions
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.ops.rasterize.cull import frustum_cull, frustum_cull_into
from hyrfpack.ops.rows import take_rows
from hyrfpack.ops.shade import DIRECTION_FEATURES, Shading, encode_views, shade
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.ops.viewport import Viewport

Inputs = Mapping[str, Tensor]
# Widths of the decoders' layers, as of a trained model: kernels are compiled for them.
HIDDEN_WIDTH = 64
GEOMETRY_WIDTHS = (32, HIDDEN_WIDTH, HIDDEN_WIDTH, 8)
RADIANCE_WIDTHS = (32 + DIRECTION_FEATURES["frequency"], HIDDEN_WIDTH, HIDDEN_WIDTH, 3)
LOG2_TABLE_SIZE = 9
GRID_RESOLUTIONS = level_resolutions(4, 4, 40)
TRAINED_GRID_RESOLUTIONS = level_resolutions(16, 4, 40)
IMAGE_WIDTH, IMAGE_HEIGHT = 37, 33  # pixels: 3 x 3 tiles, with parts of a tile at the edges
BACKGROUND_STRIDE = 2


@dataclass(frozen=True)
class SelfTestCase:
    """An operation with inputs, and the errors that its kernels may have.

    Attributes:
        operation: the operation's name, one of `hyrfpack.ops.dispatch.GPU_OPERATIONS`.
        inputs: float32 CPU tensors by name; tensors of other types stay as they are in every precision.
        run: function of an implementation's name and the inputs; returns the results by name.
        gradient_inputs: names of the inputs whose gradients are tested.
        has_cpu_kernels: whether there is an implementation "cpu".
        is_mixed: whether products are in mixed precision. If only such cases fail, float32 kernels are used.
        bounds: largest allowed rms errors of a result and of a gradient against the float64 reference, as fractions of
            the reference's rms.
        reference_runs: whether the reference runs the operation; False if its results are constants.
    """

    operation: str
    inputs: Inputs
    run: Callable[[str, Inputs], dict[str, Tensor]]
    gradient_inputs: tuple[str, ...] = ()
    has_cpu_kernels: bool = False
    bounds: tuple[float, float] = (1e-4, 1e-3)
    is_mixed: bool = False
    reference_runs: bool = True

    @property
    def replaced_operation(self) -> str:
        """What is replaced if this case fails: the operation, or mixed precision of all operations."""
        return MIXED_PRECISION if self.is_mixed else self.operation


_HALF_EXTENT = (1.0, 0.5, 0.25)
# In a few pixels, rounding moves alpha or transmittance across a threshold. These bounds allow for that.
_RASTER_BOUNDS = (1e-3, 1e-2)
# Implementations may round a value halfway between two bfloat16 numbers in different directions.
_MIXED_BOUNDS = (5e-3, 2e-2)


@cache
def list_self_test_cases() -> dict[str, SelfTestCase]:
    """Return all cases by name. The kernels that others depend on come first."""
    return {
        "hash_encode": _make_hash_encode_case(),
        "mlp": _make_mlp_case(GEOMETRY_WIDTHS, mixed=False),
        "mlp, geometry, mixed precision": _make_mlp_case(GEOMETRY_WIDTHS, mixed=True),
        "mlp, radiance, mixed precision": _make_mlp_case(RADIANCE_WIDTHS, mixed=True),
        "contract": _make_contract_case(),
        "encode_views, frequency": _make_encode_views_case("frequency"),
        "encode_views, sh": _make_encode_views_case("sh"),
        "activate_geometry, sum": _make_activate_case("sum"),
        "activate_geometry, product": _make_activate_case("product"),
        "frustum_cull": _make_frustum_cull_case(),
        "rasterize": _make_rasterize_case(RasterSettings(depth=True)),
        "rasterize, antialiased": _make_rasterize_case(RasterSettings(antialiased=True), reserve=8192),
        "rasterize, training": _make_rasterize_in_training_case(),
        "rasterize, replay": _make_replay_case(),
        "shade": _make_shade_case(mixed=False),
        "shade, mixed precision": _make_shade_case(mixed=True),
        "rasterize_shaded": _make_rasterize_shaded_case(mixed=False),
        "rasterize_shaded, mixed precision": _make_rasterize_shaded_case(mixed=True),
        "background_grid": _make_background_case(),
        "background_grid, mixed precision": _make_background_case(TRAINED_GRID_RESOLUTIONS, mixed=True),
        "background_grid, gradients": _make_background_case(needs_grad=True),
        "composite": _make_composite_case(),
        "photometric_loss": _make_loss_case(masked=False),
        "photometric_loss, masked": _make_loss_case(masked=True),
        "adam_step": _make_adam_case(),
    }


def _draw_normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _draw_uniform(seed: int, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def _make_viewport() -> Viewport:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.1, -0.05, 4.0])
    return Viewport(pose, (30.0, 32.0, 0.45 * IMAGE_WIDTH, 0.55 * IMAGE_HEIGHT), IMAGE_WIDTH, IMAGE_HEIGHT)


def _make_layers(widths: tuple[int, ...], seed: int) -> dict[str, Tensor]:
    """Return weights "w0", "w1", ... and biases "b0", "b1", ... of an MLP."""
    layers: dict[str, Tensor] = {}
    for layer, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False)):
        layers[f"w{layer}"] = _draw_normal(seed + layer, outputs, inputs) / inputs**0.5
        layers[f"b{layer}"] = 0.1 * _draw_normal(seed + 10 + layer, outputs)
    return layers


def _split_layers(inputs: Inputs) -> tuple[list[Tensor], list[Tensor]]:
    """Return the weights and the biases of `_make_layers`."""
    return [inputs[f"w{layer}"] for layer in range(3)], [inputs[f"b{layer}"] for layer in range(3)]


def _list_rows(total: int) -> dict[str, Tensor]:
    """Return the indices of rows and how many of the first are in use, as training lists the Gaussians in view."""
    order = torch.randperm(total, generator=torch.Generator().manual_seed(40))
    return {"index": order[: total - 60], "used": torch.tensor([total - 120])}


def _take_listed(implementation: str, x: Inputs, *names: str) -> tuple[list[Tensor], Tensor | None]:
    """Return the listed rows of some inputs, and for kernels how many of them are in use.

    Kernels also get the rows past that number, which are undefined; other implementations do not.
    """
    index, used = (x["index"], x["used"]) if implementation == "gpu" else (x["index"][: int(x["used"])], None)
    listed = [take_rows(x[name].view(len(x[name]), -1), index, used) for name in names]
    return [rows.view(len(index), *x[name].shape[1:]) for name, rows in zip(names, listed, strict=True)], used


def _make_hash_encode_case() -> SelfTestCase:
    # Coordinates have 16 bits, so that a point has the same cell and offset in every precision.
    coords = torch.randint(0, 1 << 16, (700, 3), generator=torch.Generator().manual_seed(0)) / (1 << 16)
    table = _draw_normal(1, level_offsets(GRID_RESOLUTIONS, LOG2_TABLE_SIZE)[-1], 2)
    inputs = {"coords": coords, "table": table, **_list_rows(700)}

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        def encode(coords: Tensor, used: Tensor | None = None) -> Tensor:
            settings = GRID_RESOLUTIONS, LOG2_TABLE_SIZE
            features = hash_encode(coords, x["table"], *settings, used=used, implementation=implementation)
            return features.T  # so that gradients come column by column, as from `mlp`

        (listed,), used = _take_listed(implementation, x, "coords")
        features = encode(listed.detach(), used)[:, : int(x["used"])]
        return {"features": encode(x["coords"]), "features of listed rows": features}

    return SelfTestCase("hash_encode", inputs, run, ("coords", "table"), True)


def _make_mlp_case(widths: tuple[int, ...], mixed: bool) -> SelfTestCase:
    layers = _make_layers(widths, 1)
    inputs = {"rows": _draw_normal(0, 300, widths[0]), **layers, **_list_rows(300)}

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        def evaluate(rows: Tensor, used: Tensor | None = None) -> Tensor:
            rows = rows.T.contiguous().T  # column by column, as from `hash_encode`
            return mlp(rows, *_split_layers(x), mixed=mixed, used=used, implementation=implementation)

        (listed,), used = _take_listed(implementation, x, "rows")
        with torch.no_grad():
            outputs = evaluate(x["rows"])
        return {"outputs": outputs, "outputs of listed rows": evaluate(listed, used)[: int(x["used"])]}

    bounds = _MIXED_BOUNDS if mixed else (1e-4, 1e-3)
    return SelfTestCase("mlp", inputs, run, ("rows", *layers), not mixed, bounds, mixed)


def _make_contract_case() -> SelfTestCase:
    points = _draw_normal(0, 1500, 3) * torch.logspace(-1, 2, 1500)[:, None]

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        (listed,), used = _take_listed(implementation, x, "points")
        coords = contract(x["points"], _HALF_EXTENT, implementation=implementation)
        listed_coords = contract(listed, _HALF_EXTENT, used=used, implementation=implementation)
        return {"coords": coords, "coords of listed rows": listed_coords[: int(x["used"])]}

    return SelfTestCase("contract", {"points": points, **_list_rows(1500)}, run)


def _make_encode_views_case(encoding: str) -> SelfTestCase:
    inputs = {"points": _draw_normal(0, 700, 3), "viewpoint": _draw_normal(1, 3), **_list_rows(700)}

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        def encode(points: Tensor, used: Tensor | None = None) -> Tensor:
            return encode_views(points, x["viewpoint"], encoding, used=used, implementation=implementation)

        (listed,), used = _take_listed(implementation, x, "points")
        features = encode(listed, used)[: int(x["used"])]
        return {"features": encode(x["points"]), "features of listed rows": features}

    return SelfTestCase("encode_views", inputs, run)


def _make_activate_case(rule: str) -> SelfTestCase:
    rows = {"raw": _draw_normal(0, 700, 8), "positions": 2 * _draw_normal(1, 700, 3)}
    rows |= {"scale_logits": _draw_normal(2, 700, 1), "opacity_logits": _draw_normal(3, 700, 1)}

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        def activate(prefix: str, rows: list[Tensor], used: Tensor | None = None) -> dict[str, Tensor]:
            activated = activate_geometry(
                *rows, half_extent=_HALF_EXTENT, rule=rule, used=used, implementation=implementation
            )
            count = int(x["used"]) if prefix else len(rows[0])
            parts = ("scales", "quats", "opacities")
            return {prefix + name: part[:count] for name, part in zip(parts, activated, strict=True)}

        listed = activate("listed ", *_take_listed(implementation, x, *rows))
        return activate("", [x[name] for name in rows]) | listed

    return SelfTestCase("activate_geometry", rows | _list_rows(700), run, ("raw", "scale_logits", "opacity_logits"))


def _make_frustum_cull_case() -> SelfTestCase:
    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        positions, frustum = x["positions"], (_make_viewport(), 0.01, 0.1)
        index = frustum_cull(positions, *frustum, implementation=implementation)
        if implementation != "gpu":
            return {"index": index, "rows": positions[index]}
        listed, used, _ = frustum_cull_into(positions, *frustum, len(positions), implementation="gpu")
        return {"index": index, "rows": take_rows(positions, listed, used)[: len(index)]}

    return SelfTestCase("frustum_cull", {"positions": 3 * _draw_normal(0, 3000, 3)}, run, has_cpu_kernels=True)


def _make_splats(count: int) -> dict[str, Tensor]:
    return {
        "means": _draw_normal(0, count, 3),
        "quats": _draw_normal(1, count, 4),
        "scales": 0.1 * torch.exp(0.5 * _draw_normal(2, count, 3)),
        "opacities": torch.sigmoid(1.5 * _draw_normal(3, count)),
    }


def _make_rasterize_case(settings: RasterSettings, reserve: int | None = None) -> SelfTestCase:
    """Return the case of these settings; kernels render into the reserve, if any."""
    inputs = _make_splats(300) | {"colors": _draw_uniform(4, 300, 3)}

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        *gaussians, colors = x.values()
        image = rasterize(
            Gaussians3D(*gaussians), colors, _make_viewport(), settings,
            reserve=reserve if implementation == "gpu" else None, implementation=implementation,
        )  # fmt: skip
        depth = {"depth": image.depth} if image.depth is not None else {}
        return {"rgb": image.rgb, "transmittance": image.transmittance} | depth

    return SelfTestCase("rasterize", inputs, run, tuple(inputs), True, _RASTER_BOUNDS)


def _make_rasterize_in_training_case() -> SelfTestCase:
    """Return the case of a training step: listed Gaussians, reserved pairs, and sums of absolute gradients."""
    rows = _make_splats(300) | {"colors": _draw_uniform(4, 300, 3)}

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        (*gaussians, colors), used = _take_listed(implementation, x, *rows)
        absgrad = torch.zeros_like(colors[:, :2])  # The backward pass adds to it, before this result is compared.
        image = rasterize(
            Gaussians3D(*gaussians), colors, _make_viewport(), absgrad=absgrad, used=used,
            reserve=8192 if implementation == "gpu" else None, implementation=implementation,
        )  # fmt: skip
        return {"rgb": image.rgb, "transmittance": image.transmittance, "absgrad": absgrad[: int(x["used"])]}

    return SelfTestCase("rasterize", rows | _list_rows(300), run, tuple(rows), True, _RASTER_BOUNDS)


def _make_replay_case() -> SelfTestCase:
    """Return the case in which the backward pass replays the transmittance of the forward pass; all bits must agree."""
    inputs = _make_splats(300) | {"colors": _draw_uniform(4, 300, 3)}

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        if implementation != "gpu":
            return {"equal pixels": torch.ones(IMAGE_HEIGHT, IMAGE_WIDTH)}
        from hyrfpack.ops.rasterize.gpu import replay_transmittance

        *gaussians, colors = x.values()
        stored, replayed = replay_transmittance(Gaussians3D(*gaussians), colors, _make_viewport(), RasterSettings())
        return {"equal pixels": (stored == replayed).float()}

    return SelfTestCase("rasterize", inputs, run, bounds=(1e-6, 1e-6), reference_runs=False)


def _make_shading_inputs(count: int, mixed: bool) -> dict[str, Tensor]:
    layers = _make_layers((HIDDEN_WIDTH, HIDDEN_WIDTH, 3), 20)
    first = _draw_normal(10, count, HIDDEN_WIDTH)
    return {
        "first_layer": first.to(torch.bfloat16) if mixed else first,
        "direction_weight": _draw_normal(11, HIDDEN_WIDTH, DIRECTION_FEATURES["frequency"]) / 5,
        "color_logits": _draw_normal(12, count, 3),
    } | layers


def _make_shading(x: Inputs, mixed: bool) -> Shading:
    weights, biases = (x["w0"], x["w1"]), (x["b0"], x["b1"])
    return Shading(x["first_layer"], x["direction_weight"], weights, biases, x["color_logits"], "frequency", mixed)


def _make_shade_case(mixed: bool) -> SelfTestCase:
    inputs = {"positions": _draw_normal(0, 300, 3), "viewpoint": 3 * _draw_normal(1, 3)} | _make_shading_inputs(
        300, mixed
    )

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        shading = _make_shading(x, mixed)
        return {"colors": shade(x["positions"], x["viewpoint"], shading, implementation=implementation)}

    return SelfTestCase("shade", inputs, run, (), not mixed, _MIXED_BOUNDS if mixed else (1e-4, 1e-3), mixed)


def _make_rasterize_shaded_case(mixed: bool) -> SelfTestCase:
    splats = _make_splats(300)

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        gaussians = Gaussians3D(*(x[name] for name in splats))
        settings = RasterSettings(depth=True)
        image = rasterize(gaussians, _make_shading(x, mixed), _make_viewport(), settings, implementation=implementation)
        assert image.depth is not None
        return {"rgb": image.rgb, "transmittance": image.transmittance, "depth": image.depth}

    bounds = _MIXED_BOUNDS if mixed else _RASTER_BOUNDS
    return SelfTestCase("rasterize_shaded", splats | _make_shading_inputs(300, mixed), run, (), False, bounds, mixed)


def _make_background_case(
    resolutions: tuple[int, ...] = GRID_RESOLUTIONS, *, mixed: bool = False, needs_grad: bool = False
) -> SelfTestCase:
    features = 2 * len(resolutions) + DIRECTION_FEATURES["frequency"]
    table = _draw_normal(30, level_offsets(resolutions, LOG2_TABLE_SIZE)[-1], 2)
    # Light passes in stripes, at a distance from the threshold.
    light = torch.where(
        torch.arange(IMAGE_HEIGHT * IMAGE_WIDTH).view(IMAGE_HEIGHT, IMAGE_WIDTH) // 100 % 2 == 0, 0.9, 0.1
    )
    parameters = {"table": table} | _make_layers((features, HIDDEN_WIDTH, HIDDEN_WIDTH, 3), 31)

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        field = BackgroundField(
            (1.0, 1.0, 1.0), x["table"], resolutions, LOG2_TABLE_SIZE, *_split_layers(x), "frequency", mixed
        )
        grid = background_grid(
            x["transmittance"],
            _make_viewport(),
            field,
            threshold=0.5,
            stride=BACKGROUND_STRIDE,
            implementation=implementation,
        )
        return {"grid": grid}

    gradients = tuple(parameters) if needs_grad else ()
    # A direction's error is multiplied by the highest octave and by the finest level.
    bounds = _MIXED_BOUNDS if mixed else (1e-3, 1e-2)
    inputs = {"transmittance": light} | parameters
    return SelfTestCase("background_grid", inputs, run, gradients, not mixed, bounds, mixed)


def _make_composite_case() -> SelfTestCase:
    inputs = {
        "rgb": _draw_uniform(0, IMAGE_HEIGHT, IMAGE_WIDTH, 3),
        "transmittance": _draw_uniform(1, IMAGE_HEIGHT, IMAGE_WIDTH),
    }
    inputs["grid"] = _draw_uniform(2, *grid_size(IMAGE_HEIGHT, IMAGE_WIDTH, BACKGROUND_STRIDE), 3)

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        return {
            "image": composite(
                x["rgb"], x["transmittance"], x["grid"], BACKGROUND_STRIDE, implementation=implementation
            )
        }

    return SelfTestCase("composite", inputs, run, tuple(inputs), True)


def _make_loss_case(masked: bool) -> SelfTestCase:
    target = _draw_uniform(0, IMAGE_HEIGHT, IMAGE_WIDTH, 3)
    inputs = {"image": (target + 0.1 * _draw_normal(1, IMAGE_HEIGHT, IMAGE_WIDTH, 3)).clamp(0, 1), "target": target}
    if masked:
        inputs["mask"] = _draw_uniform(2, IMAGE_HEIGHT, IMAGE_WIDTH) < 0.7

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        return {"loss": photometric_loss(x["image"], x["target"], x.get("mask"), implementation=implementation)}

    return SelfTestCase("photometric_loss", inputs, run, ("image",), True)


def _make_adam_case() -> SelfTestCase:
    # Tensors of odd sizes end within a block. One gradient is not finite, and its element must not change.
    shapes = {"a": (1500, 3), "b": (701,)}
    inputs: dict[str, Tensor] = {}
    for seed, (name, shape) in enumerate(shapes.items()):
        inputs[f"value {name}"], inputs[f"gradient {name}"] = _draw_normal(seed, *shape), _draw_normal(seed + 2, *shape)
        inputs[f"exp_avg {name}"] = 0.1 * _draw_normal(seed + 4, *shape)
        inputs[f"exp_avg_sq {name}"] = _draw_uniform(seed + 6, *shape)
    inputs["gradient b"][3] = torch.inf
    inputs["enabled"] = torch.tensor([True, False])  # whether the second and third step change anything
    gradient_names = [f"gradient {name}" for name in shapes]

    def run(implementation: str, x: Inputs) -> dict[str, Tensor]:
        copies = {name: tensor.clone() for name, tensor in x.items()}
        lists = [
            [copies[f"{kind} {name}"] for name in shapes] for kind in ("value", "gradient", "exp_avg", "exp_avg_sq")
        ]
        values, gradients, exp_avg, exp_avg_sq = lists
        skipped = adam_step(values, gradients, exp_avg, exp_avg_sq, step=3, rate=0.1, implementation=implementation)
        for step, enabled in enumerate(x["enabled"], start=4):
            adam_step(*lists, step=step, rate=0.1, enabled=enabled, implementation=implementation)
        changed = {name: tensor for name, tensor in copies.items() if name not in ("enabled", *gradient_names)}
        return changed | {"skipped": skipped}

    return SelfTestCase("adam_step", inputs, run, (), True)
