"""Measure speed, size and memory of `compact` files, with and without Numba, against `raw` files of the same models.

The models are random: points near a wavy surface, logits that vary slowly with added noise, and sensitivities that vary
by orders of magnitude, as in trained models. The error is that of the explicit logits against the encoded model;
`hyrfpack bench` measures what a trained model loses in pictures.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from unittest import mock

import numpy as np
import torch

from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.quantize import quantize
from hyrfpack.format.arrays import to_arrays, to_model
from hyrfpack.format.codec import decode_model, encode_model
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.sections import LOGIT_SECTIONS, TABLE_SECTIONS
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.parallel import has_numba
from tools.safety.synthetic_encoding import draw_sensitivity

# The modules that choose between Numba's kernels and others.
NUMBA_USERS = ("hyrfpack.quant.rans", "hyrfpack.ops.dispatch")
# Number of Gaussians and log2_table_size of the radiance grid; the geometry grid's table is half as large.
MODEL_SIZES = ((100_000, 14), (1_000_000, 17))
TIMING_REPEATS = 3
TARGET_DISTORTION = 2e-6


def make_random_model(count: int, log2_table_size: int) -> HybridModel:
    """Return a random model with `count` Gaussians and a radiance table of at most 2^log2_table_size rows per level."""
    rng = np.random.default_rng(0)
    frame = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))
    config = ModelConfig(frame, HashGridConfig(log2_table_size - 1), HashGridConfig(log2_table_size))
    positions = rng.uniform(-1, 1, (count, 3))
    positions[:, 2] = 0.3 * np.sin(4 * positions[:, 0]) + rng.normal(0, 0.02, count)
    waves = np.sin(positions @ rng.normal(0, 8, (3, 5)))
    logits = torch.from_numpy(waves + rng.normal(0, 0.3, (count, 5))).float()
    gaussians = Gaussians(torch.from_numpy(positions).float(), logits[:, :3], logits[:, 3:4], logits[:, 4:])
    model = HybridModel(config, gaussians, torch.Generator().manual_seed(0))
    arrays = to_arrays(model)
    for group in TABLE_SECTIONS:
        arrays[group] = rng.normal(0, 0.1, arrays[group].shape).astype(np.float32)
    return to_model(config, arrays)


def bench() -> list[dict]:
    """Time encoding and decoding with each profile and implementation in alternation; times are medians.

    Returns:
        A row for each model size and profile: bytes, times in ms, the largest root mean square error of a group of
        explicit logits, and numpy's peak memory while decoding over the decoded model's size.
    """
    return [row for size in MODEL_SIZES for row in _bench_model(*size)]


def _bench_model(count: int, log2_table_size: int) -> list[dict]:
    model = make_random_model(count, log2_table_size)
    sensitivity = draw_sensitivity(model)
    make = partial(make_plan, model, sensitivity, TARGET_DISTORTION, prune=False)
    plan = make()
    use_numba_by_profile = (
        {"compact (cpu)": True, "compact (numpy)": False} if has_numba() else {"compact (numpy)": False}
    )

    def encode() -> bytes:
        return encode_model(model, "compact", quantized=quantize(plan.apply(model), plan, sensitivity))

    planning, _ = time_alternately({"plan": make}, TIMING_REPEATS)
    encoders = {
        "raw": partial(encode_model, model),
        **{profile: _with_numba(use_numba, encode) for profile, use_numba in use_numba_by_profile.items()},
    }
    encoding, files = time_alternately(encoders, TIMING_REPEATS)
    if len({files[profile] for profile in use_numba_by_profile}) > 1:
        raise AssertionError("the bytes depend on whether there is Numba")
    decoders = {
        profile: _with_numba(use_numba_by_profile.get(profile, True), partial(decode_model, data))
        for profile, data in files.items()
    }
    decoding, models = time_alternately(decoders, TIMING_REPEATS)
    return [
        {
            "gaussians": count,
            "profile": profile,
            "bytes": len(data),
            "plan_ms": planning["plan"].ms if profile in use_numba_by_profile else None,
            "encode_ms": encoding[profile].ms,
            "decode_ms": decoding[profile].ms,
            "decode_over_raw": decoding[profile].ratio_to(decoding["raw"]).wall,
            "decode_work_ms": decoding[profile].work_ms,
            "peak_over_model": _measure_peak_bytes(decoders[profile]) / sum(4 * p.numel() for p in model.parameters()),
            "rms_error": _measure_logit_error(
                models[profile], model, plan if profile in use_numba_by_profile else None
            ),
        }
        for profile, data in files.items()
    ]


def _with_numba(use_numba: bool, task: Callable[[], object]) -> Callable[[], object]:
    """Return the task with Numba's kernels enabled, or disabled as on machines without Numba."""

    def run() -> object:
        with ExitStack() as stack:
            for module in NUMBA_USERS:
                stack.enter_context(mock.patch(f"{module}.has_numba", lambda: use_numba))
            return task()

    return run


def _measure_peak_bytes(task: Callable[[], object]) -> float:
    """Return numpy's peak memory during a task in bytes."""
    tracemalloc.start()
    try:
        task()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def _measure_logit_error(decoded: HybridModel, model: HybridModel, plan: Plan | None) -> float:
    """Return the root mean square error of the worst group of explicit logits."""
    order = slice(None) if plan is None else plan.kept
    decoded_arrays, model_arrays = to_arrays(decoded), to_arrays(model)
    return max(
        float(np.sqrt(np.square(decoded_arrays[group] - model_arrays[group][order]).mean())) for group in LOGIT_SECTIONS
    )
