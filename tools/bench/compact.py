"""Speed, size and memory of `compact` files, with and without Numba, beside `raw` files of the same models.

The models are drawn: points near a wavy surface, logits that vary slowly with some noise on top, and sensitivities
that spread over decades as those of trained models do. What a trained model loses is for `bench/` to say; here the
error is that of the explicit logits, against the model that was coded.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
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
from tools.safety.plans import drawn_sensitivity

SIZES = ((100_000, 14), (1_000_000, 17))  # Gaussians, log2 of the radiance table; that of geometry is half as large
REPEATS = 3
DISTORTION = 2e-6


def drawn_model(count: int, log2_table_size: int) -> HybridModel:
    """A model with `count` Gaussians."""
    rng = np.random.default_rng(0)
    frame = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))
    config = ModelConfig(frame, HashGridConfig(log2_table_size - 1), HashGridConfig(log2_table_size))
    places = rng.uniform(-1, 1, (count, 3))
    places[:, 2] = 0.3 * np.sin(4 * places[:, 0]) + rng.normal(0, 0.02, count)
    waves = np.sin(places @ rng.normal(0, 8, (3, 5)))
    logits = torch.from_numpy(waves + rng.normal(0, 0.3, (count, 5))).float()
    gaussians = Gaussians(torch.from_numpy(places).float(), logits[:, :3], logits[:, 3:4], logits[:, 4:])
    model = HybridModel(config, gaussians, torch.Generator().manual_seed(0))
    arrays = to_arrays(model)
    for group in TABLE_SECTIONS:
        arrays[group] = rng.normal(0, 0.1, arrays[group].shape).astype(np.float32)
    return to_model(config, arrays)


def bench() -> list[dict]:
    """Time all ways, interleaved; medians.

    Returns:
        A row for each size and way: bytes, times, the largest root mean square error of an explicit logit, and the
        peak of what numpy holds while decoding, over the decoded model.
    """
    return [row for size in SIZES for row in _bench_model(*size)]


def _bench_model(count: int, log2_table_size: int) -> list[dict]:
    model = drawn_model(count, log2_table_size)
    sensitivity = drawn_sensitivity(model)
    make = partial(make_plan, model, sensitivity, DISTORTION, prune=False)
    plan = make()
    ways = {"compact (cpu)": True, "compact (numpy)": False} if has_numba() else {"compact (numpy)": False}

    def encode() -> bytes:
        return encode_model(model, "compact", quantized=quantize(plan.apply(model), plan, sensitivity))

    planning, _ = time_alternately({"plan": make}, REPEATS)
    encoders = {"raw": partial(encode_model, model), **{way: _with_numba(fast, encode) for way, fast in ways.items()}}
    encoding, files = time_alternately(encoders, REPEATS)
    if len({files[way] for way in ways}) > 1:
        raise AssertionError("the bytes depend on whether there is Numba")
    decoders = {way: _with_numba(ways.get(way, True), partial(decode_model, data)) for way, data in files.items()}
    decoding, models = time_alternately(decoders, REPEATS)
    return [
        {
            "gaussians": count,
            "profile": way,
            "bytes": len(data),
            "plan_ms": planning["plan"].ms if way in ways else None,
            "encode_ms": encoding[way].ms,
            "decode_ms": decoding[way].ms,
            "decode_over_raw": decoding[way].ratio_to(decoding["raw"]).wall,
            "decode_work_ms": decoding[way].work_ms,
            "peak_over_model": _peak(decoders[way]) / sum(4 * p.numel() for p in model.parameters()),
            "rms_error": _error(models[way], model, plan if way in ways else None),
        }
        for way, data in files.items()
    ]


def _with_numba(fast: bool, task: Callable[[], object]) -> Callable[[], object]:
    """The task with compiled kernels, or as it is where Numba is missing."""

    def run() -> object:
        with mock.patch("hyrfpack.quant.rans.has_numba", lambda: fast):
            return task()

    return run


def _peak(task: Callable[[], object]) -> float:
    """Most bytes that numpy holds at once during a task."""
    tracemalloc.start()
    try:
        task()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def _error(decoded: HybridModel, model: HybridModel, plan: Plan | None) -> float:
    """Root mean square error of the explicit logits, of the worst group."""
    order = slice(None) if plan is None else plan.kept
    after, before = to_arrays(decoded), to_arrays(model)
    return max(float(np.sqrt(np.square(after[group] - before[group][order]).mean())) for group in LOGIT_SECTIONS)


def main() -> None:
    """Print the rows."""
    for row in bench():
        print(row)


if __name__ == "__main__":
    main()
