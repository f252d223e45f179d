"""Pack the scene of an interrupted training run, so that it can be looked at before the run is resumed."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from hyrfpack.compress import compress_model
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.format import save_model
from hyrfpack.make.stage_cache import StageCache
from hyrfpack.train import Trainer
from hyrfpack.train.provenance import training_provenance

_LOG = logging.getLogger(__name__)

PREVIEW_FILE = "preview.hyrf"
_UNCOMPRESSED_FILE = "preview.raw.hyrf"


def remove_preview(stage_cache: StageCache) -> None:
    """Remove the preview of an earlier call, if there is one."""
    with suppress(OSError):
        (stage_cache.folder / PREVIEW_FILE).unlink(missing_ok=True)


def write_preview(stage_cache: StageCache, trainer: Trainer, context: RunContext) -> Path | None:
    """Compress the model of an interrupted run into `preview.hyrf` in the work folder.

    The model has the quality of its last step: it was trained at a lower resolution and has more Gaussians than at the
    end. The checkpoint stays, so the run can be resumed.

    Args:
        stage_cache: the stages of the pipeline.
        trainer: the trainer of the interrupted run.
        context: context of the call.

    Returns:
        The path of the file; None if it cannot be written, which is logged, or if a second interruption skips it.
    """
    target, uncompressed = stage_cache.folder / PREVIEW_FILE, stage_cache.folder / _UNCOMPRESSED_FILE
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
        with suppress(OSError):
            uncompressed.unlink(missing_ok=True)
    return target
