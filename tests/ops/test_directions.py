"""encode_views: every implementation against directions normalised in float64 and their encodings in numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from ops.device import gpu, needs_triton
from torch import Tensor

from hyrfpack.ops.shade import DIRECTION_FEATURES, encode_views

TESTED_IMPLEMENTATIONS = ["reference", "cpu", pytest.param("gpu", marks=needs_triton)]


def random_values(*shape: int, seed: int = 0) -> Tensor:
    """Return random float64 numbers that float32 can represent."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


AXIS_DIRECTIONS = torch.cat([torch.eye(3), -torch.eye(3)]).double()
RANDOM_VIEWPOINT = random_values(3, seed=1)
# Name -> (points, viewpoint).
POINTS_AND_VIEWPOINTS = {
    "none": (random_values(0, 3), RANDOM_VIEWPOINT),
    "one": (random_values(1, 3), RANDOM_VIEWPOINT),
    "127": (random_values(127, 3), RANDOM_VIEWPOINT),
    "a block": (random_values(128, 3), RANDOM_VIEWPOINT),
    "a block and one more": (random_values(129, 3), RANDOM_VIEWPOINT),
    "at the viewpoint": (RANDOM_VIEWPOINT.expand(5, 3), RANDOM_VIEWPOINT),
    "along the axes": (AXIS_DIRECTIONS, torch.zeros(3).double()),
    "diagonals": (torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).double(), torch.zeros(3).double()),
    "1e4 away": ((1e4 * random_values(20, 3)).float().double(), RANDOM_VIEWPOINT),
    "1e15 away": ((1e15 * random_values(20, 3)).float().double(), RANDOM_VIEWPOINT),
    "the viewpoint is 1e15 away": (random_values(20, 3), (1e15 * RANDOM_VIEWPOINT).float().double()),
    "1e-6 away": ((1e-6 * random_values(20, 3)).float().double(), torch.zeros(3).double()),
    "1e-10 away": ((1e-10 * random_values(20, 3)).float().double(), torch.zeros(3).double()),
}


def encode_in_numpy(points: np.ndarray, viewpoint: np.ndarray, encoding: str) -> np.ndarray:
    """Compute both encodings in numpy, number by number."""
    rows = []
    for point in points - viewpoint:
        x, y, z = direction = point / (np.linalg.norm(point) or 1.0)
        if encoding == "frequency":
            phases = [2**octave * np.pi * number for octave in range(4) for number in direction]
            rows.append([*np.sin(phases), *np.cos(phases)])
            continue
        first, second = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
        zonal = np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1)
        bands = [np.sqrt(1 / (4 * np.pi)), first * y, first * z, first * x]
        rows.append([*bands, second * x * y, second * y * z, zonal, second * x * z, second / 2 * (x * x - y * y)])
    return np.array(rows).reshape(len(points), DIRECTION_FEATURES[encoding])


def place_float32(tensor: Tensor, implementation: str) -> Tensor:
    """Return the tensor in float32 on the device of this implementation."""
    return gpu(tensor.float()) if implementation == "gpu" else tensor.float()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
