"""Fixtures for tests of pilot runs."""

from __future__ import annotations

import pytest
from pilot_runs import make_evaluation, with_ssim

from hyrfpack.train import budget_pilots, decisions, pilots


@pytest.fixture
def short_pilots(monkeypatch) -> None:
    """Pilots also precede runs of ten steps, and are short."""
    monkeypatch.setattr(decisions, "MIN_BUDGET_STEPS", 10)
    monkeypatch.setattr(budget_pilots, "BUDGET_PILOT_STEPS", 6)


@pytest.fixture
def scores(monkeypatch) -> dict:
    """Scores of models by their steps, by their budget, or by whether they learn gains. No model is trained.

    By steps or budget, a score is a PSNR or a pair of PSNR and SSIM.
    """
    table: dict = {}

    class Untrained:
        def __init__(self, scene, config, cache, device):
            self.model = config

        def run(self, checkpoint, progress, stop):
            pass

    def evaluate(config, views, progress):
        if config.steps in table:
            psnr, ssim = with_ssim(table[config.steps])
            return make_evaluation(psnr, ssim=ssim)
        if config.exposure in table:
            return make_evaluation(
                table[config.exposure][config.seed],
                0.0,
                table["apart"] if config.exposure else (0.0,) * len(table["apart"]),
            )
        corrected, ssim = with_ssim(table[config.max_gaussians])
        return make_evaluation(0.0, corrected, ssim=ssim)

    monkeypatch.setattr(pilots, "Trainer", Untrained)
    monkeypatch.setattr(pilots, "evaluate_model", evaluate)
    return table
