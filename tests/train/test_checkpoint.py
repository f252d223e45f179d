from __future__ import annotations

import hashlib
import io
import os
import pickle
import random

import pytest
import torch

from hyrfpack.errors import HyrfTrainingError
from hyrfpack.train.checkpoint import SavedDecisions, load_checkpoint, save_checkpoint, saved_decisions

STORED_SETTINGS = {"steps": 40, "rates": (1e-3, 1e-5), "views": [["a.png", 4, 3]], "budget": None}
STORED_PROGRESS = {"step": 12, "records": [{"step": 1, "loss": 0.25}], "seconds": {"data": 0.5}}


def make_tensors() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {"model.a": torch.randn(40, 3, generator=generator), "adam.step": torch.tensor(12.0)}


def seal_content(content, **options) -> bytes:
    """Return a checkpoint with any content and the correct digest, as an attacker could write it."""
    buffer = io.BytesIO()
    torch.save(content, buffer, **options)
    return buffer.getvalue() + hashlib.sha256(buffer.getvalue()).digest()


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, settings=STORED_SETTINGS, tensors=make_tensors(), progress=STORED_PROGRESS)
    return path


def test_a_saved_checkpoint_is_loaded_unchanged(path):
    tensors, progress = load_checkpoint(path, STORED_SETTINGS)
    assert progress == STORED_PROGRESS
    assert tensors.keys() == make_tensors().keys()
    assert all(torch.equal(tensors[name], value) for name, value in make_tensors().items())


@pytest.mark.parametrize("factor", [None, 0.25, 1])
@pytest.mark.parametrize("exposure", [False, True])
def test_decisions_of_pilot_runs_can_be_read_back(path, factor, exposure):
    decided = {"budget_factor": factor, "exposure": exposure}
    save_checkpoint(path, settings={**STORED_SETTINGS, **decided}, tensors={}, progress=STORED_PROGRESS)
    assert saved_decisions(path) == SavedDecisions(factor, exposure, steps=40)


def test_an_older_checkpoint_has_no_pilot_decisions(path):
    assert saved_decisions(path) == SavedDecisions(None, False, steps=40)


@pytest.mark.parametrize(
    ("run", "asked"),
    [
        ({"choices": {"exposure": "on"}, "pilots": []}, 40),
        ({"choices": {"steps": "40: by pilots"}, "pilots": [{"run_steps": 90}]}, 90),
        ({"choices": {"steps": "40: by pilots"}, "pilots": [{"steps": 40}]}, None),
        ({"choices": {"steps": "40: by pilots"}, "pilots": [{"run_steps": "90"}]}, None),
        ({"choices": {"steps": "40: by pilots"}, "pilots": [90]}, None),
        ({"choices": 3, "pilots": 4}, None),
    ],
)
def test_the_steps_that_the_user_asked_for_can_be_read_back(path, run, asked):
    save_checkpoint(path, settings=STORED_SETTINGS, tensors={}, progress={**STORED_PROGRESS, **run})
    assert saved_decisions(path).asked_steps == asked


def test_an_invalid_exposure_decision_counts_as_damage(path):
    save_checkpoint(path, settings={**STORED_SETTINGS, "exposure": None}, tensors={}, progress=STORED_PROGRESS)
    with pytest.raises(HyrfTrainingError, match="damaged"):
        saved_decisions(path)


@pytest.mark.parametrize("factor", ["1", -1.0, float("nan"), float("inf"), [1.0], True])
def test_an_invalid_budget_factor_counts_as_damage(path, factor):
    save_checkpoint(path, settings={**STORED_SETTINGS, "budget_factor": factor}, tensors={}, progress=STORED_PROGRESS)
    with pytest.raises(HyrfTrainingError, match="damaged"):
        saved_decisions(path)


@pytest.mark.parametrize("steps", ["8", 0, -1, 2.5, True, [8], None])
def test_an_invalid_number_of_steps_counts_as_damage(path, steps):
    save_checkpoint(path, settings={**STORED_SETTINGS, "steps": steps}, tensors={}, progress=STORED_PROGRESS)
    with pytest.raises(HyrfTrainingError, match="damaged"):
        saved_decisions(path)


def test_only_the_checkpoint_is_left_in_the_folder(path):
    assert [entry.name for entry in path.parent.iterdir()] == ["checkpoint.pt"]


