"""What tests of the pilot runs for budget, exposure and length share."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.evaluate import Evaluation
from hyrfpack.evaluate.view_scores import ViewScore
from hyrfpack.progress import Event, StepEvent, TaskEvent
from hyrfpack.scene import Scene, View
from hyrfpack.train import TrainConfig, train_model
from hyrfpack.train.decisions import MIN_BUDGET_STEPS

CPU_DEVICE = torch.device("cpu")
LONG_CONFIG = TrainConfig(steps=MIN_BUDGET_STEPS)


def make_scene(views: int = 10) -> Scene:
    return ball_scene(views=views, points=60, side=24)


def make_evaluation(
    psnr: float, corrected: float = 0.0, apart: tuple[float, ...] = (0.0, 0.0), ssim: float = 0.5
) -> Evaluation:
    views = [ViewScore("view", psnr + part, None, corrected, ssim, None) for part in apart]
    return Evaluation(psnr, None, corrected, ssim, None, "", 0, 0.0, views)


def with_ssim(score: float | tuple[float, float]) -> tuple[float, float]:
    """Return a PSNR and an SSIM from a pair of both, or from a PSNR alone."""
    return score if isinstance(score, tuple) else (score, 0.5)


def interrupt_at(step: int) -> RunContext:
    """Return a context that sends SIGTERM once, as a user would, after a step; 0 means the first step of a pilot."""
    left = [step]

    def interrupt(event: Event) -> None:
        is_pilot = isinstance(event, TaskEvent) and event.task.endswith(": training")
        if left and (is_pilot if step == 0 else isinstance(event, StepEvent) and event.step == step):
            left.clear()
            signal.raise_signal(signal.SIGTERM)

    return RunContext(progress=interrupt)


def mask_all_pixels(view: View) -> View:
    picture = view.load()
    nothing = dataclasses.replace(picture, mask=np.zeros(picture.rgb.shape[:2], bool))
    return dataclasses.replace(view, load=lambda: nothing)


def assert_resume_is_rejected(folder: Path, config: TrainConfig) -> None:
    """Assert that the run in a folder cannot be resumed with these settings."""
    with pytest.raises(HyrfTrainingError, match="started with other settings"):
        train_model(make_scene(), folder, config, resume=True, context=QUIET_CONTEXT)
