"""Pack the scene of an interrupted training run, so that it can be looked at before the run is resumed."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from hyrfpack.atomic import remove_if_possible
from hyrfpack.compress import compress_model
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.format import describe_file, save_model
from hyrfpack.format.run_folder import PREVIEW_FILE
from hyrfpack.make.stage_cache import StageCache
from hyrfpack.train import Trainer
from hyrfpack.train.provenance import training_provenance

_LOG = logging.getLogger(__name__)

_UNCOMPRESSED_FILE = "preview.raw.hyrf"


def remove_preview(stage_cache: StageCache) -> None:
    """Remove the preview of an earlier call, if there is one."""
    remove_if_possible(stage_cache.folder / PREVIEW_FILE)


def write_preview(stage_cache: StageCache, trainer: Trainer, context: RunContext) -> Path | None:
    """Compress the model of an interrupted run into `preview.hyrf` in the work folder.

    The model of an interrupted run was trained at a lower resolution and has more Gaussians than at the end. A preview
    that an earlier call has left is kept if it has more steps. The checkpoint stays, so the run can be resumed.

    Args:
        stage_cache: the stages of the pipeline.
        trainer: the trainer of the interrupted run, or of a teacher run before it.
        context: context of the call.

    Returns:
        The path of the file; None if it cannot be written, which is logged, or if a second interruption skips it.
    """
    target, uncompressed = stage_cache.folder / PREVIEW_FILE, stage_cache.folder / _UNCOMPRESSED_FILE
    if _read_steps(target) > trainer.step:
        return target
    _LOG.info("stopping: compressing a preview of the scene; a second interruption skips it")
    provenance = {"steps": trainer.step, "choices": trainer.choices, **training_provenance(trainer.scene)}
    # The stop that ended the training must not end the compression, too.
    compression_context = replace(context, progress=stage_cache.reporter.report_event, stop=None)
    try:
        trainer.fit_exposure_map()
        save_model(trainer.model, uncompressed, profile="raw", provenance=provenance)
        compress_model(uncompressed, target, context=compression_context)
    except HyrfError as error:
        _LOG.warning(f"the preview of the scene cannot be written: {error}")
        return None
    except KeyboardInterrupt:
        return None
    finally:
        remove_if_possible(uncompressed)
    return target


def _read_steps(preview: Path) -> int:
    """Return the number of steps of the run that a preview shows; 0 if there is none, or it is damaged."""
    try:
        steps = describe_file(preview)["provenance"].get("steps")
    except (HyrfError, OSError):
        return 0
    return steps if isinstance(steps, int) else 0
