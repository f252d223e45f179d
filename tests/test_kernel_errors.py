"""A GPU kernel that cannot be compiled or launched is one sentence that names it, and plain torch can replace it."""

from __future__ import annotations

import pytest
import torch
from commands import refused
from fake_gpu import use_fake_gpu
from ops.device import IS_INTERPRETED, needs_triton

from hyrfpack import device as devices
from hyrfpack.device import choose_device
from hyrfpack.kernel_errors import describe_kernel_error
from hyrfpack.ops import dispatch
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.dispatch import GPU_OPERATIONS, replaced_operations

pytestmark = [needs_triton, pytest.mark.skipif(not IS_INTERPRETED, reason="launches of the interpreter are replaced")]


@pytest.fixture
def fail_launches(monkeypatch):
    """A function that makes each launch of a kernel raise an error."""

    def make(error):
        def fail(*arguments, **options):
            raise error

        monkeypatch.setattr("triton.runtime.interpreter.GridExecutor.__call__", fail)

    return make


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RuntimeError("Triton Error [CUDA]: device kernel image is invalid"), None),
        (OSError(28, "No space left on device", "/root/.triton/cache"), None),
        (
            Exception("at 3:11:\n    tl.store(x, y)\n           ^\nbfloat16 is not supported"),
            "bfloat16 is not supported",
        ),
    ],
)
def test_an_error_in_triton_names_the_kernel_and_the_reason(fail_launches, error, reason):
    fail_launches(error)
    with pytest.raises(type(error)) as caught:
        contract(torch.zeros(2, 3), implementation="gpu")
    assert describe_kernel_error(caught.value) == (
        f"the GPU kernel contract_points of hyrfpack.ops.contraction cannot be compiled or launched ({reason or error})"
    )


def test_an_error_of_an_operation_or_of_a_caller_is_no_error_of_a_kernel():
    with pytest.raises(ValueError, match="do not end in 3") as caught:
        contract(torch.zeros(2, 4), implementation="gpu")
    assert describe_kernel_error(caught.value) is None
    assert describe_kernel_error(RuntimeError("Triton Error [CUDA]: never raised")) is None


def test_a_command_ends_with_the_sentence_and_how_to_go_on(fail_launches, monkeypatch):
    fail_launches(RuntimeError("PTXAS error"))
    monkeypatch.setattr(
        "hyrfpack.doctor.diagnose_machine", lambda *_, **__: contract(torch.zeros(2, 3), implementation="gpu")
    )
    message = refused("doctor")
    assert "the GPU kernel contract_points of hyrfpack.ops.contraction cannot be compiled or launched" in message
    assert "'hyrfpack doctor'" in message and "HYRFPACK_PLAIN_TORCH=1" in message


@pytest.fixture
def untested(monkeypatch):
    """A process that has tested no kernels yet."""
    monkeypatch.setattr(dispatch, "_replaced_operations", frozenset())
    devices._find_failed_operations.cache_clear()
    yield
    devices._find_failed_operations.cache_clear()


@pytest.mark.parametrize(("value", "is_plain"), [("1", True), ("0", False), ("", False)])
def test_the_environment_replaces_all_kernels_and_skips_testing(value, is_plain, untested, fail_launches, monkeypatch):
    monkeypatch.setenv("HYRFPACK_PLAIN_TORCH", value)
    assert replaced_operations() == (set(GPU_OPERATIONS) if is_plain else set())
    if is_plain:
        with use_fake_gpu() as gpu:
            monkeypatch.setattr("hyrfpack.device.load_or_run_self_test", lambda _: pytest.fail("the self-test was run"))
            fail_launches(RuntimeError("a launch"))
            choose_device("cuda")
            assert contract(torch.zeros(2, 3, device=gpu)).cpu().tolist() == 2 * [[0.5, 0.5, 0.5]]