def test_a_missing_checkpoint_is_a_clear_error(tmp_path):
    with pytest.raises(HyrfTrainingError, match="no checkpoint to resume from"):
        load_checkpoint(tmp_path / "checkpoint.pt", STORED_SETTINGS)


@pytest.mark.parametrize(
    ("change", "named"),
    [({"steps": 41}, "steps"), ({"budget": 5}, "budget"), ({"rates": (1e-3, 1e-4)}, "rates"), ({"new": 1}, "new")],
)
def test_other_settings_are_rejected_by_name(path, change, named):
    with pytest.raises(HyrfTrainingError, match=rf"other settings \({named}\)"):
        load_checkpoint(path, {**STORED_SETTINGS, **change})


def test_a_checkpoint_without_one_of_the_settings_is_rejected(path):
    with pytest.raises(HyrfTrainingError, match=r"other settings \(budget, views\)"):
        load_checkpoint(path, {name: STORED_SETTINGS[name] for name in ("steps", "rates")} | {"budget": 7})


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.5, 0.9, 0.99])
def test_a_truncated_checkpoint_is_rejected(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(HyrfTrainingError, match="damaged"):
        load_checkpoint(path, STORED_SETTINGS)


@pytest.mark.parametrize("length", [1, 7, 100, 5000])
def test_random_bytes_are_rejected(tmp_path, length):
    path = tmp_path / "checkpoint.pt"
    for seed in range(20):
        path.write_bytes(random.Random(seed).randbytes(length))
        with pytest.raises(HyrfTrainingError, match="damaged"):
            load_checkpoint(path, STORED_SETTINGS)


def test_a_flipped_bit_anywhere_is_detected(path):
    """A flipped bit in the values must be noticed too, or a run would resume from other values."""
    data = bytearray(path.read_bytes())
    generator = random.Random(0)
    for _ in range(300):
        place, bit = generator.randrange(len(data)), 1 << generator.randrange(8)
        data[place] ^= bit
        path.write_bytes(data)
        with pytest.raises(HyrfTrainingError, match="damaged"):
            load_checkpoint(path, STORED_SETTINGS)
        data[place] ^= bit


@pytest.mark.parametrize(
    "content",
    [
        (1, 2),
        [1, 2, 3],
        {},
        {"version": 1},
        {"version": 1, "settings": "{", "progress": "{}", "tensors": {}},
        {"version": 1, "settings": 5, "progress": "{}", "tensors": {}},
        {"version": 1, "settings": "[]", "progress": "{}", "tensors": {}},
        None,
        "text",
    ],
    ids=str,
)
def test_other_torch_files_are_rejected(tmp_path, content):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(seal_content(content))
    with pytest.raises(HyrfTrainingError, match="damaged"):
        load_checkpoint(path, STORED_SETTINGS)
    torch.save(content, path)
    with pytest.raises(HyrfTrainingError, match="damaged"):
        load_checkpoint(path, STORED_SETTINGS)


def test_another_version_is_rejected(tmp_path):
    path = tmp_path / "checkpoint.pt"
    for version in (1, 99):  # version 1 stored no exposures, so none of its runs can resume
        path.write_bytes(seal_content({"version": version, "settings": "{}", "progress": "{}", "tensors": {}}))
        with pytest.raises(HyrfTrainingError, match="another version of hyrfpack; train anew with `overwrite=True`"):
            load_checkpoint(path, {})


class Malicious:
    """Creates a folder when it is unpickled."""

    def __init__(self, target) -> None:
        self.target = target

    def __reduce__(self):
        return os.mkdir, (str(self.target),)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("how", ["torch", "torch, deep inside", "torch, legacy", "pickle"])
def test_a_malicious_pickle_is_never_executed(tmp_path, how):
    path, target = tmp_path / "checkpoint.pt", tmp_path / "executed"
    evil = Malicious(target)
    if how == "pickle":
        data = pickle.dumps(evil)
        path.write_bytes(data + hashlib.sha256(data).digest())
    else:
        inside = {"version": 1, "settings": "{}", "progress": "{}", "tensors": {"model.a": evil}}
        path.write_bytes(
            seal_content(inside if "deep" in how else evil, _use_new_zipfile_serialization="legacy" not in how)
        )

    with pytest.raises(HyrfTrainingError, match="damaged"):
        load_checkpoint(path, {})

    assert not target.exists()
    if how == "pickle":  # the trap works in an unprotected load
        pickle.loads(path.read_bytes())
        assert target.exists()
