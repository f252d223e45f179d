from __future__ import annotations

import hashlib
import io
import os
import pickle
import random

import pytest
import torch

from hyrfpack.errors import HyrfTrainingError
from hyrfpack.train.checkpoint import load_checkpoint, save_checkpoint, saved_decisions

SETTINGS = {"steps": 40, "rates": (1e-3, 1e-5), "views": [["a.png", 4, 3]], "budget": None}
PROGRESS = {"step": 12, "records": [{"step": 1, "loss": 0.25}], "seconds": {"data": 0.5}}


def some_tensors() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {"model.a": torch.randn(40, 3, generator=generator), "adam.step": torch.tensor(12.0)}


def sealed(content, **options) -> bytes:
    """What a writer with bad intent would make: any content, with the right digest."""
    buffer = io.BytesIO()
    torch.save(content, buffer, **options)
    return buffer.getvalue() + hashlib.sha256(buffer.getvalue()).digest()


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, settings=SETTINGS, tensors=some_tensors(), progress=PROGRESS)
    return path


def test_what_was_saved_comes_back(path):
    tensors, progress = load_checkpoint(path, SETTINGS)
    assert progress == PROGRESS
    assert tensors.keys() == some_tensors().keys()
    assert all(torch.equal(tensors[name], value) for name, value in some_tensors().items())


@pytest.mark.parametrize("factor", [None, 0.25, 1])
@pytest.mark.parametrize("exposure", [False, True])
def test_what_pilots_decided_can_be_read_back(path, factor, exposure):
    decided = {"budget_factor": factor, "exposure": exposure}
    save_checkpoint(path, settings={**SETTINGS, **decided}, tensors={}, progress=PROGRESS)
    assert saved_decisions(path) == (factor, exposure)


def test_a_checkpoint_from_before_such_decisions_has_none(path):
    assert saved_decisions(path) == (None, False)


def test_an_exposure_that_is_neither_on_nor_off_is_damage(path):
    save_checkpoint(path, settings={**SETTINGS, "exposure": None}, tensors={}, progress=PROGRESS)
    with pytest.raises(HyrfTrainingError, match="damaged"):
        saved_decisions(path)


@pytest.mark.parametrize("factor", ["1", -1.0, float("nan"), float("inf"), [1.0], True])
def test_a_budget_factor_that_is_none_is_damage(path, factor):
    save_checkpoint(path, settings={**SETTINGS, "budget_factor": factor}, tensors={}, progress=PROGRESS)
    with pytest.raises(HyrfTrainingError, match="damaged"):
        saved_decisions(path)


def test_only_the_checkpoint_is_left_in_the_folder(path):
    assert [entry.name for entry in path.parent.iterdir()] == ["checkpoint.pt"]


def test_a_missing_checkpoint_is_said_to_be_missing(tmp_path):
    with pytest.raises(HyrfTrainingError, match="no checkpoint to resume from"):
        load_checkpoint(tmp_path / "checkpoint.pt", SETTINGS)


@pytest.mark.parametrize(
    ("change", "named"),
    [({"steps": 41}, "steps"), ({"budget": 5}, "budget"), ({"rates": (1e-3, 1e-4)}, "rates"), ({"new": 1}, "new")],
)
def test_other_settings_are_rejected_by_name(path, change, named):
    with pytest.raises(HyrfTrainingError, match=rf"other settings \({named}\)"):
        load_checkpoint(path, {**SETTINGS, **change})


def test_a_setting_that_is_gone_is_rejected_too(path):
    with pytest.raises(HyrfTrainingError, match=r"other settings \(budget, views\)"):
        load_checkpoint(path, {name: SETTINGS[name] for name in ("steps", "rates")} | {"budget": 7})


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.5, 0.9, 0.99])
def test_a_truncated_checkpoint_is_rejected(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(HyrfTrainingError, match="damaged"):
        load_checkpoint(path, SETTINGS)


@pytest.mark.parametrize("length", [1, 7, 100, 5000])
def test_random_bytes_are_rejected(tmp_path, length):
    path = tmp_path / "checkpoint.pt"
    for seed in range(20):
        path.write_bytes(random.Random(seed).randbytes(length))
        with pytest.raises(HyrfTrainingError, match="damaged"):
            load_checkpoint(path, SETTINGS)


def test_a_flipped_bit_anywhere_is_noticed(path):
    """In the numbers too: a run must not go on from others."""
    data = bytearray(path.read_bytes())
    generator = random.Random(0)
    for _ in range(300):
        place, bit = generator.randrange(len(data)), 1 << generator.randrange(8)
        data[place] ^= bit
        path.write_bytes(data)
        with pytest.raises(HyrfTrainingError, match="damaged"):
            load_checkpoint(path, SETTINGS)
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
def test_other_files_of_torch_are_rejected(tmp_path, content):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(sealed(content))
    with pytest.raises(HyrfTrainingError, match="damaged"):
        load_checkpoint(path, SETTINGS)
    torch.save(content, path)
    with pytest.raises(HyrfTrainingError, match="damaged"):
        load_checkpoint(path, SETTINGS)


def test_another_version_is_rejected(tmp_path):
    path = tmp_path / "checkpoint.pt"
    for version in (1, 99):  # 1 knew of no exposures, so that none of its runs can be gone on with
        path.write_bytes(sealed({"version": version, "settings": "{}", "progress": "{}", "tensors": {}}))
        with pytest.raises(HyrfTrainingError, match="another version of hyrfpack; train anew with `overwrite=True`"):
            load_checkpoint(path, {})


class Malicious:
    """Touches a file when unpickled."""

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
        path.write_bytes(sealed(inside if "deep" in how else evil, _use_new_zipfile_serialization="legacy" not in how))

    with pytest.raises(HyrfTrainingError, match="damaged"):
        load_checkpoint(path, {})

    assert not target.exists()
    if how == "pickle":  # the trap works where it is not guarded against
        pickle.loads(path.read_bytes())
        assert target.exists()
