"""Profiles of the `.hyrf` file and their settings: time and bytes against what is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hyrfpack.bench.rows import Error, Row, difference, in_words
from hyrfpack.bench.subject import Subject
from hyrfpack.bench.timing import take_turns
from hyrfpack.errors import HyrfError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.codec import DEFAULT_PROFILE, PROFILES
from hyrfpack.format.container import read_container
from hyrfpack.format.info import SECTIONS
from hyrfpack.format.metadata import read_metadata
from hyrfpack.model import HybridModel
from hyrfpack.render import render

# What is tried of each setting of a profile, one at a time; the profile's default joins them. A `seed` is no setting.
KNOBS: dict[str, dict[str, tuple]] = {
    "paper": {
        "color": ((1, 64), (1, 256), (2, 64), (2, 128), (2, 256), (3, 128), (4, 256)),
        "scale": ((1, 16), (1, 32), (1, 64), (1, 128), (1, 256), (2, 64), (2, 256)),
        "opacity": ((1, 8), (1, 16), (1, 32), (1, 64), (1, 256), (2, 64)),
    },
}
REFERENCE = "raw"
PER_GAUSSIAN = ("POSI", "COLO", "SCAL", "OPAC")


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
    cases = []
    for profile in PROFILES:
        try:
            cases += _cases(subject.model, profile)
        except HyrfError as error:
            note(f"profile '{profile}' is left out: {error}")
    names = {f"{case.setting} {case.value}": case for case in cases}
    encoding, files = take_turns({name: case.encode for name, case in names.items()}, repeats)
    decoding, models = take_turns({name: partial(decode_model, data) for name, data in files.items()}, repeats)

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
            ratio=encoding[name].over(encoding[first]),
            parts=parameter_errors(subject.model, models[name]),
            bytes=len(files[name]),
            decode=decoding[name],
            decode_ratio=decoding[name].over(decoding[first]),
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
        new |= {group: new[group][order] for group in PER_GAUSSIAN}
    return {
        SECTIONS[group]: difference(torch.from_numpy(new[group]), torch.from_numpy(values), SECTIONS[group])
        for group, values in old.items()
        if values.shape == new[group].shape
    }


def _order(old: dict[str, np.ndarray], new: dict[str, np.ndarray]) -> np.ndarray:
    """(N,) which of the new Gaussians is each old one."""
    count = len(old["POSI"])
    spread = np.linalg.norm(old["POSI"] - np.median(old["POSI"], axis=0), axis=1)
    moved = np.linalg.norm(new["POSI"] - old["POSI"], axis=1)
    if np.median(moved) <= 0.01 * np.median(spread):
        return np.arange(count)
    # All their numbers together tell apart those at one place; each column counts by its spread.
    rows = [np.concatenate([arrays[group] for group in PER_GAUSSIAN], axis=1) for arrays in (old, new)]
    size = rows[0].std(axis=0) + 1e-12
    return cKDTree(rows[1] / size).query(rows[0] / size)[1]


def _cases(model: HybridModel, profile: str) -> Iterator[Case]:
    """The profile itself, then each of its knobs' values."""
    written = read_container(encode_model(model, profile), SECTIONS)
    defaults = read_metadata(written).settings
    itself = Case("profile", profile, profile == DEFAULT_PROFILE, partial(encode_model, model, profile))
    yield itself
    for knob, values in KNOBS.get(profile, {}).items():
        default = _plain(defaults[knob])
        for value in sorted({*values, default}):
            if value == default:
                yield replace(itself, setting=f"{profile}, {knob}", value=in_words(value), is_default=True)
            else:
                encode = partial(encode_model, model, profile, **{knob: value})
                yield Case(f"{profile}, {knob}", in_words(value), False, encode)


def _plain(value: object) -> object:
    """A setting as it came through JSON, as the profile takes it."""
    return tuple(value) if isinstance(value, list) else value


def _pictures(subject: Subject, model: HybridModel) -> list[Tensor]:
    geometry = model.decode_geometry()
    return [render(model, camera, geometry=geometry).rgb for camera in subject.cameras]