@pytest.mark.parametrize("case", POINTS_AND_VIEWPOINTS)
def test_encodings_match_the_formulas(case: str, encoding: str, implementation: str) -> None:
    points, viewpoint = POINTS_AND_VIEWPOINTS[case]

    there = place_float32(points, implementation), place_float32(viewpoint, implementation)
    encoded = encode_views(*there, encoding, implementation=implementation)

    assert encoded.shape == (len(points), DIRECTION_FEATURES[encoding]) and encoded.dtype == torch.float32
    expected = encode_in_numpy(points.numpy(), viewpoint.numpy(), encoding)
    # A direction is rounded by a few 2^-24 a coordinate, and the last octave multiplies this by 8 pi. "cpu" rounds only
    # the results.
    tolerance = 1e-7 if implementation == "cpu" else 2e-5 if encoding == "frequency" else 1e-6
    np.testing.assert_allclose(encoded.cpu().numpy(), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_the_reference_is_exact_in_float64(encoding: str) -> None:
    points, viewpoint = POINTS_AND_VIEWPOINTS["127"]
    expected = encode_in_numpy(points.numpy(), viewpoint.numpy(), encoding)
    np.testing.assert_allclose(encode_views(points, viewpoint, encoding).numpy(), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_the_reference_passes_gradcheck(encoding: str) -> None:
    leaves = random_values(3, 3).requires_grad_(), RANDOM_VIEWPOINT.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda *leaves: encode_views(*leaves, encoding), leaves)


@needs_triton
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_the_kernel_stores_columns(encoding: str) -> None:
    encoded = encode_views(
        place_float32(random_values(9, 3), "gpu"),
        place_float32(RANDOM_VIEWPOINT, "gpu"),
        encoding,
        implementation="gpu",
    )
    assert encoded.stride() == (1, 9)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_memory_layouts_have_no_effect(encoding: str, implementation: str) -> None:
    points, viewpoint = (
        place_float32(random_values(8, 3), implementation),
        place_float32(RANDOM_VIEWPOINT, implementation),
    )
    expected = encode_views(points, viewpoint, encoding, implementation=implementation)
    spread = points.T.contiguous().T, viewpoint.repeat_interleave(2)[::2]
    found = encode_views(*spread, encoding, implementation=implementation)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_nan_inputs_give_nan_outputs(axis: int, encoding: str, implementation: str) -> None:
    points = random_values(4, 3)
    points[2, axis] = float("nan")
    encoded = encode_views(
        place_float32(points, implementation),
        place_float32(RANDOM_VIEWPOINT, implementation),
        encoding,
        implementation=implementation,
    )
    assert encoded.isnan().any(1).tolist() == [False, False, True, False]


@needs_triton
@pytest.mark.parametrize("learnt", [0, 1])
def test_the_kernel_is_not_used_where_a_gradient_is_needed(learnt: int) -> None:
    leaves = [place_float32(random_values(4, 3), "gpu"), place_float32(RANDOM_VIEWPOINT, "gpu")]
    leaves[learnt].requires_grad_()
    with pytest.raises(ValueError, match="no implementation 'gpu'"):
        encode_views(*leaves, "sh", implementation="gpu")
    encode_views(*leaves, "sh").sum().backward()
    assert leaves[learnt].grad.any()
    with torch.no_grad():
        assert not encode_views(*leaves, "sh", implementation="gpu").requires_grad


def test_unsupported_types_and_implementations_are_rejected() -> None:
    points = random_values(4, 3)
    with pytest.raises(ValueError, match="tensors disagree"):
        encode_views(points, RANDOM_VIEWPOINT.float(), "sh")
    with pytest.raises(ValueError, match="float32"):
        encode_views(points, RANDOM_VIEWPOINT, "sh", implementation="gpu")
    with pytest.raises(ValueError, match="no implementation 'cpu'"):
        encode_views(points.float(), points.float(), "sh", implementation="cpu")


@pytest.mark.parametrize(
    ("points", "viewpoint", "encoding"), [((4, 3), (3,), "none"), ((4, 2), (3,), "sh"), ((4, 3), (5, 3), "sh")]
)
def test_inputs_that_do_not_match_are_rejected(points: tuple, viewpoint: tuple, encoding: str) -> None:
    with pytest.raises(ValueError, match="encoding '"):
        encode_views(torch.zeros(points), torch.zeros(viewpoint), encoding)


def test_each_point_may_have_its_own_viewpoint() -> None:
    points, places = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0))
    found = encode_views(points, places, "sh")
    expected = torch.cat([encode_views(points[i : i + 1], places[i], "sh") for i in range(5)])
    torch.testing.assert_close(found, expected)
