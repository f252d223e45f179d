"""What the demo reports of its run."""

from __future__ import annotations

import pytest

import hyrfpack
from hyrfpack.demo import run as demo


@pytest.mark.acceptance
def test_the_demo_reports_the_steps_that_were_taken(tmp_path, monkeypatch):
    train = demo.train_model

    def train_fewer(scene, folder, config, **options):
        return train(scene, folder, hyrfpack.TrainConfig(steps=5), **options)  # as if pilot runs had cut the run

    monkeypatch.setattr(demo, "train_model", train_fewer)
    result = demo.run_demo(tmp_path, steps=10, views=10, size=32)
    assert result.steps == 5
    assert f"{5 / result.train_seconds:.0f} training steps/s" in result.table()[-2]
