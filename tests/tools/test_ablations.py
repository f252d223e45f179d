"""Each variant of `tools/studies/ablations.py` lacks what it claims to lack and trains everything else."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
import torch
from scenes import ball_scene, ring, small_model

from hyrfpack.data import PictureCache
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.hash_grid import HashGrid
from hyrfpack.render import render_view
from hyrfpack.train import DensityConfig, LearningRates, TrainConfig, Trainer, setup
from tools.studies import ablation_models, ablations, reuse

# Density control clones and splits from the second step on.
EARLY_DENSITY_CONFIG = DensityConfig(start=0.05, stop=0.7, rounds=5, gradient=1e-6)
SHORT_CONFIG = TrainConfig(steps=24, seed=3, max_gaussians=160, density=EARLY_DENSITY_CONFIG)
VARIANTS_BY_NAME = {variant.name: variant for variant in ablation_models.TRAINED_VARIANTS}
ALL_GROUPS = {*Gaussians.PARAMETER_NAMES, "geometry", "radiance"}
GROUPS_BY_VARIANT = {
    "full": ALL_GROUPS,
    "single field": ALL_GROUPS - {"geometry"},  # the only field is the radiance field, with doubled tables
    "no explicit properties": {"positions", "geometry", "radiance"},
    "no neural fields": set(Gaussians.PARAMETER_NAMES),
    "no neural Gaussians, sphere kept": {*Gaussians.PARAMETER_NAMES, "radiance"},
    "no background sphere": ALL_GROUPS,
    "no explicit colour": ALL_GROUPS - {"color_logits"},
    "no explicit scale": ALL_GROUPS - {"scale_logits"},
    "no explicit opacity": ALL_GROUPS - {"opacity_logits"},
    "spherical harmonics for colour": ALL_GROUPS,
    "no pre-culling, in training neither": ALL_GROUPS,
}


def make_scene():
    return ball_scene(6, 60, side=24)


def make_trainer(name: str, config: TrainConfig = SHORT_CONFIG) -> Trainer:
    return ablation_models.build_trainer(make_scene(), config, VARIANTS_BY_NAME[name])


def group_of(name: str) -> str:
    """Return the parameter group of a parameter's full name."""
    head, _, rest = name.partition(".")
    return rest if head == "gaussians" else head


def decode(model, viewpoint=(3.0, 1.0, 0.5)) -> list[torch.Tensor]:
    """Return scales, rotations, opacities and colours of all Gaussians."""
    geometry = model.decode_geometry()
    return [geometry.scales, geometry.quats, geometry.opacities, model.decode_colors(torch.tensor(viewpoint))]


def find_changed(model, parameter: torch.Tensor) -> list[bool]:
    """Return which results of decoding change when a parameter changes."""
    before = [values.detach().clone() for values in decode(model)]
    with torch.no_grad():
        parameter += torch.rand(parameter.shape, generator=torch.Generator().manual_seed(5)) + 0.5
    return [not torch.equal(old, new) for old, new in zip(before, decode(model), strict=True)]


# -- what is kept and what is not --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", VARIANTS_BY_NAME)
def test_a_run_trains_exactly_the_groups_of_its_variant(name):
    trainer = make_trainer(name)
    before = {key: p.detach().clone() for key, p in trainer.model.named_parameters()}

    assert trainer.run()

    assert len(trainer.model) > 60  # density control has added some
    after = dict(trainer.model.named_parameters())
    # New rows begin as copies, so a value counts as moved if it did not exist before.
    moved = {group_of(key) for key, p in after.items() if not torch.isin(p.detach(), before[key]).all()}
    assert moved == GROUPS_BY_VARIANT[name]
    # Density control reads the gradients of opacity logits, also of those that stay zero.
    with_gradients = {group_of(key) for key, p in after.items() if p.requires_grad}
    assert with_gradients == GROUPS_BY_VARIANT[name] | {"opacity_logits"}
    assert all(parameter.isfinite().all() for parameter in after.values())


@pytest.mark.parametrize("name", [name for name in VARIANTS_BY_NAME if VARIANTS_BY_NAME[name].missing_logits])
def test_missing_logits_stay_zero(name):
    trainer = make_trainer(name)
    trainer.run()

    for logits in VARIANTS_BY_NAME[name].missing_logits:
        values = getattr(trainer.model.gaussians, logits)
        assert len(values) == len(trainer.model) > 60
        assert not values.any()


def test_density_control_scores_gaussians_without_opacity_logits():
    trainer = make_trainer(
        "no explicit opacity", dataclasses.replace(SHORT_CONFIG, steps=4, density=DensityConfig(start=0.9))
    )
    trainer.run()
    assert (trainer.strategy.squares > 0).float().mean() > 0.5


