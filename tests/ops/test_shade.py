"""shade: every implementation against the float64 reference, the reference against the decoder it is a part of."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from ops.device import DEVICE, gpu, needs_triton

from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.shade import DIRECTION_FEATURES, Shading, encode_directions, shade

ROUNDING = ["reference", pytest.param("gpu", marks=needs_triton)]  # those that take factors in bfloat16
ON_CPU = pytest.mark.skipif(DEVICE != "cpu", reason="tensors of these tests are on the GPU")
IMPLEMENTATIONS = [*ROUNDING, pytest.param("cpu", marks=ON_CPU)]
PLACES = 10


def normal(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).float().double()


def decoder(count: int, encoding: str, widths: tuple[int, int]) -> tuple[torch.Tensor, list, list, torch.Tensor]:
    """Hash features (N, 10), weights and biases of the whole decoder, colour logits; float64."""
    layers = (PLACES + DIRECTION_FEATURES[encoding], *widths, 3)
    weights = [normal(o, i, seed=o + i) / i**0.5 for i, o in zip(layers, layers[1:], strict=False)]
    biases = [0.3 * normal(o, seed=o) for o in layers[1:]]
    return normal(count, PLACES, seed=1), weights, biases, normal(count, 3, seed=2)


def shading_of(features, weights, biases, logits, encoding: str, mixed: bool = False) -> Shading:
    first = features @ weights[0][:, :PLACES].T + biases[0]
    directions = weights[0][:, PLACES:].contiguous()
    return Shading(first, directions, tuple(weights[1:]), tuple(biases[1:]), logits, encoding, mixed)


def single(shading: Shading) -> Shading:
    """In float32, where the gpu kernels take it."""

    def to(value):
        if isinstance(value, tuple):
            return tuple(map(to, value))
        return gpu(value.float()) if isinstance(value, torch.Tensor) else value

    values = {field.name: to(getattr(shading, field.name)) for field in dataclasses.fields(shading)}
    if shading.mixed:
        values["first_layer"] = values["first_layer"].bfloat16()
    return Shading(**values)


# name -> (positions, viewpoint, hidden widths)
CASES = {
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
@pytest.mark.parametrize("case", CASES)
def test_reference_is_the_whole_decoder(case: str, encoding: str) -> None:
    positions, viewpoint, widths = CASES[case]
    features, weights, biases, logits = decoder(len(positions), encoding, widths)

    colors = shade(positions, viewpoint, shading_of(features, weights, biases, logits, encoding))

    directions = torch.nn.functional.normalize(positions - viewpoint, dim=-1, eps=1e-12)
    inputs = torch.cat((features, encode_directions(directions, encoding)), 1)
    torch.testing.assert_close(colors, torch.sigmoid(mlp(inputs, weights, biases) + logits), rtol=0, atol=1e-12)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
@pytest.mark.parametrize("case", CASES)
def test_matches_the_float64_reference(case: str, encoding: str, implementation: str) -> None:
    positions, viewpoint, widths = CASES[case]
    shading = shading_of(*decoder(len(positions), encoding, widths), encoding)
    positions, viewpoint = positions.float(), viewpoint.float()
    expected = shade(positions.double(), viewpoint.double(), shading)

    colors = shade(gpu(positions), gpu(viewpoint), single(shading), implementation=implementation)

    torch.testing.assert_close(colors.cpu().double(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("implementation", ROUNDING)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_mixed_precision_stays_near(encoding: str, implementation: str) -> None:
    positions, viewpoint, widths = CASES["random"]
    inputs = decoder(len(positions), encoding, widths)
    exact = shade(positions, viewpoint, shading_of(*inputs, encoding))
    rounded = single(shading_of(*inputs, encoding, mixed=True))
    wanted = dataclasses.replace(shading_of(*inputs, encoding, mixed=True), first_layer=rounded.first_layer.cpu())
    expected = shade(positions, viewpoint, wanted, implementation="reference")

    colors = shade(gpu(positions.float()), gpu(viewpoint.float()), rounded, implementation=implementation)

    error = (colors.cpu().double() - expected).abs()
    assert error.max() < 4e-3 and error.median() < 1e-5  # a factor that rounds the other way is off by 2^-9
    assert (colors.cpu().double() - exact).abs().max() < 2e-2


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("places", [[], [7], [299, 3, 3, 0]])
def test_some_have_the_colours_that_they_have_among_all(places: list[int], implementation: str) -> None:
    positions, viewpoint, widths = CASES["random"]
    shading = single(shading_of(*decoder(len(positions), "sh", widths), "sh"))
    positions, viewpoint, index = gpu(positions.float()), gpu(viewpoint.float()), gpu(torch.tensor(places).long())

    colors = shade(positions, viewpoint, shading, index, implementation=implementation)

    assert colors.shape == (len(places), 3)
    torch.testing.assert_close(colors, shade(positions, viewpoint, shading, implementation=implementation)[index])


@ON_CPU
def test_chunks_of_the_cpu_join_and_do_not_depend_on_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    positions = normal(5000, 3, seed=3).float()
    shading = single(shading_of(*decoder(5000, "frequency", (64, 64)), "frequency"))
    expected = shade(positions, torch.zeros(3), shading, implementation="reference")
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("HYRFPACK_THREADS", threads)
        found.append(shade(positions, torch.zeros(3), shading, implementation="cpu"))
    assert torch.equal(*found)
    torch.testing.assert_close(found[0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_memory_layout_does_not_matter(implementation: str) -> None:
    positions, viewpoint, widths = CASES["random"]
    shading = single(shading_of(*decoder(len(positions), "sh", widths), "sh"))
    positions, viewpoint = gpu(positions.float()), gpu(viewpoint.float())

    def spread(tensor: torch.Tensor) -> torch.Tensor:
        """The same numbers, the last axis in steps of two."""
        return tensor.repeat_interleave(2, -1)[..., ::2]

    others = {name: spread(getattr(shading, name)) for name in ("first_layer", "direction_weight", "color_logits")}
    others |= {name: tuple(map(spread, getattr(shading, name))) for name in ("weights", "biases")}
    colors = shade(
        spread(positions), spread(viewpoint), dataclasses.replace(shading, **others), implementation=implementation
    )

    torch.testing.assert_close(colors, shade(positions, viewpoint, shading, implementation=implementation))


@pytest.mark.parametrize("wrong", ["first_layer", "direction_weight", "color_logits", "encoding"])
def test_what_does_not_fit_together_is_rejected(wrong: str) -> None:
    positions, viewpoint, widths = CASES["random"]
    shading = shading_of(*decoder(len(positions), "sh", widths), "sh")
    value = "no such" if wrong == "encoding" else getattr(shading, wrong)[:-1]
    with pytest.raises(ValueError, match="do not form a decoder"):
        shade(positions, viewpoint, dataclasses.replace(shading, **{wrong: value}))
