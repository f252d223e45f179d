"""The minor version of a file: the lowest one of the format that has all that the file uses."""

from __future__ import annotations

from collections.abc import Iterable

from hyrfpack.format.container import Section
from hyrfpack.format.sections import EXPOSURE, group_and_layer

# The minor versions of the format since 1.0, each named after what it added.
_COMPACT_MINOR_VERSION = 1
_EXPOSURE_MINOR_VERSION = 2
_ROTATION_MINOR_VERSION = 3
MERGED_MINOR_VERSION = 4
_SHARED_MINOR_VERSION = 5
_RESIDUAL_MINOR_VERSION = 6
_COMPACT_CODECS = range(5, 9)
_SHARED_CODECS = (11, 12)  # tables with stated groups, and sections of another file


def lowest_minor_version(sections: Iterable[Section], config: dict) -> int:
    """Return the lowest minor version that has the sections, their codecs, and the keys of a configuration."""
    sections = list(sections)
    if "residual_degree" in config:
        return _RESIDUAL_MINOR_VERSION
    if any(section.codec in _SHARED_CODECS for section in sections):
        return _SHARED_MINOR_VERSION
    if "rotation" in config["frame"]:
        return _ROTATION_MINOR_VERSION
    if any(section.type == EXPOSURE for section in sections):
        return _EXPOSURE_MINOR_VERSION
    if any(section.codec in _COMPACT_CODECS or group_and_layer(section.type)[1] for section in sections):
        return _COMPACT_MINOR_VERSION
    return 0