@pytest.mark.parametrize("name", [name for name in VARIANTS_BY_NAME if VARIANTS_BY_NAME[name].missing_logits])
def test_without_logits_gaussians_start_at_the_mean_of_the_initial_logits(name):
    full, model = make_trainer("full").model, make_trainer(name).model

    scales, _, opacities, colors = decode(model)
    expected_scales, _, expected_opacities, expected_colors = decode(full)
    torch.testing.assert_close(opacities, expected_opacities, atol=1e-3, rtol=0)  # 0.1 for all of them
    fraction, expected = (
        values / model.scale_bounds(model.gaussians.positions) for values in (scales, expected_scales)
    )
    torch.testing.assert_close(fraction.logit().mean(0), expected.logit().mean(0), atol=1e-3, rtol=0)
    torch.testing.assert_close(colors.logit().mean(0), expected_colors.logit().mean(0), atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", [name for name in VARIANTS_BY_NAME if VARIANTS_BY_NAME[name].model is not HybridModel])
def test_gaussians_of_another_model_start_with_the_same_colours_and_backgrounds(name, monkeypatch):
    monkeypatch.setattr(setup, "first_color", lambda *_: np.array([0.9, 0.4, 0.05]))
    full, model = make_trainer("full").model, make_trainer(name).model
    start = full.radiance.biases[-1]
    assert start.any() and torch.equal(model.radiance.biases[-1][:3], start)
    expected = torch.sigmoid(full.gaussians.color_logits + start)
    # The untrained field of the single-field variant adds random logits.
    noise = 0.2 if name == "single field" else 1e-5
    torch.testing.assert_close(decode(model)[3], expected, atol=noise, rtol=0)


def test_the_full_variant_trains_the_same_model_as_the_default_trainer():
    product, ours = Trainer(make_scene(), SHORT_CONFIG), make_trainer("full")
    product.run()
    ours.run()

    for (name, expected), (_, value) in zip(
        product.model.named_parameters(), ours.model.named_parameters(), strict=True
    ):
        assert torch.equal(expected, value), name


def test_a_single_field_has_one_grid_that_everything_reads():
    full, model = make_trainer("full").model, make_trainer("single field").model

    grids = [part for part in model.modules() if isinstance(part, HashGrid)]
    assert len(grids) == 1
    rows = full.geometry.grid.config.rows + full.radiance.grid.config.rows
    assert rows < grids[0].config.rows < 1.5 * rows
    assert all(find_changed(model, grids[0].table))


@pytest.mark.parametrize("name", ["no neural fields", "no neural Gaussians, sphere kept"])
def test_fields_do_not_affect_isotropic_diffuse_gaussians(name):
    model = make_trainer(name).model

    for field in (model.geometry, model.radiance):
        for parameter in field.parameters():
            assert not any(find_changed(model, parameter))


def test_isotropic_diffuse_gaussians_equal_a_model_with_zero_fields():
    positions = np.random.default_rng(2).normal(size=(7, 3)) * 2  # some of them are outside the box
    silent = small_model(positions, fields=0.0, color_logits=[0.3, -1.0, 2.0], opacity_logits=-0.5)
    model = ablation_models.IsotropicDiffuse(silent.config, silent.gaussians)
    index = torch.tensor([1, 2, 5])

    for value, expected in zip(decode(model), decode(silent), strict=True):
        torch.testing.assert_close(value, expected, atol=1e-7, rtol=1e-6)
    assert torch.equal(model.decode_geometry(index).scales, model.decode_geometry().scales[index])
    assert torch.equal(model.decode_colors(torch.zeros(3), index), model.decode_colors(torch.zeros(3))[index])


# -- spherical harmonics -----------------------------------------------------------------------------------------------


def test_harmonics_are_orthonormal_on_the_sphere():
    z, weights = np.polynomial.legendre.leggauss(8)  # exact for polynomials up to degree 15
    phi = 2 * np.pi * np.arange(16) / 16
    radius = np.sqrt(1 - z**2)[:, None]
    sphere = np.stack((radius * np.cos(phi), radius * np.sin(phi), np.broadcast_to(z[:, None], (8, 16))), -1)

    basis = ablation_models.evaluate_harmonics_to_degree_3(torch.from_numpy(sphere.reshape(-1, 3))).numpy()

    gram = (basis * np.repeat(weights * 2 * np.pi / 16, 16)[:, None]).T @ basis
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)


def test_harmonic_colours_start_as_the_point_colours_in_all_directions():
    full, model = make_trainer("full").model, make_trainer("spherical harmonics for colour").model

    assert model.gaussians.color_logits.shape == (len(model), 48)
    expected = torch.sigmoid(full.gaussians.color_logits + full.radiance.biases[-1])
    for viewpoint in ring(3):
        colors = model.decode_colors(torch.from_numpy(viewpoint.position).float())
        torch.testing.assert_close(colors, expected, atol=1e-6, rtol=0)


