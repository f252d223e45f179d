from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import skimage.metrics
import torch
from layers import only_in_acceptance
from PIL import Image
from scenes import ball_points, ball_scene, small_model
from scipy.ndimage import gaussian_filter
from torch import nn

from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.evaluate.figures import (
    ERROR_LIMIT,
    draw_comparison,
    draw_contact_sheet,
    draw_training_curve,
    split_comparison,
)
from hyrfpack.evaluate.lpips import LPIPS
from hyrfpack.evaluate.metrics import provenance_mse, psnr, ssim, to_8bit
from hyrfpack.measure.psnr import IDENTICAL_PSNR
from hyrfpack.render.files import render_files
from hyrfpack.scene import Picture, View


def noisy_and_smooth_pictures(height: int = 40, width: int = 52, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = np.random.default_rng(seed)
    smooth = gaussian_filter(generator.random((height, width, 3)), (3, 3, 0))
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    noisy = np.clip(smooth + generator.normal(0, 0.05, smooth.shape), 0, 1)
    return torch.from_numpy(noisy).float(), torch.from_numpy(smooth).float()


def ball_model(**settings):
    points, colors = ball_points(150)
    return small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, scale_logits=-2.5, **settings)


def reference_ssim_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute SSIM as printed in Wang et al. 2004, by scipy's Gaussian filter cut at 5 pixels, with black outside."""

    def mean(values):
        return gaussian_filter(values, (1.5, 1.5, 0), mode="constant", radius=(5, 5, 0))

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    return (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))


# -- PSNR and SSIM ---------------------------------------------------------------------------------------------------


def test_psnr_is_pooled_over_pixels_and_channels_as_in_skimage():
    image, reference = noisy_and_smooth_pictures()
    expected = skimage.metrics.peak_signal_noise_ratio(reference.numpy(), image.numpy(), data_range=1)
    assert psnr(image, reference) == pytest.approx(expected, abs=1e-5)


def test_psnr_ignores_masked_pixels():
    image, reference = noisy_and_smooth_pictures()
    mask = torch.zeros(image.shape[:2], dtype=torch.bool)
    mask[5:20, 7:30] = True
    broken = torch.where(mask[..., None], image, 1 - reference)
    expected = -10 * np.log10(np.mean((image - reference).double().numpy()[5:20, 7:30] ** 2))
    assert psnr(broken, reference, mask) == pytest.approx(expected, abs=1e-5)


def test_equal_pictures_have_a_finite_psnr():
    image, _ = noisy_and_smooth_pictures()
    assert psnr(image, image) == IDENTICAL_PSNR


def test_ssim_equals_the_definition():
    image, reference = noisy_and_smooth_pictures()
    expected = reference_ssim_map(image.double().numpy(), reference.double().numpy()).mean()
    assert ssim(image, reference) == pytest.approx(expected, abs=1e-5)


def test_masked_ssim_ignores_renders_under_the_mask():
    image, reference = noisy_and_smooth_pictures()
    mask = torch.ones(image.shape[:2], dtype=torch.bool)
    mask[10:30, 10:30] = False
    x = np.where(mask[..., None], image.double(), reference.double())
    expected = reference_ssim_map(x, reference.double().numpy())[mask.numpy()].mean()
    assert ssim(image, reference, mask) == pytest.approx(expected, abs=1e-5)
    assert ssim(torch.where(mask[..., None], image, 7.0), reference, mask) == pytest.approx(expected, abs=1e-5)


def test_renders_are_rounded_to_8_bits():
    values = torch.tensor([-0.5, 0.0, 0.4999 / 255, 0.5001 / 255, 1.0, 1.7])
    np.testing.assert_array_equal((to_8bit(values) * 255).numpy(), [0, 0, 0, 1, 255, 255])


# -- LPIPS -----------------------------------------------------------------------------------------------------------


def convolution(inputs: int, outputs: int, kernel: int = 3, **options) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel, **{"padding": kernel // 2, **options})


def alexnet_layers() -> tuple[list[nn.Module], list[int]]:
    """Return torchvision's AlexNet feature layers and the indices where its five stages end."""
    layers = [convolution(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    layers += [convolution(64, 192, 5), nn.ReLU(), nn.MaxPool2d(3, 2), convolution(192, 384), nn.ReLU()]
    layers += [convolution(384, 256), nn.ReLU(), convolution(256, 256), nn.ReLU()]
    return layers, [2, 5, 8, 10, 12]


def vgg_layers() -> tuple[list[nn.Module], list[int]]:
    """Return torchvision's VGG-16 layers up to the last ReLU, and the indices where its five stages end."""
    layers: list[nn.Module] = []
    ends, width = [], 3
    for stage, (channels, count) in enumerate(zip((64, 128, 256, 512, 512), (2, 2, 3, 3, 3), strict=True)):
        if stage:
            layers.append(nn.MaxPool2d(2, 2))
        for _ in range(count):
            layers += [convolution(width, channels), nn.ReLU()]
            width = channels
        ends.append(len(layers))
    return layers, ends


class ReferenceLPIPS(nn.Module):
    """The published LPIPS method built from torch modules, with the weight names of the lpips package."""

    def __init__(self, layers: list[nn.Module], ends: list[int]) -> None:
        super().__init__()
        self.net = nn.Module()
        self.scaling_layer = nn.Module()
        self.scaling_layer.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None])
        self.scaling_layer.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[None, :, None, None])
        self.slices, start = [], 0
        for number, end in enumerate(ends):
            part = nn.Sequential()
            for layer in range(start, end):
                part.add_module(str(layer), layers[layer])
            setattr(self.net, f"slice{number + 1}", part)
            width = [layer for layer in layers[:end] if isinstance(layer, nn.Conv2d)][-1].out_channels
            linear = nn.Module()
            linear.model = nn.Sequential(nn.Dropout(), nn.Conv2d(width, 1, 1, bias=False))
            linear.model[1].weight.data.abs_()
            setattr(self, f"lin{number}", linear)
            start = end

    @torch.no_grad()
    def forward(self, image: torch.Tensor, reference: torch.Tensor) -> float:
        total = 0.0
        f, g = (
            ((2 * x - 1).permute(2, 0, 1)[None] - self.scaling_layer.shift) / self.scaling_layer.scale
            for x in (image, reference)
        )
        for number in range(5):
            part = getattr(self.net, f"slice{number + 1}")
            f, g = part(f), part(g)
            a = f / (f.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)
            b = g / (g.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)
            weights = getattr(self, f"lin{number}").model[1].weight[0, :, 0, 0]
            total += float(((a - b) ** 2 * weights[None, :, None, None]).sum(1).mean())
        return total


def lpips_network(name: str) -> ReferenceLPIPS:
    torch.manual_seed(3)
    return ReferenceLPIPS(*(alexnet_layers() if name == "alex" else vgg_layers())).eval()


@pytest.mark.parametrize("name", only_in_acceptance(["alex", "vgg"], ["vgg"]))
def test_lpips_equals_the_straightforward_computation(name, tmp_path):
    network = lpips_network(name)
    torch.save(network.state_dict(), tmp_path / "weights.pt")
    image, reference = noisy_and_smooth_pictures(64, 75)
    distance = LPIPS.load(tmp_path / "weights.pt")
    assert distance.name == name
    assert distance(image, reference) == pytest.approx(network(image, reference), rel=1e-4)
    assert distance(reference, reference) == 0


@pytest.mark.parametrize(("name", "side"), [("alex", 31), ("vgg", 16)])
def test_lpips_takes_the_smallest_picture_and_rejects_a_smaller_one(name, side):
    distance = LPIPS(lpips_network(name).state_dict())
    assert np.isfinite(distance(torch.zeros(side, side, 3), torch.ones(side, side, 3)))
    with pytest.raises(HyrfError, match="pixels a side"):
        distance(torch.zeros(side - 1, 99, 3), torch.ones(side - 1, 99, 3))


class CodeOnUnpickling:
    def __reduce__(self):
        return print, ("executed",)


def broken_weights(kind: str):
    state = lpips_network("alex").state_dict()
    if kind == "a layer is missing":
        del state["net.slice3.6.bias"]
    elif kind == "a layer has another shape":
        state["lin2.model.1.weight"] = torch.zeros(1, 17, 1, 1)
    elif kind == "another network":
        state["net.slice1.0.weight"] = torch.zeros(64, 3, 5, 5)
    elif kind == "code":
        state["net.slice1.0.weight"] = CodeOnUnpickling()
    elif kind == "a list":
        return [1, 2, 3]
    return state


