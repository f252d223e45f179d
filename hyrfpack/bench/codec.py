"""Profiles of the `.hyrf` file and their settings: time and bytes against what is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hyrfpack.bench.rows import Row, in_words
from hyrfpack.bench.subject import Subject
from hyrfpack.compress.quantize import decide
from hyrfpack.compress.sensitivity import measure_sensitivity
from hyrfpack.errors import HyrfError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.codec import DEFAULT_PROFILE, PROFILES
from hyrfpack.format.container import read_container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.sections import LAYERED_SECTIONS, POSITIONS, SECTION_CONTENTS
from hyrfpack.measure.error import Error, measure_error
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.render import render

# What is tried of each setting of a profile, one at a time; the profile's default joins them. A `seed` is no setting.
# Of `distortion` these are multiples of the default, which the model's own quality decides.
KNOBS: dict[str, dict[str, tuple]] = {
    "paper": {
        "color": ((1, 64), (1, 256), (2, 64), (2, 128), (2, 256), (3, 128), (4, 256)),
        "scale": ((1, 16), (1, 32), (1, 64), (1, 128), (1, 256), (2, 64), (2, 256)),
        "opacity": ((1, 8), (1, 16), (1, 32), (1, 64), (1, 256), (2, 64)),
    },
    "compact": {"distortion": (0.1, 0.3, 3.0, 10.0), "prune": (False, True)},
}
REFERENCE = "raw"


@dataclass(frozen=True)
class Case:
    """A profile with its defaults (`setting` "profile"), or with one setting changed."""

    setting: str
    value: str
    is_default: bool
    encode: Callable[[], bytes]


@torch.no_grad()
def codec_rows(subject: Subject, repeats: int, note: Callable[[str], None]) -> Iterator[Row]:
    """Encode and decode with every profile, and with each setting of it away from its default.

    Args:
        note: called with the reason for each profile that cannot write this model.
    """
    if subject.profile != REFERENCE:
        note(
            f"{subject.name} is of profile '{subject.profile}': its numbers are quantised already, so coding them "
            "again loses less than coding the trained model"
        )
    cases: list[Case] = []
    for profile in PROFILES:
        try:
            cases += _cases(subject, profile, note)
        except HyrfError as error:
            note(f"profile '{profile}' is left out: {error}")
    names = {f"{case.setting} {case.value}": case for case in cases}
    encoding, files = time_alternately({name: case.encode for name, case in names.items()}, repeats)
    decoding, models = time_alternately({name: partial(decode_model, data) for name, data in files.items()}, repeats)

    exact, first = _pictures(subject, subject.model), f"profile {REFERENCE}"
    best = subject.scores(exact, exact)
    for name, case in names.items():
        pictures = _pictures(subject, models[name])
        yield Row(
            group="codec",
            setting=case.setting,
            value=case.value,
            is_reference=name == first,
            is_default=case.is_default,
            time=encoding[name],
            ratio=encoding[name].ratio_to(encoding[first]),
            parts=parameter_errors(subject.model, models[name]),
            bytes=len(files[name]),
            decode=decoding[name],
            decode_ratio=decoding[name].ratio_to(decoding[first]),
            **subject.losses(pictures, exact, best, f"codec, {name}"),
        )


def parameter_errors(before: HybridModel, after: HybridModel) -> dict[str, Error]:
    """Absolute errors of each group of parameters, by what it holds; positions in local units, the rest as stored.

    Where a profile stores Gaussians in another order, each is compared with the one that took its place. Where it
    stores another number of them, their parameters are left out.
    """
    old, new = to_arrays(before), to_arrays(after)
    if len(before) == len(after):
        order = _order(old, new)
        new |= {group: new[group][order] for group in LAYERED_SECTIONS}
    return {
        SECTION_CONTENTS[group]: measure_error(
            torch.from_numpy(new[group]), torch.from_numpy(values), SECTION_CONTENTS[group]
        )
        for group, values in old.items()
        if values.shape == new[group].shape
    }


def _order(old: dict[str, np.ndarray], new: dict[str, np.ndarray]) -> np.ndarray:
    """(N,) which of the new Gaussians is each old one."""
    count = len(old[POSITIONS])
    spread = np.linalg.norm(old[POSITIONS] - np.median(old[POSITIONS], axis=0), axis=1)
    moved = np.linalg.norm(new[POSITIONS] - old[POSITIONS], axis=1)
    if np.median(moved) <= 0.01 * np.median(spread):
        return np.arange(count)
    # All their numbers together tell apart those at one place; each column counts by its spread.
    rows = [np.concatenate([arrays[group] for group in LAYERED_SECTIONS], axis=1) for arrays in (old, new)]
    size = rows[0].std(axis=0) + 1e-12
    return cKDTree(rows[1] / size).query(rows[0] / size)[1]


def _cases(subject: Subject, profile: str, note: Callable[[str], None]) -> Iterator[Case]:
    """The profile itself, then each of its knobs' values."""
    encode, defaults = _compact(subject, note) if profile == "compact" else _plain(subject.model, profile)
    itself = Case("profile", profile, profile == DEFAULT_PROFILE, encode)
    yield itself
    for knob, values in KNOBS.get(profile, {}).items():
        default = defaults[knob]
        if knob == "distortion":
            values = tuple(default * factor for factor in values)
        for value in sorted({*values, default}):
            if value == default:
                yield replace(itself, setting=f"{profile}, {knob}", value=_in_words(value), is_default=True)
            else:
                yield Case(f"{profile}, {knob}", _in_words(value), False, partial(encode, **{knob: value}))


def _plain(model: HybridModel, profile: str) -> tuple[Callable[..., bytes], dict]:
    """What writes the model with settings of a profile, and their defaults."""
    encode = partial(encode_model, model, profile)
    defaults = read_metadata(read_container(encode(), SECTION_CONTENTS)).settings
    # They came through JSON, which has no tuples.
    return encode, {name: tuple(value) if isinstance(value, list) else value for name, value in defaults.items()}


def _compact(subject: Subject, note: Callable[[str], None]) -> tuple[Callable[..., bytes], dict]:
    """The same of profile "compact". What each number does to pictures is measured here, once for all settings."""
    start = perf_counter()
    with torch.enable_grad():
        sensitivity = measure_sensitivity(subject.model, subject.capture)
    note(
        f"before profile 'compact' encodes, measuring what each number does to pictures took "
        f"{perf_counter() - start:.1f} s; that is the same for all its settings and in none of the times"
    )

    def encode(distortion: float = subject.distortion, prune: bool = True) -> bytes:
        return encode_model(subject.model, "compact", quantized=decide(subject.model, sensitivity, distortion, prune))

    return encode, {"distortion": subject.distortion, "prune": True}


def _in_words(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.2g}" if isinstance(value, float) else in_words(value)


def _pictures(subject: Subject, model: HybridModel) -> list[Tensor]:
    decoded = model.decode()
    return [render(model, camera, decoded=decoded).rgb for camera in subject.cameras]