def test_harmonic_colours_match_the_formula_of_3dgs():
    model = make_trainer("spherical harmonics for colour").model
    generator = torch.Generator().manual_seed(1)
    coefficients = torch.randn(len(model), 16, 3, generator=generator) / 3  # h of each band and channel
    rates = torch.full((16, 1), 20.0)
    rates[0] = 1
    model.gaussians.color_logits.data = (coefficients * rates).flatten(1)
    viewpoint, index = torch.tensor([3.0, 1.0, 0.5]), torch.tensor([4, 9])

    basis = ablation_models.evaluate_harmonics_to_degree_3(
        torch.nn.functional.normalize(model.gaussians.positions.detach().double() - viewpoint, dim=-1)
    )
    expected = ((basis[..., None] * coefficients).sum(1) + 0.5).clamp_min(0)
    assert (expected == 0).any()  # some colours are clipped
    torch.testing.assert_close(model.decode_colors(viewpoint).double(), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(model.decode_colors(viewpoint, index).double(), expected[index], atol=1e-5, rtol=0)


def test_the_radiance_field_does_not_affect_harmonic_colours():
    model = make_trainer("spherical harmonics for colour").model

    assert not any(any(find_changed(model, parameter)) for parameter in model.radiance.parameters())


# -- running and reporting ---------------------------------------------------------------------------------------------


def test_without_pre_culling_every_gaussian_is_decoded():
    model = make_trainer("full").model
    camera = dataclasses.replace(ring(1)[0], width=6, cx=3.0)  # a narrow picture that shows few of them

    with ablations.patch_culling(ablation_models.NO_CULLING_VARIANT):
        everything = render_view(model, camera)

    assert len(everything.indices) == len(model)
    assert len(render_view(model, camera).indices) < len(model)


@pytest.mark.parametrize("steps", [1, 3], ids=["in the last step", "midway"])
def test_a_diverged_run_is_recorded_as_a_result(steps, tmp_path):
    config = dataclasses.replace(SHORT_CONFIG, steps=steps, learning_rates=LearningRates(fields=(1e38, 1e38)))

    result = ablations.train_and_measure(
        VARIANTS_BY_NAME["no explicit scale"], make_scene(), config, tmp_path / "full.hyrf", PictureCache()
    )

    assert list(result) == ["failed"]
    assert "finite" in result["failed"]


def test_one_call_measures_the_variants_and_prints_their_tables(tmp_path, monkeypatch, capsys):
    scene = make_scene()
    scene = dataclasses.replace(scene, train=scene.train[:4], test=scene.train[4:])
    monkeypatch.setattr(ablations.hyrfpack, "load_scene", lambda folder: scene)
    monkeypatch.setattr(ablations, "TIMING_REPEATS", 1)
    arguments = ["ablations", "--steps", "3", "--seeds", "1", "--sets", "balls", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*arguments, "--only", "harmonics", "culling"])

    ablations.main()
    first = capsys.readouterr().out
    monkeypatch.setattr(ablations, "train_and_measure", None)  # finished runs are not repeated
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--reuse"])
    ablations.main()

    assert capsys.readouterr().out == first
    monkeypatch.setattr(reuse, "describe_own_version", lambda: "another")
    with pytest.raises(TypeError):  # it would train again
        ablations.main()
    for name in ("full", "spherical harmonics for colour", "no pre-culling"):
        assert f"| {name} | " in first
    assert "single field" not in first


def make_result(psnr: float, **other) -> dict:
    return {"psnr": psnr, "ssim": 0.5, "gaussians": 100, "bytes": 800, "frames_ratio": 0.5, **other}


def test_tables_show_differences_their_spread_and_failed_runs():
    failed = {"failed": "the loss is not finite"}
    single, scale = VARIANTS_BY_NAME["single field"], VARIANTS_BY_NAME["no explicit scale"]
    results = {
        ("full", "a"): [make_result(20.0), make_result(21.0)],
        ("full", "b"): [make_result(30.0), make_result(30.0)],
        (single.name, "a"): [make_result(19.0, bytes=1000), make_result(20.5, bytes=1000)],
        (single.name, "b"): [make_result(30.2, bytes=1000), make_result(30.4, bytes=1000)],
        (scale.name, "a"): [failed, make_result(18.5)],
        (scale.name, "b"): [failed, failed],
    }
    variants = [VARIANTS_BY_NAME["full"], single, scale]

    text = ablations.format_report(results, ["a", "b"], variants)

    assert "| full | 24.07, 30.37 | 20.50 ± 0.50 | 30.00 ± 0.00 |" in text
    assert "| single field | -0.29 | -0.75 ± 0.25 | +0.30 ± 0.10 | -0.23 | 1 of 2 |" in text
    assert "| no explicit scale | -1.63 | -2.50 ± 0.00 (1 did not train) | did not train | -2.50 | 1 of 1 |" in text
    assert "| single field | 0.90 | 1.25 | 0.95 | 0.50 |" in text
    assert "| no explicit scale | did not train |" in text  # in the table of set b
