"""Measure the renderer's settings: the time of a picture and the error that each setting causes."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from hyrfpack.bench.rows import Row, format_value
from hyrfpack.bench.subject import Subject
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.render import RenderSettings, render_view

# Values that are measured for each setting, the exact value first. `near` is left out, because it decides what belongs
# to the picture. The exact `cull_tolerance` is not infinity: EWA projection is linear about a Gaussian's centre, so it
# smears Gaussians far outside the picture across it. Training culls these and never optimises them for such views.
RENDER_SETTING_VALUES: dict[str, tuple[Any, ...]] = {
    "background_threshold": (0.0, 1 / 512, 1 / 255, 0.01, 0.03, 0.1, 0.2, 0.3),
    "background_stride": (1, 2, 3, 4, None),
    "cull_tolerance": (1.0, 0.0, 0.1, 0.2, 0.3, 0.5, math.inf),
    "transmittance_min": (0.0, 1e-5, 1e-4, 1e-3, 1 / 255, 0.01, 0.03),
}
EXACT_SETTINGS = RenderSettings(**{name: values[0] for name, values in RENDER_SETTING_VALUES.items()})
BACKGROUND_SETTINGS = ("background_threshold", "background_stride")

RenderTask = Callable[[], list[Tensor]]


@torch.no_grad()
def measure_renderer(subject: Subject, repeats: int, notes: list[str]) -> Iterator[Row]:
    """Measure the values of one setting at a time with the defaults of all others, then all settings together.

    The reference of a setting has its exact value. So the difference in time is what this setting saves, and the error
    is caused by it alone. The last setting, "all", compares the defaults with all exact values.
    """
    model, defaults = subject.model, RenderSettings()
    decoded = model.decode()

    def render_task(settings: RenderSettings, model: HybridModel = model, reuse_decoded: bool = True) -> RenderTask:
        reused = decoded if reuse_decoded else None
        return lambda: [render_view(model, camera, settings, decoded=reused).rgb for camera in subject.cameras]

    render_task(defaults)()  # compiles kernels that are not cached, which must not count as a slow first run
    for name, values in RENDER_SETTING_VALUES.items():
        if name in BACKGROUND_SETTINGS and not model.config.background:
            notes.append(f"the model has no background sphere, so {name} is left out")
            continue
        default = getattr(defaults, name)
        exact, other_values = values[0], list(dict.fromkeys((*values[1:], default)))
        tasks = {
            format_value(value): render_task(replace(defaults, **{name: value})) for value in (exact, *other_values)
        }
        yield from _compare(subject, name, tasks, format_value(default), repeats)
    tasks = {"for each view": render_task(defaults, reuse_decoded=False), "once": render_task(defaults)}
    yield from _compare(subject, "decoding", tasks, "once", repeats)
    toggled = copy.copy(model)
    toggled.config = replace(model.config, antialiased=not model.config.antialiased)
    states = ["on" if candidate.config.antialiased else "off" for candidate in (model, toggled)]
    tasks = {states[0]: render_task(defaults), states[1]: render_task(defaults, toggled)}
    yield from _compare(subject, "antialiased", tasks, states[0], repeats)
    tasks = {"exact": render_task(EXACT_SETTINGS), "defaults": render_task(defaults)}
    yield from _compare(subject, "all", tasks, "defaults", repeats)


def _compare(subject: Subject, setting: str, tasks: dict[str, RenderTask], default: str, repeats: int) -> Iterator[Row]:
    """Yield the rows of one setting; the first value is the reference."""
    times, results = time_alternately(tasks, repeats)
    times = {value: time.per_part(len(subject.cameras)) for value, time in times.items()}
    reference = next(iter(tasks))
    exact = results[reference]
    exact_scores = subject.measure_scores(exact, exact)
    for value, pictures in results.items():
        yield Row(
            group="render",
            setting=setting,
            value=value,
            is_reference=value == reference,
            is_default=value == default,
            time=times[value],
            ratio=times[value].ratio_to(times[reference]),
            **subject.measure_losses(pictures, exact, exact_scores, f"render, {setting} {value}"),
        )
