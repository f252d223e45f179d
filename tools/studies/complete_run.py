"""Train models to their last step, for studies that must not measure a run that was interrupted."""

from __future__ import annotations

from pathlib import Path

import hyrfpack
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, TrainResult


def train_completely(
    scene: Scene,
    out: Path,
    config: TrainConfig,
    *,
    resume: bool = False,
    context: hyrfpack.RunContext = hyrfpack.RunContext(),  # noqa: B008 - frozen
) -> TrainResult:
    """Train a model as `hyrfpack.train_model` does, whose folder may hold an earlier run.

    Args:
        scene, config, context: as for `train_model`.
        out: folder of the run.
        resume: continue the run in the folder instead of replacing it.

    Raises:
        SystemExit: the training was interrupted. An earlier run may still be in the folder, and must not be measured.
    """
    result = hyrfpack.train_model(scene, out, config, resume=resume, overwrite=not resume, context=context)
    if not result.complete:
        raise SystemExit(f"{out}: the training was stopped, so it is not measured; run the same command again")
    return result
