"""Running out of memory is one sentence with what to reduce, and on one of several processes it ends all of them."""

from __future__ import annotations

import pytest
import torch
from commands import refused
from scenes import ball_scene, camera_at, small_model

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.out_of_memory import explain_out_of_memory
from hyrfpack.train import TrainConfig, Trainer

GPU_ERROR = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nSee the documentation")


def fail(*arguments, **options):
    raise GPU_ERROR


def test_a_gpu_without_memory_is_one_sentence():
    with pytest.raises(HyrfError) as caught, explain_out_of_memory("reduce it"):
        fail()
    expected = (
        "the GPU's memory ran out (CUDA out of memory. Tried to allocate 2.00 GiB.); reduce it, or use `device='cpu'`"
    )
    assert str(caught.value) == expected


@pytest.mark.parametrize(
    "message",
    [
        "CUDA error: out of memory\nCUDA kernel errors might be asynchronously reported at some other API call",
        "CUDA driver error: out of memory",
        "HIP error: out of memory",
        "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
        "cuDNN error: CUDNN_STATUS_ALLOC_FAILED",
        "cusolver error: CUSOLVER_STATUS_ALLOC_FAILED, when calling `cusolverDnCreate(handle)`",
        "Triton Error [CUDA]: out of memory",
        "Triton Error [HIP]:  Code: 2, Messsage: out of memory",
    ],
)
def test_errors_of_the_driver_and_of_triton_that_memory_ran_out_are_recognised(message):
    with pytest.raises(HyrfError) as caught, explain_out_of_memory("reduce it"):
        raise RuntimeError(message)
    said = f"the GPU's memory ran out ({message.splitlines()[0]}); reduce it"
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize("allocate", [lambda: torch.empty(1 << 55), lambda: bytearray(1 << 55)])
def test_a_machine_without_memory_is_one_sentence(allocate):
    with pytest.raises(HyrfError, match=r"memory ran out \(.*\); reduce it$"), explain_out_of_memory("reduce it"):
        allocate()


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (
            "[enforce fail at alloc.cpp:1] err. DefaultCPUAllocator: can't allocate 8 bytes\nmore",
            "can't allocate 8 bytes",
        ),
        ("DefaultCPUAllocator failed", "DefaultCPUAllocator failed"),
    ],
)
def test_the_reason_of_the_cpu_allocator_is_quoted(message, reason):
    with pytest.raises(HyrfError) as caught, explain_out_of_memory("reduce it"):
        raise RuntimeError(message)
    assert str(caught.value) == f"memory ran out ({reason}); reduce it"


@pytest.mark.parametrize("message", ["shapes differ", "CUDA error: an illegal memory access was encountered"])
def test_any_other_error_passes(message):
    with pytest.raises(RuntimeError, match=message), explain_out_of_memory("reduce it"):
        raise RuntimeError(message)


@pytest.mark.parametrize("place", ["train.gradients.photometric_loss", "render.renderer._select_gaussians"])
def test_a_training_step_names_the_settings_of_training(place, monkeypatch):
    trainer = Trainer(ball_scene(views=3, points=20, side=8), TrainConfig(steps=2, max_gaussians=20, log2_table_size=5))
    monkeypatch.setattr(f"hyrfpack.{place}", fail)
    with pytest.raises(HyrfError, match="GPU's memory ran out.*reduce `max_gaussians` or `max_size`"):
        trainer.run()


def test_a_render_names_the_size_of_the_picture(monkeypatch):
    monkeypatch.setattr("hyrfpack.render.renderer._select_gaussians", fail)
    with pytest.raises(HyrfError, match="GPU's memory ran out.*render a smaller picture"):
        hyrfpack.render_view(small_model([(0, 0, 0)]), camera_at((0.0, -2.0, 0.5), width=8, height=8))


def test_a_command_ends_with_the_sentence(monkeypatch):
    monkeypatch.setattr("hyrfpack.doctor.diagnose_machine", fail)
    assert "the GPU's memory ran out" in refused("doctor") and "--device cpu" in refused("doctor")


def test_a_command_advises_another_device_only_if_a_gpu_lacks_memory(monkeypatch):
    def fail_on_cpu(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 40. GiB")

    monkeypatch.setattr("hyrfpack.doctor.diagnose_machine", fail_on_cpu)
    message = refused("doctor")
    assert "memory ran out" in message and "use smaller photos" in message and "--device" not in message