@pytest.mark.parametrize(
    "kind", ["a layer is missing", "a layer has another shape", "another network", "code", "a list"]
)
def test_lpips_rejects_other_files_and_executes_nothing(kind, tmp_path, capsys):
    torch.save(broken_weights(kind), tmp_path / "weights.pt")
    with pytest.raises(HyrfError, match="these are not LPIPS weights") as refusal:
        LPIPS.load(tmp_path / "weights.pt")
    assert "executed" not in capsys.readouterr().out
    assert len(str(refusal.value).replace(str(tmp_path), "")) < 200 and "trust" not in str(refusal.value)


@pytest.mark.parametrize("content", [b"", b"not weights at all", b"PK\x03\x04 cut"])
def test_lpips_rejects_garbage(content, tmp_path):
    (tmp_path / "weights.pt").write_bytes(content)
    with pytest.raises(HyrfError, match="LPIPS"):
        LPIPS.load(tmp_path / "weights.pt")


def test_lpips_names_a_missing_file(tmp_path):
    with pytest.raises(HyrfError, match=r"none\.pt: the LPIPS weights cannot be read"):
        LPIPS.load(tmp_path / "none.pt")


# -- evaluate --------------------------------------------------------------------------------------------------------


def test_scores_are_those_of_the_saved_pictures(tmp_path):
    model, scene = ball_model(), ball_scene(views=3)
    scores = evaluate_model(model, scene.train)
    paths = list(render_files(model, [(view.name, view.camera) for view in scene.train], tmp_path))
    for path, view, score in zip(paths, scene.train, scores.views, strict=True):
        saved, photo = np.asarray(Image.open(path)), view.load().rgb
        assert score.name == view.name
        assert score.psnr == pytest.approx(skimage.metrics.peak_signal_noise_ratio(photo, saved), abs=1e-4)
        expected = reference_ssim_map(saved / 255, photo / 255).mean()
        assert score.ssim == pytest.approx(expected, abs=1e-4)
    assert scores.psnr == pytest.approx(np.mean([score.psnr for score in scores.views]))
    assert scores.gaussians == 150
    assert scores.seconds_per_frame > 0


def test_scores_are_strict_json_with_a_reason_for_missing_lpips():
    scores = evaluate_model(ball_model(), ball_scene(views=2).train)
    values = json.loads(json.dumps(scores.to_dict(), allow_nan=False))
    assert {"psnr", "ssim", "lpips", "gaussians", "views", "seconds_per_frame"} <= set(values)
    assert values["lpips"] is None and "lpips" in values["lpips_reason"]
    assert set(values["views"][0]) >= {"name", "psnr", "ssim"}


def test_lpips_is_the_mean_over_views_when_there_are_weights(tmp_path):
    torch.save(lpips_network("alex").state_dict(), tmp_path / "weights.pt")
    scores = evaluate_model(ball_model(), ball_scene(views=2).train, lpips_weights=tmp_path / "weights.pt")
    assert scores.lpips == pytest.approx(np.mean([score.lpips for score in scores.views]))
    assert scores.lpips > 0 and scores.lpips_reason == "network alex"


def test_transparent_photos_are_composited_over_the_background_colour_of_the_model():
    model = small_model(np.zeros((0, 3)), solid=(0.2, 0.6, 1.0))
    clear = Picture(np.full((32, 32, 3), 99, np.uint8), np.zeros((32, 32), np.uint8))
    view = dataclasses.replace(ball_scene(views=1).train[0], load=lambda: clear)
    assert evaluate_model(model, [view]).psnr == IDENTICAL_PSNR


def mask_view(view: View, mask: np.ndarray) -> View:
    picture = view.load()
    return dataclasses.replace(view, load=lambda: dataclasses.replace(picture, mask=mask))


def test_views_without_a_usable_pixel_are_named_and_left_out():
    first, second = ball_scene(views=2).train
    scores = evaluate_model(ball_model(), [mask_view(first, np.zeros((32, 32), bool)), second])
    assert scores.skipped == [first.name]
    assert [score.name for score in scores.views] == [second.name]
    with pytest.raises(HyrfError, match="masks"):
        evaluate_model(ball_model(), [mask_view(first, np.zeros((32, 32), bool))])


