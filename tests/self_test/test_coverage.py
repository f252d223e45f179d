"""The self-test compiles every variant of the kernels that default training and rendering launch."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import pytest
import torch
from fake_gpu import FakeGpuTensor, use_fake_gpu
from ops.device import IS_INTERPRETED, needs_triton
from scenes import ball_scene
from torch.utils._pytree import tree_map

from hyrfpack.render import render_view
from hyrfpack.self_test.cases import list_self_test_cases
from hyrfpack.self_test.check import run_case
from hyrfpack.train import DensityConfig, TrainConfig, Trainer

pytestmark = [
    needs_triton,
    pytest.mark.skipif(not IS_INTERPRETED, reason="kernels are compiled for the GPU that is there"),
    pytest.mark.acceptance,
]
# Kernels that the interpreter takes seconds for, and whose results decide on no later launch.
SLOW_KERNELS = ("blend", "blend_backward", "grad_table_kernel", "_loss_kernel", "_gradient_kernel")


@contextmanager
def record_variants(not_run: tuple[str, ...] = ()) -> Iterator[set[str]]:
    """Collect the kernel and the specialisation of each launch in this context; some kernels are not run."""
    interpreter = pytest.importorskip("triton.runtime.interpreter")
    launch, variants = interpreter.InterpretedFunction.run, set()

    def run(self: Any, *args: Any, grid: Any, warmup: bool, **kwargs: Any) -> Any:
        variants.add(describe_variant(self, dict(zip(self.arg_names, args, strict=False)) | kwargs))
        if self.fn.__name__ not in not_run:
            return launch(self, *args, grid=grid, warmup=warmup, **kwargs)

    with mock.patch.object(interpreter.InterpretedFunction, "run", run):
        yield variants


def describe_variant(kernel: Any, given: dict[str, Any]) -> str:
    """Return a kernel's name with what Triton compiles it for: constants, types, alignment, and arguments 1 and None.

    Whether an integer is a multiple of 16 is left out, because it depends on numbers of points and pixels.
    """
    from triton.backends.compiler import BaseBackend
    from triton.runtime.jit import native_specialize_impl

    def describe(kind: Any, value: Any) -> Any:
        if isinstance(kind, tuple):
            return tuple(map(describe, kind, value))
        return kind if kind.startswith("i") else (kind, value)

    parts = [f"{kernel.fn.__module__}.{kernel.fn.__name__}"]
    for name, value in given.items():
        if name not in kernel.arg_names or "constexpr" in str(kernel.fn.__annotations__.get(name)):
            parts.append(f"{name}={tree_map(lambda part: getattr(part, 'value', part), value)}")
            continue
        value = tree_map(lambda part: part.cpu_tensor if isinstance(part, FakeGpuTensor) else part, value)
        is_specialized = name not in (kernel.kwargs["do_not_specialize"] or ())
        specialization = native_specialize_impl(BaseBackend, value, False, is_specialized, True)
        parts.append(f"{name}: {describe(*specialization)}")
    return ", ".join(parts)


@pytest.fixture(scope="module")
def tested_variants() -> set[str]:
    with use_fake_gpu() as gpu, record_variants(not_run=SLOW_KERNELS) as variants:
        for case in list_self_test_cases().values():
            run_case(case, "gpu", torch.float32, gpu)
    return variants


@pytest.fixture(scope="module")
def trained() -> Iterator[tuple[Trainer, set[str]]]:
    """A trainer that has taken two steps on a fake GPU, with default settings, and the variants that it launched."""
    scene = ball_scene(views=3, points=20, side=26)  # more rows than a program of the loss takes
    scene = dataclasses.replace(scene, test=scene.train[:1])
    density = DensityConfig(start=1.0, stop=1.0, rounds=1)
    config = TrainConfig(steps=3, max_gaussians=20, density=density, log2_table_size=5, exposure=False)
    with use_fake_gpu() as gpu, record_variants(not_run=("grad_table_kernel",)) as variants:
        trainer = Trainer(scene, config, device=gpu)
        trainer.run(stop=lambda: trainer.step > 1)
        yield trainer, set(variants)


def test_the_self_test_covers_a_training_step(tested_variants, trained):
    _, variants = trained
    assert len(variants) > 25 and any("adam_step_kernel" in variant for variant in variants)
    assert not variants - tested_variants, "\n".join(sorted(variants - tested_variants))


@pytest.mark.parametrize("keeps_decoded", [True, False])
def test_the_self_test_covers_a_frame(tested_variants, trained, keeps_decoded):
    trainer, _ = trained
    camera = trainer.scene.train[0].camera
    with torch.no_grad(), record_variants() as variants:
        render_view(trainer.model, camera, decoded=trainer.model.decode() if keeps_decoded else None)
    assert len(variants) > 5
    assert not variants - tested_variants, "\n".join(sorted(variants - tested_variants))
