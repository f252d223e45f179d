"""Settings of the renderer: time of a picture against what each setting changes in it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from hyrfpack.bench.rows import Row, in_words
from hyrfpack.bench.subject import Subject
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.render import RenderSettings, render

# What is tried of each setting, the exact value first. `near` is not among them: it says what belongs to the picture.
# Nor is no culling at all the exact picture: EWA projection linearises about a centre, far outside the picture it
# smears Gaussians all over it, and training culls as rendering does, so nothing ever taught them otherwise.
SWEEPS: dict[str, tuple[Any, ...]] = {
    "background_threshold": (0.0, 1 / 512, 1 / 255, 0.01, 0.03, 0.1, 0.2, 0.3),
    "background_stride": (1, 2, 3, 4),
    "cull_tolerance": (1.0, 0.0, 0.1, 0.2, 0.3, 0.5, math.inf),
    "transmittance_min": (0.0, 1e-5, 1e-4, 1e-3, 1 / 255, 0.01, 0.03),
}
EXACT = RenderSettings(**{name: values[0] for name, values in SWEEPS.items()})
NEEDS_BACKGROUND = ("background_threshold", "background_stride")

Pictures = Callable[[], list[Tensor]]


@torch.no_grad()
def render_rows(subject: Subject, repeats: int, note: Callable[[str], None]) -> Iterator[Row]:
    """One setting at a time away from the defaults, then all of them together.

    The reference of a setting has this one at its exact value and all others at their defaults: its time is the one
    that a user would save, and the error is this setting's own. "all" compares the defaults with everything exact.
    """
    model, defaults = subject.model, RenderSettings()
    decoded = model.decode()

    def pictures(settings: RenderSettings, model: HybridModel = model, keep: bool = True) -> Pictures:
        kept = decoded if keep else None
        return lambda: [render(model, camera, settings, decoded=kept).rgb for camera in subject.cameras]

    pictures(defaults)()  # compiles kernels that are not cached: not to be taken for a slow first run
    for name, values in SWEEPS.items():
        if name in NEEDS_BACKGROUND and not model.config.background:
            note(f"the model has no background sphere, so {name} is left out")
            continue
        default = getattr(defaults, name)
        exact, others = values[0], sorted({*values[1:], default})
        tried = {in_words(value): pictures(replace(defaults, **{name: value})) for value in (exact, *others)}
        yield from _compare(subject, name, tried, in_words(default), repeats)
    tried = {"for each view": pictures(defaults, keep=False), "once": pictures(defaults)}
    yield from _compare(subject, "decoding", tried, "once", repeats)
    other = copy.copy(model)
    other.config = replace(model.config, antialiased=not model.config.antialiased)
    words = ["on" if one.config.antialiased else "off" for one in (model, other)]
    tried = {words[0]: pictures(defaults), words[1]: pictures(defaults, other)}
    yield from _compare(subject, "antialiased", tried, words[0], repeats)
    yield from _compare(subject, "all", {"exact": pictures(EXACT), "defaults": pictures(defaults)}, "defaults", repeats)


def _compare(subject: Subject, setting: str, tried: dict[str, Pictures], default: str, repeats: int) -> Iterator[Row]:
    """Rows of one setting; the first value is the reference."""
    times, results = time_alternately(tried, repeats)
    times = {value: time.per_part(len(subject.cameras)) for value, time in times.items()}
    reference = next(iter(tried))
    exact = results[reference]
    best = subject.scores(exact, exact)
    for value, pictures in results.items():
        yield Row(
            group="render",
            setting=setting,
            value=value,
            is_reference=value == reference,
            is_default=value == default,
            time=times[value],
            ratio=times[value].ratio_to(times[reference]),
            **subject.losses(pictures, exact, best, f"render, {setting} {value}"),
        )