def test_an_empty_list_of_views_is_a_clear_error():
    with pytest.raises(HyrfError, match="no view to score"):
        evaluate_model(ball_model(), [])


def test_pictures_are_written_for_some_views_spread_over_all(tmp_path):
    evaluate_model(ball_model(), ball_scene(views=7).train, pictures=tmp_path / "new" / "folder", picture_count=3)
    assert [path.name for path in sorted((tmp_path / "new" / "folder").iterdir())] == ["000.png", "003.png", "006.png"]


# -- figures ---------------------------------------------------------------------------------------------------------


def test_comparison_shows_errors_on_a_fixed_scale():
    photo = torch.full((50, 400, 3), 0.5)
    render = photo.clone()
    render[:, 100:200] += ERROR_LIMIT
    render[:, 200:] += 1.5 * ERROR_LIMIT
    sheet = np.asarray(draw_comparison(photo, render))
    error = sheet[sheet.shape[0] // 2, -400:]
    assert tuple(error[50]) == (0, 0, 4)  # the first colour of the inferno colour map
    assert tuple(error[150]) == tuple(error[300]) == (252, 255, 164)  # the last colour of the map


def test_comparison_hides_errors_under_the_mask():
    photo, render = torch.zeros(50, 400, 3), torch.ones(50, 400, 3)
    mask = torch.zeros(50, 400, dtype=torch.bool)
    sheet = np.asarray(draw_comparison(photo, render, mask))
    assert tuple(sheet[sheet.shape[0] // 2, -200]) == (0, 0, 4)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (48, 48), (401, 3), (1100, 700)])
def test_comparison_takes_any_size(width, height):
    sheet = draw_comparison(torch.zeros(height, width, 3), torch.ones(height, width, 3), caption="a photo")
    assert 3 * 200 < sheet.width < 2100


def test_a_tall_picture_is_not_enlarged(tmp_path):
    sheet = draw_comparison(torch.zeros(900, 5, 3), torch.ones(900, 5, 3))
    assert sheet.height < 1000


@pytest.mark.parametrize(("width", "height"), [(1, 1), (48, 31), (401, 3), (640, 20)])
def test_a_comparison_can_be_cut_into_its_pictures_again(width, height):
    photo, render = noisy_and_smooth_pictures(height, width)
    photo, render = to_8bit(photo), to_8bit(render)
    cut = split_comparison(draw_comparison(photo, render, caption="a photo"))
    times = cut[0].width // width
    for picture, pixels in zip(cut, (photo, render), strict=False):
        assert picture.size == (times * width, times * height)
        assert (np.asarray(picture)[::times, ::times] == (pixels * 255).round().numpy()).all()


@pytest.mark.parametrize("size", [(1, 1), (16, 40), (616, 200), (1216, 20), (1216, 351)])
def test_other_pictures_are_not_cut(size):
    with pytest.raises(ValueError, match="beside each other|would meet"):
        split_comparison(Image.new("RGB", size, (0, 0, 0)))


def test_contact_sheet_is_wide_enough_for_its_text():
    row = draw_comparison(torch.zeros(20, 401, 3), torch.zeros(20, 401, 3))
    sheet = draw_contact_sheet([row, row], "title", ["x" * 300])
    assert sheet.width > 300 * 5 and sheet.height > 2 * row.height


def test_contact_sheet_needs_no_text_below_its_title():
    row = draw_comparison(torch.zeros(20, 30, 3), torch.zeros(20, 30, 3))
    sheet = draw_contact_sheet([row], "title", [])
    assert sheet.width > row.width and sheet.height < draw_contact_sheet([row], "title", ["text"]).height


@pytest.mark.parametrize("psnr_db", [True, float("nan"), 0, "30", None])
def test_a_stated_psnr_that_is_no_psnr_is_replaced_by_the_assumed_one(psnr_db):
    assert provenance_mse({"psnr": psnr_db}) == provenance_mse({})
    assert provenance_mse({"psnr": 30}) == pytest.approx(1e-3)


def test_training_curve_is_a_picture(tmp_path):
    records = [{"step": n, "psnr": 20 + n, "loss": 0.1 / n, "gaussians": 100 * n} for n in range(1, 9)]
    draw_training_curve(records, tmp_path / "curve.png")
    assert Image.open(tmp_path / "curve.png").size == (1080, 720)
