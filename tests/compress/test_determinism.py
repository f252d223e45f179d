"""A model and a plan determine the file: with or without compiled kernels and on any number of threads."""

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
from hyrfpack.parallel import has_numba
from tools.safety.synthetic_encoding import draw_sensitivity, encode, quantize_with_drawn_sensitivity

PROJECT_FOLDER = Path(__file__).parents[2]
GAUSSIAN_COUNT = 3000


def random_model(count: int = GAUSSIAN_COUNT) -> HybridModel:
    rng = np.random.default_rng(0)
    return small_model(
        rng.normal(size=(count, 3)) * 0.6,
        fields=0.3,
        color_logits=rng.normal(size=(count, 3)),
        scale_logits=rng.normal(-4, 1, size=(count, 1)),
        opacity_logits=rng.normal(0, 3, size=(count, 1)),
    )


def sha256_hex(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


# The plan comes from the test, because measured sensitivities may differ in their last bits without compiled kernels.
ENCODE_SCRIPT = """
import pickle, sys
sys.path += {paths!r}
sys.modules["numba"] = None
from test_determinism import random_model, sha256_hex
from hyrfpack.compress.quantize import quantize
from hyrfpack.format import encode_model
from hyrfpack.parallel import has_numba
assert not has_numba()
plan, sensitivity = pickle.load(open({plan!r}, "rb"))
model = random_model()
print(sha256_hex(encode_model(model, "compact", quantized=quantize(plan.apply(model), plan, sensitivity))))
"""


def test_compiled_kernels_and_numpy_encode_to_the_same_bytes(tmp_path):
    assert has_numba()
    model = random_model()
    quantized = quantize_with_drawn_sensitivity(model, layered=True)
    (tmp_path / "plan").write_bytes(pickle.dumps((quantized.plan, draw_sensitivity(model))))
    paths = [str(Path(__file__).parent), str(PROJECT_FOLDER / "tests"), str(PROJECT_FOLDER)]
    script = ENCODE_SCRIPT.format(paths=paths, plan=str(tmp_path / "plan"))

    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=os.environ, check=False)

    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == sha256_hex(encode_model(model, "compact", quantized=quantized))


@pytest.mark.parametrize("layered", [False, True])
def test_one_and_two_threads_repeatedly_encode_to_the_same_bytes(layered, monkeypatch):
    written = set()
    for threads in ("1", "2", "2", "3"):
        monkeypatch.setenv("HYRFPACK_THREADS", threads)
        written.add(sha256_hex(encode(random_model(), "compact", layered=layered)))

    assert len(written) == 1


def test_the_file_does_not_depend_on_the_order_of_gaussians():
    model, other = random_model(), random_model()
    order = np.random.default_rng(1).permutation(GAUSSIAN_COUNT)
    for name in other.gaussians.PARAMETER_NAMES:
        getattr(other.gaussians, name).data = getattr(model.gaussians, name).data[order]
    quantized = quantize_with_drawn_sensitivity(model, prune=False)
    moved = dataclasses.replace(quantized.plan, kept=np.argsort(order)[quantized.plan.kept])

    again = quantize(moved.apply(other), moved, draw_sensitivity(model).subset(order))

    assert encode_model(other, "compact", quantized=again) == encode_model(model, "compact", quantized=quantized)
