"""The layers of tests, see tests/layers.py."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from layers import LAYER_BY_PATH, LAYERS, TESTS_FOLDER, forbid_training_and_processes, layer_of
from ops.device import needs_triton
from scenes import ball_scene

from hyrfpack.train import TrainConfig
from hyrfpack.train.trainer import Trainer


def test_every_listed_path_exists_and_has_a_known_layer():
    assert [path for path in LAYER_BY_PATH if not (TESTS_FOLDER / path).exists()] == []
    assert set(LAYER_BY_PATH.values()) <= set(LAYERS)


def test_a_test_without_a_mark_has_the_layer_of_its_path(request):
    assert layer_of(request.node) == "integration"


@pytest.mark.unit
def test_a_mark_at_the_test_decides(request):
    assert layer_of(request.node) == "unit"


@pytest.mark.smoke
@pytest.mark.acceptance
def test_every_smoke_test_is_an_acceptance_test(request):
    smoke_tests = [item for item in request.session.items if item.get_closest_marker("smoke")]
    assert {layer_of(item) for item in smoke_tests} == {"acceptance"}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_training_and_processes_are_errors_where_they_are_forbidden():
    trainer = Trainer(ball_scene(views=2, side=16), TrainConfig(steps=1, max_gaussians=50))

    refusal = pytest.raises(AssertionError, match="give it the mark of another layer")
    with forbid_training_and_processes():
        with refusal:
            os.fork()
        with refusal:
            trainer.run()
        with refusal:
            subprocess.run([sys.executable, "-c", ""], check=True)

    assert trainer.run()


# Triton builds for a named GPU without one, with the compiler that it starts for a real one.
UNIT_TEST_THAT_COMPILES = """
import pytest
import triton
import triton.language as tl
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

@triton.jit
def triple(x, COUNT: tl.constexpr):
    i = tl.arange(0, COUNT)
    tl.store(x + i, tl.load(x + i) * 3)

@pytest.mark.unit
def test_compilation():
    source = ASTSource(fn=triple, signature={"x": "*fp32", "COUNT": "constexpr"}, constexprs={(1,): 64})
    assert triton.compile(source, target=GPUTarget("cuda", 90, 32)).asm["cubin"]
"""


@needs_triton
@pytest.mark.acceptance
def test_a_unit_test_may_compile_kernels_for_a_gpu(tmp_path):
    (tmp_path / "test_compilation.py").write_text(UNIT_TEST_THAT_COMPILES)
    environment = {**os.environ, "TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path / "cache")}
    environment["PYTHONPATH"] = os.pathsep.join((str(TESTS_FOLDER), str(TESTS_FOLDER.parent)))
    command = [sys.executable, "-m", "pytest", "-p", "conftest", "-p", "no:cacheprovider", "test_compilation.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr
