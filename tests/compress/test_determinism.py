"""One model and one plan give one file: with and without compiled kernels, on any number of threads, every time."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scenes import small_model

from hyrfpack.compress.quantize import quantize
from hyrfpack.format import encode_model
from hyrfpack.model import HybridModel
from tools.safety.synthetic_encoding import draw_sensitivity, encode, quantize_with_drawn_sensitivity

ROOT = Path(__file__).parents[2]
COUNT = 3000


def a_model(count: int = COUNT) -> HybridModel:
    rng = np.random.default_rng(0)
    return small_model(
        rng.normal(size=(count, 3)) * 0.6,
        fields=0.3,
        color_logits=rng.normal(size=(count, 3)),
        scale_logits=rng.normal(-4, 1, size=(count, 1)),
        opacity_logits=rng.normal(0, 3, size=(count, 1)),
    )


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


# The plan comes from the test: what is measured may differ in its last bits without compiled kernels.
SCRIPT = """
import pickle, sys
sys.path += {paths!r}
if {blocked}:
    sys.modules["numba"] = None
from test_determinism import a_model, digest
from hyrfpack.compress.quantize import quantize
from hyrfpack.format import encode_model
from hyrfpack.parallel import has_numba
assert has_numba() != {blocked}
plan, sensitivity = pickle.load(open({plan!r}, "rb"))
model = a_model()
print(digest(encode_model(model, "compact", quantized=quantize(plan.apply(model), plan, sensitivity))))
"""


@pytest.mark.parametrize("blocked", [False, True], ids=["compiled", "numpy"])
def test_compiled_kernels_and_numpy_write_the_same_bytes(blocked, tmp_path):
    model = a_model()
    quantized = quantize_with_drawn_sensitivity(model, layered=True)
    (tmp_path / "plan").write_bytes(pickle.dumps((quantized.plan, draw_sensitivity(model))))
    paths = [str(Path(__file__).parent), str(ROOT / "tests"), str(ROOT)]
    script = SCRIPT.format(paths=paths, blocked=blocked, plan=str(tmp_path / "plan"))

    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=os.environ, check=False)

    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == digest(encode_model(model, "compact", quantized=quantized))


@pytest.mark.parametrize("layered", [False, True])
def test_one_thread_and_two_write_the_same_bytes_again_and_again(layered, monkeypatch):
    written = set()
    for threads in ("1", "2", "2", "3"):
        monkeypatch.setenv("HYRFPACK_THREADS", threads)
        written.add(digest(encode(a_model(), "compact", layered=layered)))

    assert len(written) == 1


def test_gaussians_in_another_order_give_the_same_file():
    model, other = a_model(), a_model()
    order = np.random.default_rng(1).permutation(COUNT)
    for name in other.gaussians.PARAMETER_NAMES:
        getattr(other.gaussians, name).data = getattr(model.gaussians, name).data[order]
    quantized = quantize_with_drawn_sensitivity(model, prune=False)
    moved = dataclasses.replace(quantized.plan, kept=np.argsort(order)[quantized.plan.kept])

    again = quantize(moved.apply(other), moved, draw_sensitivity(model).subset(order))

    assert encode_model(other, "compact", quantized=again) == encode_model(model, "compact", quantized=quantized)
