"""Profile `compact` for Gaussians that coincide, are far away, identical or saturated, or cannot be encoded."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ball_points, ring, small_model

from hyrfpack import compress_model, load_model, save_model
from hyrfpack.errors import HyrfError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.format.container import read_container
from hyrfpack.model import HybridModel
from tools.safety.synthetic_encoding import quantize_uniformly, quantize_with_drawn_sensitivity

pytestmark = pytest.mark.usefixtures("quick_calibration")
PLANNED_STEP = 2.0**-10
# An even plan of this step may choose steps up to this size.
MAX_STEP = PLANNED_STEP * 16 / 15


def encode_and_decode(model: HybridModel, quantized: QuantizedModel) -> HybridModel:
    return decode_model(encode_model(model, "compact", quantized=quantized))


def opacities(model: HybridModel) -> np.ndarray:
    with torch.no_grad():
        return model.decode_geometry().opacities.double().numpy()


def contracted_positions(model: HybridModel) -> np.ndarray:
    with torch.no_grad():
        return model.cube_coords(model.gaussians.positions.double()).numpy()


def normal(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(4))


def test_coincident_gaussians_keep_their_values_and_common_position():
    colors, sizes = normal(1000, 3), normal(1000, 1)
    model = small_model(np.tile([0.3, -0.4, 0.2], (1000, 1)), color_logits=colors, scale_logits=sizes)
    quantized = quantize_uniformly(model, PLANNED_STEP)
    plan = quantized.plan

    data = encode_model(model, "compact", quantized=quantized)
    decoded = decode_model(data)

    assert len(decoded.gaussians.positions.unique(dim=0)) == 1
    assert np.abs(contracted_positions(decoded) - contracted_positions(model)).max() <= MAX_STEP / 2
    assert len(read_container(data)["POSI"].data) < 100  # 1,000 gaps of zero
    assert sorted(plan.kept.tolist()) == list(range(1000))
    assert (decoded.gaussians.color_logits - colors[plan.kept]).abs().max() <= 1.5 * 3**0.5 * MAX_STEP
    assert (decoded.gaussians.scale_logits - sizes[plan.kept]).abs().max() <= 1.5 * MAX_STEP


@pytest.mark.parametrize("distance", [1e4, 1e10, 1e30, 3e38])
def test_far_gaussians_keep_their_direction_and_do_not_affect_others(distance):
    """The contracted cube is bounded: a position at 1e30 is just inside its faces, and is decoded nearer."""
    inner = ball_points(100)[0]
    outer = distance * np.array([[1.0, 0.0, 0.0], [-1.0, 1.0, -1.0], [0.0, -0.5, 1.0]])
    model = small_model(np.vstack([inner, outer]))
    quantized = quantize_uniformly(model, PLANNED_STEP)
    plan = quantized.plan

    decoded = encode_and_decode(model, quantized)

    before, after = contracted_positions(model)[plan.kept], contracted_positions(decoded)
    assert np.abs(after - before).max() <= MAX_STEP / 2 + 1e-6
    local = decoded.gaussians.positions.detach().double().numpy()[plan.kept >= 100]
    wanted = outer[plan.kept[plan.kept >= 100] - 100]
    cosines = (local * wanted / distance).sum(1)
    cosines /= np.linalg.norm(local, axis=1) * np.linalg.norm(wanted / distance, axis=1)
    assert (cosines > 1 - (2 * MAX_STEP) ** 2).all() and np.linalg.norm(local, axis=1).min() > 100


def test_constant_channels_are_exact_and_take_no_bytes():
    model = small_model(ball_points(5000)[0], color_logits=0.3, scale_logits=-3.3, opacity_logits=1.7)

    data = encode_model(model, "compact", quantized=quantize_uniformly(model, PLANNED_STEP))
    decoded = decode_model(data).gaussians

    for section, bytes_of_all in (("COLO", 200), ("SCAL", 60), ("OPAC", 60)):
        assert len(read_container(data)[section].data) < bytes_of_all
    assert (decoded.scale_logits == np.float32(-3.3)).all() and (decoded.opacity_logits == np.float32(1.7)).all()
    assert (decoded.color_logits - 0.3).abs().max() <= 2**-22


def test_tables_and_decoders_of_one_value_keep_it():
    model = small_model(ball_points(300)[0])
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if not name.startswith("gaussians"):
                parameter.fill_(-0.7)

    decoded = encode_and_decode(model, quantize_uniformly(model, PLANNED_STEP))

    for name, parameter in decoded.named_parameters():
        if not name.startswith("gaussians"):
            assert (parameter + 0.7).abs().max() <= 1.5 * MAX_STEP, name


@pytest.mark.parametrize("size", [12.0, 80.0, 1e4, 1e30])
def test_saturated_opacities_and_colours_stay_saturated(size):
    """Logits beyond 4096 are clipped, and opacities earlier; their appearance does not change."""
    signs = normal(400, 1).sign()
    model = small_model(ball_points(400)[0], opacity_logits=signs * size, color_logits=signs * size, fields=0.3)
    quantized = quantize_uniformly(model, PLANNED_STEP)
    plan = quantized.plan

    decoded = encode_and_decode(model, quantized)

    assert np.abs(opacities(decoded) - opacities(model)[plan.kept]).max() <= 3.4e-4 + 4.5 * 0.25 * MAX_STEP
    colors = decoded.gaussians.color_logits.detach(), model.gaussians.color_logits.detach()[plan.kept]
    assert (torch.sigmoid(colors[0]) - torch.sigmoid(colors[1])).abs().max() <= 1e-4


@pytest.mark.parametrize("prune", [False, True])
def test_a_model_without_gaussians_can_be_written_and_read(prune):
    model = small_model(np.zeros((0, 3)), background=True)

    decoded = encode_and_decode(model, quantize_with_drawn_sensitivity(model, prune=prune))

    assert len(decoded) == 0 and decoded.config == model.config


def test_one_gaussian_is_kept_and_compressed(tmp_path):
    model = small_model([(0.1, 0.2, 0.3)], fields=0.3)
    save_model(model, tmp_path / "one.hyrf", "raw")

    report = compress_model(tmp_path / "one.hyrf", tmp_path / "small.hyrf")
    decoded = load_model(tmp_path / "small.hyrf")

    assert report.profile == "compact" and report.gaussians == len(decoded) == 1
    assert report.bytes_after < (tmp_path / "one.hyrf").stat().st_size / 2
    assert np.abs(contracted_positions(decoded) - contracted_positions(model)).max() < 1e-3


def test_a_model_without_gaussians_is_rejected_with_a_clear_error(tmp_path):
    save_model(small_model(np.zeros((0, 3))), tmp_path / "none.hyrf", "raw")

    with pytest.raises(HyrfError, match="none.hyrf: there is no Gaussian in it.*use profile 'paper'$"):
        compress_model(tmp_path / "none.hyrf", tmp_path / "small.hyrf")

    assert not (tmp_path / "small.hyrf").exists()


def test_a_model_that_cannot_be_rendered_is_rejected_with_a_clear_error(tmp_path):
    """The squares of the positions overflow, and nothing can be measured on pictures of NaN."""
    save_model(small_model([(0.0, 0.0, 0.0), (1e30, 0.0, 0.0)], fields=0.3), tmp_path / "far.hyrf", "raw")

    with pytest.raises(HyrfError):
        compress_model(tmp_path / "far.hyrf", tmp_path / "small.hyrf")

    assert not (tmp_path / "small.hyrf").exists()


def test_gaussians_that_no_camera_sees_survive():
    """Behind and beside all cameras, sensitivity has a lower bound above zero: they are coarse but still there."""
    from hyrfpack.compress.quantize import plan_and_quantize
    from hyrfpack.compress.sensitivity import measure_sensitivity

    model = small_model(np.vstack([ball_points(50)[0], [[0.0, 0.0, 40.0], [300.0, 300.0, 300.0]]]), scale_logits=-2.0)
    cameras = ring(4, width=24, height=24)

    quantized = plan_and_quantize(model, measure_sensitivity(model, cameras), 1e-6, prune=False)
    plan, decoded = quantized.plan, encode_and_decode(model, quantized)

    assert set(plan.kept) >= {50, 51}
    assert np.abs(contracted_positions(decoded) - contracted_positions(model)[plan.kept]).max() < 0.3
    assert all(torch.isfinite(parameter).all() for parameter in decoded.parameters())
