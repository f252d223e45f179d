"""The result of the self-test is stored for each GPU and version, and decides which operations run as plain torch."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from fake_gpu import use_fake_gpu
from ops.device import needs_triton
from scenes import small_model

from hyrfpack import device as devices
from hyrfpack.device import choose_device
from hyrfpack.ops import dispatch
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.dispatch import GPU_OPERATIONS, replaced_operations, set_replaced_operations
from hyrfpack.self_test import SelfTest, load_or_run_self_test, store
from hyrfpack.self_test.store import load_self_test, store_self_test

pytestmark = needs_triton
FAILED_TEST = SelfTest(
    "gpu",
    "cuda:0",
    (
        {"item": "contract", "operation": "contract", "status": "failed", "note": "coords is NaN", "slowdown": 2.5},
        {"item": "mlp", "operation": "mlp", "status": "failed", "note": "its process ended by SIGSEGV"},
        {"item": "adam_step", "operation": "adam_step", "value error": 1e-8},
    ),
)


@pytest.fixture
def gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """A fake GPU, an empty cache folder, and a process that has tested no kernels yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(dispatch, "_replaced_operations", frozenset())
    devices._find_failed_operations.cache_clear()
    with use_fake_gpu() as device:
        monkeypatch.setattr(devices, "load_or_run_self_test", load_or_run_self_test)
        yield device
    devices._find_failed_operations.cache_clear()


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[torch.device]:
    """The devices that were tested; each test finds two broken operations."""
    tested: list[torch.device] = []

    def run(implementation: str, device: torch.device) -> SelfTest:
        tested.append(device)
        return FAILED_TEST

    monkeypatch.setattr(store, "run_self_test", run)
    return tested


def test_the_first_use_of_a_gpu_tests_it_and_later_processes_read_the_result(gpu, runs, caplog):
    caplog.set_level("INFO", "hyrfpack")
    for _ in range(3):
        choose_device("cuda")
        devices._find_failed_operations.cache_clear()  # as in another process
        assert replaced_operations() == {"contract", "mlp"}
    assert runs == [gpu]
    assert [message.partition(",")[0] for message in caplog.messages if message.startswith("testing")] == [
        "testing the kernels on a GPU that is not there"
    ]


def test_a_warning_names_what_is_replaced_once(gpu, runs, caplog):
    for name in ("cuda", "cuda:0", "auto"):
        choose_device(name)
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "the kernels of 2 of 13 operations do not work on cuda:0 (a GPU that is not there)" in warning
    assert "contract (coords is NaN; plain torch takes 2.5 times as long on a small input)" in warning
    assert "mlp (its process ended by SIGSEGV)" in warning
    assert "'hyrfpack doctor'" in warning


@pytest.mark.parametrize("change", ["name", "driver", "torch", "triton", "hyrfpack", "kernels"])
def test_a_change_of_gpu_or_versions_tests_again(gpu, runs, change, monkeypatch):
    load_or_run_self_test(gpu)
    if change == "name":
        properties = torch.cuda.get_device_properties(gpu)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda *_: properties)
        properties.name = "another GPU"
    elif change == "driver":
        monkeypatch.setattr(store, "driver_version", lambda: "1.0")
    elif change == "torch":
        monkeypatch.setattr(torch, "__version__", "99")
    elif change == "triton":
        monkeypatch.setattr(store, "package_versions", lambda *names: {"triton": "99"})
    elif change == "hyrfpack":
        monkeypatch.setattr(store, "__version__", "99")
    else:
        monkeypatch.setattr(store, "_kernel_digest", lambda: "0")
    load_or_run_self_test(gpu)
    load_or_run_self_test(gpu)
    assert len(runs) == 2


def test_without_the_self_test_nothing_runs_and_all_kernels_are_used(gpu, runs):
    choose_device("cuda", self_test=False)
    choose_device(torch.device("cuda"))
    choose_device("cpu")
    assert not runs and not replaced_operations()


def test_a_test_that_could_not_run_is_not_stored_and_replaces_nothing(gpu, monkeypatch, caplog):
    monkeypatch.setattr(store, "run_self_test", lambda *_: SelfTest("gpu", "cuda:0", (), "the device is busy"))
    choose_device("cuda")
    assert not replaced_operations() and load_self_test(gpu) is None
    assert "could not be tested on cuda:0 (a GPU that is not there) (the device is busy)" in caplog.text


