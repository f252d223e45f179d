"""encode_views: every implementation against directions normalised in float64 and their encodings as written."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from ops.device import gpu, needs_triton
from torch import Tensor

from hyrfpack.ops.shade import DIRECTION_FEATURES, encode_views

IMPLEMENTATIONS = ["reference", pytest.param("gpu", marks=needs_triton)]


def made(*shape: int, seed: int = 0) -> Tensor:
    """Numbers that float32 holds, in float64."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


AXES = torch.cat([torch.eye(3), -torch.eye(3)]).double()
VIEWPOINT = made(3, seed=1)
# name -> (points, viewpoint)
CASES = {
    "none": (made(0, 3), VIEWPOINT),
    "one": (made(1, 3), VIEWPOINT),
    "127": (made(127, 3), VIEWPOINT),
    "a block": (made(128, 3), VIEWPOINT),
    "a block and one more": (made(129, 3), VIEWPOINT),
    "at the viewpoint": (VIEWPOINT.expand(5, 3), VIEWPOINT),
    "along the axes": (AXES, torch.zeros(3).double()),
    "diagonals": (torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).double(), torch.zeros(3).double()),
    "1e4 away": (1e4 * made(20, 3), VIEWPOINT),
    "1e15 away": ((1e15 * made(20, 3)).float().double(), VIEWPOINT),
    "the viewpoint is 1e15 away": (made(20, 3), (1e15 * VIEWPOINT).float().double()),
    "1e-6 away": ((1e-6 * made(20, 3)).float().double(), torch.zeros(3).double()),
    "1e-10 away": ((1e-10 * made(20, 3)).float().double(), torch.zeros(3).double()),
}


def written_out(points: np.ndarray, viewpoint: np.ndarray, encoding: str) -> np.ndarray:
    """Both encodings in numpy, number by number."""
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


def placed(tensor: Tensor, implementation: str) -> Tensor:
    """In float32, where this implementation takes it."""
    return gpu(tensor.float()) if implementation == "gpu" else tensor.float()


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
@pytest.mark.parametrize("case", CASES)
def test_encodings_are_those_of_the_formulas(case: str, encoding: str, implementation: str) -> None:
    points, viewpoint = CASES[case]

    there = placed(points, implementation), placed(viewpoint, implementation)
    encoded = encode_views(*there, encoding, implementation=implementation)

    assert encoded.shape == (len(points), DIRECTION_FEATURES[encoding]) and encoded.dtype == torch.float32
    expected = written_out(points.numpy(), viewpoint.numpy(), encoding)
    # A direction is rounded, a few 2^-24 a number, and the last octave turns by 8 pi of it.
    np.testing.assert_allclose(encoded.cpu().numpy(), expected, rtol=0, atol=2e-5 if encoding == "frequency" else 1e-6)


@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_the_reference_is_exact_in_float64(encoding: str) -> None:
    points, viewpoint = CASES["127"]
    expected = written_out(points.numpy(), viewpoint.numpy(), encoding)
    np.testing.assert_allclose(encode_views(points, viewpoint, encoding).numpy(), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_the_reference_passes_gradcheck(encoding: str) -> None:
    leaves = made(3, 3).requires_grad_(), VIEWPOINT.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda *leaves: encode_views(*leaves, encoding), leaves)


@needs_triton
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_the_kernel_stores_by_columns(encoding: str) -> None:
    encoded = encode_views(placed(made(9, 3), "gpu"), placed(VIEWPOINT, "gpu"), encoding, implementation="gpu")
    assert encoded.stride() == (1, 9)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
def test_layouts_do_not_matter(encoding: str, implementation: str) -> None:
    points, viewpoint = placed(made(8, 3), implementation), placed(VIEWPOINT, implementation)
    expected = encode_views(points, viewpoint, encoding, implementation=implementation)
    spread = points.T.contiguous().T, viewpoint.repeat_interleave(2)[::2]
    found = encode_views(*spread, encoding, implementation=implementation)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("encoding", DIRECTION_FEATURES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_is_not_a_number_shows(axis: int, encoding: str, implementation: str) -> None:
    points = made(4, 3)
    points[2, axis] = float("nan")
    encoded = encode_views(
        placed(points, implementation), placed(VIEWPOINT, implementation), encoding, implementation=implementation
    )
    assert encoded.isnan().any(1).tolist() == [False, False, True, False]


@needs_triton
@pytest.mark.parametrize("learnt", [0, 1])
def test_the_kernel_is_not_taken_where_a_gradient_is_wanted(learnt: int) -> None:
    leaves = [placed(made(4, 3), "gpu"), placed(VIEWPOINT, "gpu")]
    leaves[learnt].requires_grad_()
    with pytest.raises(ValueError, match="no implementation 'gpu'"):
        encode_views(*leaves, "sh", implementation="gpu")
    encode_views(*leaves, "sh").sum().backward()
    assert leaves[learnt].grad.any()
    with torch.no_grad():
        assert not encode_views(*leaves, "sh", implementation="gpu").requires_grad


def test_types_and_implementations_that_do_not_fit_are_rejected() -> None:
    points = made(4, 3)
    with pytest.raises(ValueError, match="tensors disagree"):
        encode_views(points, VIEWPOINT.float(), "sh")
    with pytest.raises(ValueError, match="float32"):
        encode_views(points, VIEWPOINT, "sh", implementation="gpu")
    with pytest.raises(ValueError, match="no implementation 'cpu'"):
        encode_views(points.float(), VIEWPOINT.float(), "sh", implementation="cpu")


@pytest.mark.parametrize(
    ("points", "viewpoint", "encoding"), [((4, 3), (3,), "none"), ((4, 2), (3,), "sh"), ((4, 3), (5, 3), "sh")]
)
def test_what_does_not_fit_together_is_rejected(points: tuple, viewpoint: tuple, encoding: str) -> None:
    with pytest.raises(ValueError, match="encoding '"):
        encode_views(torch.zeros(points), torch.zeros(viewpoint), encoding)


def test_each_point_may_be_seen_from_a_place_of_its_own() -> None:
    points, places = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0))
    found = encode_views(points, places, "sh")
    expected = torch.cat([encode_views(points[i : i + 1], places[i], "sh") for i in range(5)])
    torch.testing.assert_close(found, expected)
