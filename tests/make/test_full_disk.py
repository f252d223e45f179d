"""After a disk was full at the end of training, the next call completes the training's results."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from hyrfpack.errors import HyrfError
from hyrfpack.make import make_scene
from hyrfpack.train import Trainer


def test_missing_metrics_after_a_full_disk_are_completed_by_the_next_call(posed: Path, monkeypatch, tmp_path):
    replace = os.replace

    def checked(source, target) -> None:
        if str(target).endswith("metrics.json"):
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("hyrfpack.atomic.os.replace", checked)
        with pytest.raises(HyrfError, match=r"training failed: .*metrics.json: the disk is full.*is kept"):
            make_scene(posed, tmp_path / "scene.hyrf", quality="draft")
    model = (tmp_path / "scene.work" / "run" / "model.hyrf").read_bytes()

    monkeypatch.setattr(Trainer, "run", lambda *_, **__: pytest.fail("it was trained again"))
    result = make_scene(posed, tmp_path / "scene.hyrf", quality="draft")

    run = tmp_path / "scene.work" / "run"
    assert result.output.is_file() and (run / "model.hyrf").read_bytes() == model
    assert json.loads((run / "metrics.json").read_bytes())["evaluation"]["psnr"] > 0
    assert not (run / "training.json").exists()