def test_a_triton_that_launches_nothing_runs_plain_torch_in_this_process_only(gpu, monkeypatch, caplog):
    problem = "Triton cannot compile and launch kernels here (Failed to find C compiler); install gcc"
    monkeypatch.setattr(store, "run_self_test", lambda *_: SelfTest("gpu", "cuda:0", (), problem, can_launch=False))
    choose_device("cuda")
    assert replaced_operations() == set(GPU_OPERATIONS) and load_self_test(gpu) is None
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warning == (
        f"{problem}; this run uses plain torch on cuda:0 (a GPU that is not there), far slower; `device='cpu'` may be "
        "faster"
    )


def test_a_failure_for_now_runs_plain_torch_in_this_process_and_is_tested_again(gpu, monkeypatch, caplog):
    rows = [{"item": name, "operation": name, "status": "failed", "note": "no memory"} for name in ("contract", "mlp")]
    untested = SelfTest("gpu", "cuda:0", tuple(row | {"is_temporary": True} for row in rows))
    monkeypatch.setattr(store, "run_self_test", lambda *_: untested)
    choose_device("cuda")
    assert replaced_operations() == {"contract", "mlp"} and load_self_test(gpu) is None
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warning == (
        "the kernels of 2 of 13 operations could not be tested on cuda:0 (a GPU that is not there), which computes "
        "them in plain torch in this run: contract, mlp (no memory); the next run tests them again"
    )


def test_a_warning_gives_a_reason_that_operations_share_once():
    rows = [{"item": name, "operation": name, "status": "failed", "note": "crashed"} for name in GPU_OPERATIONS]
    (sentence,) = devices.describe_failed_operations(SelfTest("gpu", "cuda:0", tuple(rows)), "cuda:0")
    assert sentence.count("crashed") == 1 and f"{', '.join(GPU_OPERATIONS)} (crashed)" in sentence


def test_an_operation_that_is_broken_in_one_case_is_not_called_untested():
    broken = {"item": "mlp", "operation": "mlp", "status": "failed", "note": "outputs is NaN"}
    untested = {"item": "mlp, mixed", "operation": "mlp", "status": "failed", "note": "late", "is_temporary": True}
    test = SelfTest("gpu", "cuda:0", (untested, broken))
    assert test.failed_operations == {"mlp": broken} and not test.is_conclusive


def test_mixed_precision_that_fails_alone_leaves_the_float32_kernels(gpu, monkeypatch, caplog):
    row = {"item": "mlp, mixed", "operation": "mixed_precision", "status": "failed", "note": "no bfloat16"}
    monkeypatch.setattr(store, "run_self_test", lambda *_: SelfTest("gpu", "cuda:0", (row,)))
    choose_device("cuda")
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warning == (
        "mixed precision does not work on cuda:0 (a GPU that is not there) (no bfloat16), which uses float32 kernels "
        "instead, as with `precision='float32'`"
    )
    model = small_model([(0, 0, 0)]).to(gpu)
    assert not replaced_operations() & set(GPU_OPERATIONS) and not model.compute_shading().mixed
    set_replaced_operations([])
    assert model.compute_shading().mixed


def stored_result(rows: object) -> str:
    return json.dumps({"result": {"implementation": "gpu", "device": "cuda:0", "rows": rows}})


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        '{"result": {}}',
        "\xff",
        *map(stored_result, (3, "abc", ["mlp"], [{"item": "mlp"}], [{"operation": "mlp"}])),
        stored_result([{"item": "mlp", "operation": "mlp", "status": "failed"}]),
    ],
)
def test_a_damaged_result_is_tested_again(gpu, runs, content):
    store_self_test(FAILED_TEST, gpu)
    store._path(gpu).write_text(content, encoding="latin-1")
    assert load_or_run_self_test(gpu) == FAILED_TEST and runs == [gpu]
    assert json.loads(store._path(gpu).read_text())["key"]["device"] == "a GPU that is not there"


def test_a_replaced_operation_runs_as_plain_torch_on_the_same_gpu(gpu, monkeypatch):
    monkeypatch.setattr("hyrfpack.ops.contraction.gpu.contract", lambda *_: pytest.fail("the kernel was launched"))
    points = torch.tensor([[0.0, 1.0, 2.0]], device=gpu)
    set_replaced_operations(["contract"])
    coords = contract(points)
    assert coords.device == gpu
    torch.testing.assert_close(coords.cpu(), contract(points.cpu()))


def test_an_unknown_operation_cannot_be_replaced():
    with pytest.raises(ValueError, match="no GPU operation 'blend'; there are activate_geometry, "):
        set_replaced_operations(["blend"])
