"""shade: every implementation against the float64 reference, the reference against the whole decoder."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from ops.device import KERNEL_DEVICE, gpu, needs_triton

from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.shade import DIRECTION_FEATURES, Shading, encode_directions, shade

# Implementations that take factors in bfloat16.
BFLOAT16_IMPLEMENTATIONS = ["reference", pytest.param("gpu", marks=needs_triton)]
ON_CPU = pytest.mark.skipif(KERNEL_DEVICE != "cpu", reason="tensors of these tests are on the GPU")
TESTED_IMPLEMENTATIONS = [*BFLOAT16_IMPLEMENTATIONS, pytest.param("cpu", marks=ON_CPU)]
HASH_FEATURES = 10


def normal(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).float().double()


def make_decoder(count: int, encoding: str, widths: tuple[int, int]) -> tuple[torch.Tensor, list, list, torch.Tensor]:
    """Return hash features (N, 10), weights and biases of the whole decoder, and colour logits, in float64."""
    layers = (HASH_FEATURES + DIRECTION_FEATURES[encoding], *widths, 3)
    weights = [normal(o, i, seed=o + i) / i**0.5 for i, o in zip(layers, layers[1:], strict=False)]
    biases = [0.3 * normal(o, seed=o) for o in layers[1:]]
    return normal(count, HASH_FEATURES, seed=1), weights, biases, normal(count, 3, seed=2)


def make_shading(features, weights, biases, logits, encoding: str, mixed: bool = False) -> Shading:
    first = features @ weights[0][:, :HASH_FEATURES].T + biases[0]
    directions = weights[0][:, HASH_FEATURES:].contiguous()
    return Shading(first, directions, tuple(weights[1:]), tuple(biases[1:]), logits, encoding, mixed)


def to_gpu_float32(shading: Shading) -> Shading:
    """Return the shading in float32 on the device of the GPU kernels."""

    def to(value):
        if isinstance(value, tuple):
            return tuple(map(to, value))
        return gpu(value.float()) if isinstance(value, torch.Tensor) else value

    values = {field.name: to(getattr(shading, field.name)) for field in dataclasses.fields(shading)}
    if shading.mixed:
        values["first_layer"] = values["first_layer"].bfloat16()
    return Shading(**values)


# Name -> (positions, viewpoint, hidden widths).
SHADING_CASES = {
    "random": (normal(300, 3, seed=3), normal(3, seed=4), (64, 64)),
    "narrow layers": (normal(40, 3, seed=3), normal(3, seed=4), (16, 5)),
    "wide layers": (normal(40, 3, seed=3), normal(3, seed=4), (100, 128)),
    "one": (normal(1, 3, seed=3), normal(3, seed=4), (64, 64)),
    "none": (normal(0, 3, seed=3), normal(3, seed=4), (64, 64)),
    "at the viewpoint": (torch.zeros(5, 3).double(), torch.zeros(3).double(), (64, 64)),
    "along the axes": (torch.cat([torch.eye(3), -torch.eye(3)]).double(), torch.zeros(3).double(), (64, 64)),
    "1e6 away": (1e6 * normal(50, 3, seed=3), normal(3, seed=4), (64, 64)),
    "1e-6 away": (1e-6 * normal(50, 3, seed=3), torch.zeros(3).double(), (64, 64)),
}


@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
@pytest.mark.parametrize("case", SHADING_CASES)
def test_the_reference_matches_the_whole_decoder(case: str, encoding: str) -> None:
    positions, viewpoint, widths = SHADING_CASES[case]
    features, weights, biases, logits = make_decoder(len(positions), encoding, widths)

    colors = shade(positions, viewpoint, make_shading(features, weights, biases, logits, encoding))

    directions = torch.nn.functional.normalize(positions - viewpoint, dim=-1, eps=1e-12)
    inputs = torch.cat((features, encode_directions(directions, encoding)), 1)
    torch.testing.assert_close(colors, torch.sigmoid(mlp(inputs, weights, biases) + logits), rtol=0, atol=1e-12)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
@pytest.mark.parametrize("case", SHADING_CASES)
def test_matches_the_float64_reference(case: str, encoding: str, implementation: str) -> None:
    positions, viewpoint, widths = SHADING_CASES[case]
    shading = make_shading(*make_decoder(len(positions), encoding, widths), encoding)
    positions, viewpoint = positions.float(), viewpoint.float()
    expected = shade(positions.double(), viewpoint.double(), shading)

    colors = shade(gpu(positions), gpu(viewpoint), to_gpu_float32(shading), implementation=implementation)

    torch.testing.assert_close(colors.cpu().double(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("implementation", BFLOAT16_IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_mixed_precision_stays_close_to_float64(encoding: str, implementation: str) -> None:
    positions, viewpoint, widths = SHADING_CASES["random"]
    inputs = make_decoder(len(positions), encoding, widths)
    exact = shade(positions, viewpoint, make_shading(*inputs, encoding))
    rounded = to_gpu_float32(make_shading(*inputs, encoding, mixed=True))
    wanted = dataclasses.replace(make_shading(*inputs, encoding, mixed=True), first_layer=rounded.first_layer.cpu())
    expected = shade(positions, viewpoint, wanted, implementation="reference")

    colors = shade(gpu(positions.float()), gpu(viewpoint.float()), rounded, implementation=implementation)

    error = (colors.cpu().double() - expected).abs()
    assert error.max() < 4e-3 and error.median() < 1e-5  # a factor that rounds the other way is off by 2^-9
    assert (colors.cpu().double() - exact).abs().max() < 2e-2


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("places", [[], [7], [299, 3, 3, 0]])
def test_shading_a_subset_gives_the_same_colours(places: list[int], implementation: str) -> None:
    positions, viewpoint, widths = SHADING_CASES["random"]
    shading = to_gpu_float32(make_shading(*make_decoder(len(positions), "sh", widths), "sh"))
    positions, viewpoint, index = gpu(positions.float()), gpu(viewpoint.float()), gpu(torch.tensor(places).long())

    colors = shade(positions, viewpoint, shading, index, implementation=implementation)

    assert colors.shape == (len(places), 3)
    torch.testing.assert_close(colors, shade(positions, viewpoint, shading, implementation=implementation)[index])


@ON_CPU
def test_chunks_on_the_cpu_do_not_depend_on_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    positions = normal(5000, 3, seed=3).float()
    shading = to_gpu_float32(make_shading(*make_decoder(5000, "frequency", (64, 64)), "frequency"))
    expected = shade(positions, torch.zeros(3), shading, implementation="reference")
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("HYRFPACK_THREADS", threads)
        found.append(shade(positions, torch.zeros(3), shading, implementation="cpu"))
    assert torch.equal(*found)
    torch.testing.assert_close(found[0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_memory_layout_has_no_effect(implementation: str) -> None:
    positions, viewpoint, widths = SHADING_CASES["random"]
    shading = to_gpu_float32(make_shading(*make_decoder(len(positions), "sh", widths), "sh"))
    positions, viewpoint = gpu(positions.float()), gpu(viewpoint.float())

    def spread(tensor: torch.Tensor) -> torch.Tensor:
        """Return the same numbers with a stride of two on the last axis."""
        return tensor.repeat_interleave(2, -1)[..., ::2]

    others = {name: spread(getattr(shading, name)) for name in ("first_layer", "direction_weight", "color_logits")}
    others |= {name: tuple(map(spread, getattr(shading, name))) for name in ("weights", "biases")}
    colors = shade(
        spread(positions), spread(viewpoint), dataclasses.replace(shading, **others), implementation=implementation
    )

    torch.testing.assert_close(colors, shade(positions, viewpoint, shading, implementation=implementation))


@pytest.mark.parametrize("wrong", ["first_layer", "direction_weight", "color_logits", "encoding"])
def test_inputs_that_do_not_match_are_rejected(wrong: str) -> None:
    positions, viewpoint, widths = SHADING_CASES["random"]
    shading = make_shading(*make_decoder(len(positions), "sh", widths), "sh")
    value = "no such" if wrong == "encoding" else getattr(shading, wrong)[:-1]
    with pytest.raises(ValueError, match="do not form a decoder"):
        shade(positions, viewpoint, dataclasses.replace(shading, **{wrong: value}))
