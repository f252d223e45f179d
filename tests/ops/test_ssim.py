"""ssim and photometric_loss: every implementation against the reference in float64, the reference against skimage."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from hyrfpack.ops.ssim import photometric_loss, ssim
from hyrfpack.parallel import has_numba

IMPLEMENTATIONS = ["reference", pytest.param("cpu", marks=pytest.mark.skipif(not has_numba(), reason="no numba"))]


def photo(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Smooth waves of colour and some noise, in [0, 1]."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    waves = torch.stack([torch.sin(0.11 * x + seed), torch.cos(0.07 * y), torch.sin(0.05 * (x + y))], dim=-1)
    noise = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(seed))
    return (0.5 + 0.3 * waves + 0.08 * noise).clamp(0, 1)


# name -> (image, target)
CASES = {
    "two pictures": (photo(120, 90), photo(120, 90, seed=1)),
    "several strips and tiles": (photo(300, 520), photo(300, 520, seed=1)),
    "one pixel": (photo(1, 1), photo(1, 1, seed=1)),
    "narrower than the window": (photo(17, 3), photo(17, 3, seed=1)),
    "one row": (photo(1, 40), photo(1, 40, seed=1)),
    "constant": (torch.full((30, 40, 3), 0.3), torch.full((30, 40, 3), 0.8)),
    "black against a picture": (torch.zeros(30, 40, 3), photo(30, 40)),
    "black against black": (torch.zeros(30, 40, 3), torch.zeros(30, 40, 3)),
    "bright and nearly flat": (1 - 0.002 * photo(64, 64), 1 - 0.002 * photo(64, 64, seed=1)),
}
MASKS = {
    "no mask": lambda shape: None,
    "some pixels": lambda shape: torch.rand(shape, generator=torch.Generator().manual_seed(5)) < 0.6,
    "left half": lambda shape: (torch.arange(shape[1]) < (shape[1] + 1) // 2).expand(shape),
    "every pixel": lambda shape: torch.ones(shape, dtype=torch.bool),
    "none": lambda shape: torch.zeros(shape, dtype=torch.bool),
}


def value_and_gradient(loss, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    image = image.clone().requires_grad_()
    value = loss(image)
    return value.detach().double(), torch.autograd.grad(value, image)[0].double()


def assert_same(actual: tuple[torch.Tensor, torch.Tensor], expected: tuple[torch.Tensor, torch.Tensor]) -> None:
    torch.testing.assert_close(actual[0], expected[0], rtol=1e-4, atol=1e-5)
    scale = expected[1].abs().max().item()
    torch.testing.assert_close(actual[1], expected[1], rtol=0, atol=1e-3 * scale + 1e-9)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("case", CASES)
def test_ssim_matches_the_float64_reference(implementation: str, case: str) -> None:
    image, target = CASES[case]
    actual = value_and_gradient(lambda x: ssim(x, target, implementation=implementation), image)
    assert_same(actual, value_and_gradient(lambda x: ssim(x, target.double()), image.double()))


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("case", ["two pictures", "several strips and tiles", "narrower than the window", "one pixel"])
def test_photometric_loss_matches_the_float64_reference(implementation: str, mask: str, case: str) -> None:
    image, target = CASES[case]
    chosen = MASKS[mask](image.shape[:2])
    actual = value_and_gradient(lambda x: photometric_loss(x, target, chosen, implementation=implementation), image)
    assert_same(actual, value_and_gradient(lambda x: photometric_loss(x, target.double(), chosen), image.double()))


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_ssim_is_that_of_scikit_image_on_a_black_ground(implementation: str) -> None:
    image, target = photo(60, 80), photo(60, 80, seed=1)
    ground = [np.pad(picture.double().numpy(), ((10, 10), (10, 10), (0, 0))) for picture in (image, target)]
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, expected = structural_similarity(*ground, channel_axis=2, full=True, **settings)
    assert ssim(image, target, implementation=implementation).item() == pytest.approx(
        expected[10:-10, 10:-10].mean(), abs=1e-6
    )


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_loss_without_ssim_is_the_mean_absolute_difference_of_what_counts(implementation: str) -> None:
    image, target = photo(40, 50), photo(40, 50, seed=1)
    mask = MASKS["some pixels"]((40, 50))
    loss = photometric_loss(image, target, mask, ssim_weight=0.0, implementation=implementation)
    assert loss.item() == pytest.approx((image - target).abs()[mask].double().mean().item(), abs=1e-6)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_equal_pictures_have_ssim_one_no_loss_and_no_gradient(implementation: str) -> None:
    image = photo(40, 50).requires_grad_()
    loss = photometric_loss(image, image.detach().clone(), implementation=implementation)
    loss.backward()
    assert ssim(image, image.detach(), implementation=implementation).item() == pytest.approx(1, abs=1e-6)
    assert abs(loss.item()) < 1e-6
    assert image.grad.abs().max() < 1e-8


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_masked_out_pixels_give_neither_value_nor_gradient(implementation: str) -> None:
    image, target, mask = photo(40, 50), photo(40, 50, seed=1), MASKS["left half"]((40, 50))
    spoiled = torch.where(mask[..., None], image, torch.tensor(float("nan")))

    def loss(x: torch.Tensor) -> torch.Tensor:
        return photometric_loss(x, target, mask, implementation=implementation)

    value, gradient = value_and_gradient(loss, spoiled)
    expected, _ = value_and_gradient(loss, image)
    assert value == expected
    assert not gradient[~mask].any()
    assert gradient[mask].all() and gradient.isfinite().all()


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_nothing_counting_gives_zero(implementation: str) -> None:
    image, target, mask = photo(20, 30), photo(20, 30, seed=1), MASKS["none"]((20, 30))
    value, gradient = value_and_gradient(
        lambda x: photometric_loss(x, target, mask, implementation=implementation), image
    )
    assert value == 0
    assert not gradient.any()


def test_reference_passes_gradcheck() -> None:
    image, target = photo(7, 6).double().requires_grad_(), photo(7, 6, seed=1).double()
    mask = MASKS["some pixels"]((7, 6))
    assert torch.autograd.gradcheck(lambda x: ssim(x, target), image)
    assert torch.autograd.gradcheck(lambda x: photometric_loss(x, target, mask), image)


@pytest.mark.skipif(not has_numba(), reason="no numba")
def test_bytes_do_not_depend_on_threads_or_on_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    image, target = CASES["several strips and tiles"]

    def run() -> list[bytes]:
        return [t.numpy().tobytes() for t in value_and_gradient(lambda x: photometric_loss(x, target), image)]

    monkeypatch.setenv("HYRFPACK_THREADS", "1")
    alone = run()
    monkeypatch.setenv("HYRFPACK_THREADS", "2")
    assert run() == alone
    assert run() == alone


@pytest.mark.parametrize(
    ("image", "target", "mask"),
    [
        ((5, 4, 3), (5, 5, 3), None),
        ((5, 4, 4), (5, 4, 4), None),
        ((0, 4, 3), (0, 4, 3), None),
        ((5, 4, 3), (5, 4, 3), (4, 5)),
    ],
    ids=["unequal", "four channels", "empty", "mask turned"],
)
def test_refuses_what_does_not_fit(image: tuple, target: tuple, mask: tuple | None) -> None:
    chosen = None if mask is None else torch.ones(mask, dtype=torch.bool)
    with pytest.raises(ValueError):
        photometric_loss(torch.rand(image), torch.rand(target), chosen)
