"""ssim and photometric_loss: every implementation against the reference in float64, the reference against skimage."""

from __future__ import annotations

from functools import partial
from itertools import product

import numpy as np
import pytest
import torch
from ops.device import IS_INTERPRETED, gpu, needs_triton, pair_with_implementations
from skimage.metrics import structural_similarity

from hyrfpack.ops.dispatch import has_triton
from hyrfpack.ops.ssim import photometric_loss, ssim
from hyrfpack.parallel import has_numba

TESTED_IMPLEMENTATIONS = [
    "reference",
    pytest.param("cpu", marks=pytest.mark.skipif(not has_numba(), reason="no numba")),
    pytest.param("gpu", marks=needs_triton),
]


def make_photo(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Return a picture of smooth colour waves and some noise, in [0, 1]."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    waves = torch.stack([torch.sin(0.11 * x + seed), torch.cos(0.07 * y), torch.sin(0.05 * (x + y))], dim=-1)
    noise = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(seed))
    return (0.5 + 0.3 * waves + 0.08 * noise).clamp(0, 1)


# Name -> (image, target).
PICTURE_PAIRS = {
    "two pictures": (make_photo(120, 90), make_photo(120, 90, seed=1)),
    "several strips and tiles": (make_photo(258, 474), make_photo(258, 474, seed=1)),
    "two strips and tiles": (make_photo(140, 250), make_photo(140, 250, seed=1)),
    "one pixel": (make_photo(1, 1), make_photo(1, 1, seed=1)),
    "narrower than the window": (make_photo(17, 3), make_photo(17, 3, seed=1)),
    "one row": (make_photo(1, 60), make_photo(1, 60, seed=1)),
    "constant": (torch.full((30, 40, 3), 0.3), torch.full((30, 40, 3), 0.8)),
    "black against a picture": (torch.zeros(30, 40, 3), make_photo(30, 40)),
    "black against black": (torch.zeros(30, 40, 3), torch.zeros(30, 40, 3)),
    "bright and nearly flat": (1 - 0.002 * make_photo(64, 64), 1 - 0.002 * make_photo(64, 64, seed=1)),
}
MASK_MAKERS = {
    "no mask": lambda shape: None,
    "some pixels": lambda shape: torch.rand(shape, generator=torch.Generator().manual_seed(5)) < 0.6,
    "left half": lambda shape: (torch.arange(shape[1]) < (shape[1] + 1) // 2).expand(shape),
    "every pixel": lambda shape: torch.ones(shape, dtype=torch.bool),
    "none": lambda shape: torch.zeros(shape, dtype=torch.bool),
}


@pytest.fixture(autouse=True)
def small_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give a program of the interpreter, which is slow, 8 rows of 64 numbers. Small pictures then need several."""
    if IS_INTERPRETED and has_triton():
        monkeypatch.setattr("hyrfpack.ops.ssim.gpu._ROWS_PER_STRIP", 8)
        monkeypatch.setattr("hyrfpack.ops.ssim.gpu._COLUMNS_PER_PROGRAM", 64)


def crop_for_interpreter(
    implementation: str, *pictures: torch.Tensor, size: tuple[int, int] = (8, 12)
) -> list[torch.Tensor]:
    """Return the pictures, or for the interpreter, which is slow, their corners."""
    if implementation == "gpu" and IS_INTERPRETED:
        return [picture[: size[0], : size[1]] for picture in pictures]
    return list(pictures)


def case_for(implementation: str, name: str) -> list[torch.Tensor]:
    # The first of these corners has three strips and two blocks of columns, the second two of each.
    sizes = {"several strips and tiles": (19, 24), "two strips and tiles": (13, 24), "one row": (1, 60)}
    return crop_for_interpreter(implementation, *PICTURE_PAIRS[name], size=sizes.get(name, (8, 12)))


def value_and_gradient(loss, implementation: str, image: torch.Tensor, *others: torch.Tensor | None) -> tuple:
    """Return a loss of pictures and its gradient by the first one, in float64."""
    image = image.clone().requires_grad_()
    pictures = [image, *others]
    if implementation == "gpu":
        pictures = [None if picture is None else gpu(picture) for picture in pictures]
    value = loss(*pictures, implementation=implementation)
    return value.detach().cpu().double(), torch.autograd.grad(value, pictures[0])[0].cpu().double()


def reference_value_and_gradient(
    loss, image: torch.Tensor, target: torch.Tensor, *others: torch.Tensor | None
) -> tuple:
    return value_and_gradient(loss, "reference", image.double(), target.double(), *others)


def assert_same(actual: tuple[torch.Tensor, torch.Tensor], expected: tuple[torch.Tensor, torch.Tensor]) -> None:
    torch.testing.assert_close(actual[0], expected[0], rtol=1e-4, atol=1e-5)
    scale = expected[1].abs().max().item()
    torch.testing.assert_close(actual[1], expected[1], rtol=0, atol=1e-3 * scale + 1e-9)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("case", [case for case in PICTURE_PAIRS if case != "two strips and tiles"])
def test_ssim_matches_the_float64_reference(implementation: str, case: str) -> None:
    pictures = case_for(implementation, case)
    assert_same(value_and_gradient(ssim, implementation, *pictures), reference_value_and_gradient(ssim, *pictures))


MASKED_CASES = [
    *(("two pictures", mask) for mask in MASK_MAKERS),
    *product(("two strips and tiles", "narrower than the window", "one pixel"), ("no mask", "some pixels")),
]
# Other cases run the same branches of the GPU kernels.
SIMILAR_MASKED_CASES = [
    ("two strips and tiles", "no mask"),
    ("two pictures", "some pixels"),
    ("two pictures", "every pixel"),
    ("narrower than the window", "no mask"),
]


@pytest.mark.parametrize(
    ("implementation", "masked_case"),
    pair_with_implementations(MASKED_CASES, SIMILAR_MASKED_CASES, TESTED_IMPLEMENTATIONS),
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else None,
)
def test_photometric_loss_matches_the_float64_reference(implementation: str, masked_case: tuple[str, str]) -> None:
    case, mask = masked_case
    pictures = case_for(implementation, case)
    chosen = MASK_MAKERS[mask](pictures[0].shape[:2])
    actual = value_and_gradient(photometric_loss, implementation, *pictures, chosen)
    assert_same(actual, reference_value_and_gradient(photometric_loss, *pictures, chosen))


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_ssim_matches_scikit_image_with_black_padding(implementation: str) -> None:
    pictures = crop_for_interpreter(implementation, make_photo(60, 80), make_photo(60, 80, seed=1))
    ground = [np.pad(picture.double().numpy(), ((10, 10), (10, 10), (0, 0))) for picture in pictures]
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, expected = structural_similarity(*ground, channel_axis=2, full=True, **settings)
    value, _ = value_and_gradient(ssim, implementation, *pictures)
    assert value.item() == pytest.approx(expected[10:-10, 10:-10].mean(), abs=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_loss_without_ssim_is_the_mean_absolute_difference_of_unmasked_pixels(implementation: str) -> None:
    image, target = crop_for_interpreter(implementation, make_photo(40, 50), make_photo(40, 50, seed=1))
    mask = MASK_MAKERS["some pixels"](image.shape[:2])
    loss = partial(photometric_loss, ssim_weight=0.0)
    value, _ = value_and_gradient(loss, implementation, image, target, mask)
    assert value.item() == pytest.approx((image - target).abs()[mask].double().mean().item(), abs=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_equal_pictures_have_ssim_one_no_loss_and_no_gradient(implementation: str) -> None:
    (image,) = crop_for_interpreter(implementation, make_photo(40, 50))
    loss, gradient = value_and_gradient(photometric_loss, implementation, image, image)
    similarity, _ = value_and_gradient(ssim, implementation, image, image)
    assert similarity.item() == pytest.approx(1, abs=1e-6)
    assert abs(loss.item()) < 1e-6
    assert gradient.abs().max() < 5e-5 / image.numel()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_masked_pixels_give_neither_loss_nor_gradient(implementation: str) -> None:
    image, target = crop_for_interpreter(implementation, make_photo(40, 50), make_photo(40, 50, seed=1))
    mask = MASK_MAKERS["left half"](image.shape[:2])
    spoiled = torch.where(mask[..., None], image, torch.tensor(float("nan")))

    value, gradient = value_and_gradient(photometric_loss, implementation, spoiled, target, mask)
    expected, _ = value_and_gradient(photometric_loss, implementation, image, target, mask)
    assert value == expected
    assert not gradient[~mask].any()
    assert gradient[mask].all() and gradient.isfinite().all()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_a_completely_masked_picture_has_zero_loss(implementation: str) -> None:
    image, target = crop_for_interpreter(implementation, make_photo(20, 30), make_photo(20, 30, seed=1))
    mask = MASK_MAKERS["none"](image.shape[:2])
    value, gradient = value_and_gradient(photometric_loss, implementation, image, target, mask)
    assert value == 0
    assert not gradient.any()


@pytest.mark.skipif(not has_numba(), reason="no numba")
@pytest.mark.parametrize("mask", ["no mask", "some pixels"])
@pytest.mark.parametrize("case", PICTURE_PAIRS)
def test_the_value_is_the_same_without_a_gradient_which_is_then_not_computed(
    case: str, mask: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hyrfpack.ops.ssim import cpu

    results = []

    def note(*arguments: object) -> tuple[float, np.ndarray]:
        results.append(compute(*arguments))
        return results[-1]

    compute = cpu.loss_and_gradient
    monkeypatch.setattr(cpu, "loss_and_gradient", note)
    image, target = PICTURE_PAIRS[case]
    chosen = MASK_MAKERS[mask](image.shape[:2])

    value = photometric_loss(image, target, chosen, implementation="cpu")
    with_gradient = photometric_loss(image.clone().requires_grad_(), target, chosen, implementation="cpu")

    assert value.item() == with_gradient.item()
    assert [len(gradient) for _, gradient in results] == [0, len(image)]


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_the_gradient_is_scaled_by_the_upstream_gradient(implementation: str) -> None:
    pictures = crop_for_interpreter(implementation, make_photo(40, 50), make_photo(40, 50, seed=1))

    def curved(*pictures: torch.Tensor, implementation: str) -> torch.Tensor:
        return -3 * photometric_loss(*pictures, implementation=implementation) ** 2

    assert_same(value_and_gradient(curved, implementation, *pictures), reference_value_and_gradient(curved, *pictures))


@pytest.mark.gpu
@pytest.mark.skipif(IS_INTERPRETED, reason="no GPU to wait for")
def test_the_host_never_waits_for_the_gpu() -> None:
    image, target = gpu(make_photo(40, 50).requires_grad_()), gpu(make_photo(40, 50, seed=1))
    mask = gpu(MASK_MAKERS["some pixels"]((40, 50)))
    photometric_loss(image, target, mask).backward()  # compiles the kernels
    torch.cuda.set_sync_debug_mode("error")
    try:
        photometric_loss(image, target, mask).backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_reference_passes_gradcheck() -> None:
    image, target = make_photo(7, 6).double().requires_grad_(), make_photo(7, 6, seed=1).double()
    mask = MASK_MAKERS["some pixels"]((7, 6))
    assert torch.autograd.gradcheck(lambda x: ssim(x, target), image)
    assert torch.autograd.gradcheck(lambda x: photometric_loss(x, target, mask), image)


@pytest.mark.skipif(not has_numba(), reason="no numba")
def test_bytes_do_not_depend_on_threads_or_on_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    image, target = PICTURE_PAIRS["several strips and tiles"]

    def run() -> list[bytes]:
        return [t.numpy().tobytes() for t in value_and_gradient(photometric_loss, "cpu", image, target)]

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
def test_inputs_that_do_not_fit_are_rejected(image: tuple, target: tuple, mask: tuple | None) -> None:
    chosen = None if mask is None else torch.ones(mask, dtype=torch.bool)
    with pytest.raises(ValueError):
        photometric_loss(torch.rand(image), torch.rand(target), chosen)
