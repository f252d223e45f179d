"""Measure time, file size and loss of the `.hyrf` profiles and their settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hyrfpack.bench.rows import Row, format_value
from hyrfpack.bench.subject import Subject
from hyrfpack.compress.calibrate import measure_calibrated_sensitivity
from hyrfpack.compress.distortion import DEFAULT_PSNR_DROP_DB
from hyrfpack.compress.packer import Packer
from hyrfpack.config.compress import CompressConfig
from hyrfpack.errors import HyrfError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.arrays import layered_groups, to_arrays
from hyrfpack.format.codec import PROFILES
from hyrfpack.format.container import read_container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.sections import LAYERED_SECTIONS, POSITIONS, SECTION_CONTENTS
from hyrfpack.measure.error import Error, measure_error
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.render import render_view

# Values that are measured for each setting of a profile, one setting at a time, in addition to the profile's default.
# A `seed` is not a setting. The values of `distortion` are multiples of the default, because that depends on the model.
PROFILE_SETTING_VALUES: dict[str, dict[str, tuple]] = {
    "paper": {
        "color": ((1, 64), (1, 256), (2, 64), (2, 128), (2, 256), (3, 128), (4, 256)),
        "scale": ((1, 16), (1, 32), (1, 64), (1, 128), (1, 256), (2, 64), (2, 256)),
        "opacity": ((1, 8), (1, 16), (1, 32), (1, 64), (1, 256), (2, 64)),
    },
    "compact": {"distortion": (0.1, 0.3, 3.0, 10.0), "prune": (False, True)},
}
REFERENCE_PROFILE = "raw"


@dataclass(frozen=True)
class EncodingCase:
    """A profile with its defaults (`setting` is "profile"), or with one setting changed.

    Attributes:
        setting: name of the setting, as in `Row.setting`.
        value: formatted value of the setting.
        is_default: whether hyrfpack uses this value by default.
        encode: encodes the model and returns the bytes of the file.
    """

    setting: str
    value: str
    is_default: bool
    encode: Callable[[], bytes]


@torch.no_grad()
def measure_codec(subject: Subject, repeats: int, notes: list[str]) -> Iterator[Row]:
    """Measure encoding and decoding with every profile, and with other values of each of its settings.

    Args:
        subject: the model to encode.
        repeats: measured runs of each case.
        notes: gets a sentence about each profile that cannot encode this model.
    """
    if subject.profile != REFERENCE_PROFILE:
        notes.append(
            f"{subject.name} has profile '{subject.profile}', so its numbers are quantised already; encoding them "
            "again loses less than encoding the trained model"
        )
    cases: list[EncodingCase] = []
    for profile in PROFILES:
        try:
            cases += _encoding_cases(subject, profile)
        except HyrfError as error:
            notes.append(f"profile '{profile}' is left out: {error}")
    cases_by_name = {f"{case.setting} {case.value}": case for case in cases}
    encoding, files = time_alternately({name: case.encode for name, case in cases_by_name.items()}, repeats)
    decoding, models = time_alternately({name: partial(decode_model, data) for name, data in files.items()}, repeats)

    exact, reference_name = _render_views(subject, subject.model), f"profile {REFERENCE_PROFILE}"
    exact_scores = subject.measure_scores(exact, exact)
    for name, case in cases_by_name.items():
        pictures = _render_views(subject, models[name])
        yield Row(
            group="codec",
            setting=case.setting,
            value=case.value,
            is_reference=name == reference_name,
            is_default=case.is_default,
            time=encoding[name],
            ratio=encoding[name].ratio_to(encoding[reference_name]),
            parts=measure_parameter_errors(subject.model, models[name]),
            bytes=len(files[name]),
            decode=decoding[name],
            decode_ratio=decoding[name].ratio_to(decoding[reference_name]),
            **subject.measure_losses(pictures, exact, exact_scores, f"codec, {name}"),
        )


def measure_parameter_errors(reference: HybridModel, candidate: HybridModel) -> dict[str, Error]:
    """Compute the absolute errors of each group of parameters, by the group's description in SECTIONS.

    Positions are compared in local units, other parameters as stored. If a profile changes the order of the Gaussians,
    each is compared with the most similar one. If it changes their number, their parameters are left out.
    """
    expected, measured = to_arrays(reference), to_arrays(candidate)
    if len(reference) == len(candidate):
        order = _match_gaussians(expected, measured)
        measured |= {group: measured[group][order] for group in layered_groups(reference.config)}
    return {
        SECTION_CONTENTS[group]: measure_error(
            torch.from_numpy(measured[group]), torch.from_numpy(values), SECTION_CONTENTS[group]
        )
        for group, values in expected.items()
        if values.shape == measured[group].shape
    }


def _match_gaussians(expected: dict[str, np.ndarray], measured: dict[str, np.ndarray]) -> np.ndarray:
    """Return the (N,) index of the new Gaussian that corresponds to each old one."""
    count = len(expected[POSITIONS])
    spread = np.linalg.norm(expected[POSITIONS] - np.median(expected[POSITIONS], axis=0), axis=1)
    moved = np.linalg.norm(measured[POSITIONS] - expected[POSITIONS], axis=1)
    if np.median(moved) <= 0.01 * np.median(spread):
        return np.arange(count)
    # All parameters are compared, because Gaussians may share a position. Each column is scaled by its deviation.
    rows = [np.concatenate([arrays[group] for group in LAYERED_SECTIONS], axis=1) for arrays in (expected, measured)]
    size = rows[0].std(axis=0) + 1e-12
    return cKDTree(rows[1] / size).query(rows[0] / size)[1]


def _encoding_cases(subject: Subject, profile: str) -> Iterator[EncodingCase]:
    """Yield the profile with its defaults, then each value of each of its settings."""
    if profile == "compact":
        encode, defaults = _compact_encoder(subject)
    else:
        encode, defaults = _encoder(subject, profile)
    default_case = EncodingCase("profile", profile, profile == CompressConfig.profile, encode)
    yield default_case
    for name, values in PROFILE_SETTING_VALUES.get(profile, {}).items():
        default = defaults[name]
        if name == "distortion":
            values = tuple(default * factor for factor in values)
        for value in sorted({*values, default}):
            if value == default:
                yield replace(default_case, setting=f"{profile}, {name}", value=_format_value(value), is_default=True)
            else:
                yield EncodingCase(f"{profile}, {name}", _format_value(value), False, partial(encode, **{name: value}))


def _encoder(subject: Subject, profile: str) -> tuple[Callable[..., bytes], dict]:
    """Return a function that encodes the model with settings of a profile, and the defaults of the settings."""
    encode = partial(encode_model, subject.model, profile, subject.provenance)
    defaults = read_metadata(read_container(encode(), SECTION_CONTENTS)).settings
    # JSON has no tuples, so they were read as lists.
    return encode, {name: tuple(value) if isinstance(value, list) else value for name, value in defaults.items()}


def _compact_encoder(subject: Subject) -> tuple[Callable[..., bytes], dict]:
    """Do what `_encoder` does, for profile "compact": all that `hyrfpack compress` does between reading and writing."""

    @torch.enable_grad()  # for the sensitivities
    def encode(distortion: float | None = None, prune: bool = True) -> bytes:
        target = distortion or subject.distortion
        sensitivity, references = measure_calibrated_sensitivity(subject.model, subject.capture, target, prune)
        packer = Packer(subject.model, subject.provenance, sensitivity, subject.scene, prune=prune)
        target_drop = DEFAULT_PSNR_DROP_DB if distortion is None else None
        return packer.encode_to_distortion(target, references, target_drop).data

    return encode, {"distortion": subject.distortion, "prune": True}


def _format_value(value: object) -> str:
    """Format a value of a setting; numbers get two digits, because multiples of the default are not round."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.2g}" if isinstance(value, float) else format_value(value)


def _render_views(subject: Subject, model: HybridModel) -> list[Tensor]:
    """Render a model from each camera of the subject."""
    decoded = model.decode()
    return [render_view(model, camera, decoded=decoded).rgb for camera in subject.cameras]
