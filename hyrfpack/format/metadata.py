"""The META section: one JSON object that says what the other sections hold. Plain Python: `describe` needs it fast."""

from __future__ import annotations

import json
import math
import sys
import zlib
from dataclasses import dataclass, field, fields
from typing import Any

from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format.container import Container, Section
from hyrfpack.format.sections import MAX_LAYERS, METADATA
from hyrfpack.version import __version__

CODEC_JSON, CODEC_DEFLATED = 0, 5
MAX_BYTES = 1 << 20
MAX_DEPTH = 64  # objects and lists within each other; what walks them calls itself once for each
MAX_INTEGER = 1 << 63

# Types of the configuration's values, as JSON has them; a tuple is a list of that length. `ModelConfig` checks ranges.
_GRID = {"log2_table_size": int, "levels": int, "base": int, "finest": int}
_CONFIG = {
    "frame": {"center": (float,) * 3, "scale": float, "half_extent": (float,) * 3},
    "geometry": _GRID,
    "radiance": _GRID,
    "hidden": int,
    "background": bool,
    "solid": (float,) * 3,
    "scale_rule": str,
    "scale_grows": bool,
    "direction_encoding": str,
    "position_gradients": bool,
    "antialiased": bool,
}


@dataclass(frozen=True)
class Metadata:
    """What a reader must know before it decodes a section, and what a person may want to know.

    Attributes:
        profile: "raw", "paper" or "compact"; for people, each section names its own codec.
        gaussians: how many there are.
        config: `ModelConfig.to_dict()`.
        rules: names of the equations that are not settings of a model; a reader refuses names it does not know.
        settings: what the profile was asked for, for people.
        provenance: where the model comes from, for people: preset, steps, why the sizes were chosen.
        writer: program and version that wrote the file.
        layers: how many Gaussians each layer has, where they come in layers; empty for one layer.
    """

    profile: str
    gaussians: int
    config: dict
    rules: dict
    settings: dict = field(default_factory=dict)
    provenance: dict = field(default_factory=dict)
    writer: str = field(default_factory=lambda: writer())
    layers: list[int] = field(default_factory=list)

    def to_section(self, deflate: bool = False) -> Section:
        """The section, same values, same bytes: keys sorted, no spaces, ASCII.

        Raises:
            ValueError: a value is not JSON (NaN and infinity are not).
            HyrfError: all are more than MAX_BYTES, or nested deeper than MAX_DEPTH.
        """
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        if not self.layers:
            del values["layers"]
        if _is_deep(values):
            raise HyrfError(f"the metadata is nested deeper than {MAX_DEPTH} levels; flatten the provenance")
        try:
            text = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
        except TypeError as error:
            raise ValueError(f"the metadata is not JSON: {error}") from error
        if len(text) > MAX_BYTES:
            raise HyrfError(f"the metadata takes {len(text)} bytes and may take {MAX_BYTES}; shorten the provenance")
        data = text.encode("ascii")
        return (
            Section(METADATA, CODEC_DEFLATED, zlib.compress(data, 9), len(data))
            if deflate
            else Section(METADATA, CODEC_JSON, data, len(data))
        )


def writer() -> str:
    """The program and its version, as files name it."""
    return f"hyrfpack {__version__}"


def read_metadata(container: Container) -> Metadata:
    """Read and check the metadata: `config` has the right types; the other objects may hold anything.

    Raises:
        HyrfFormatError: the section is absent, too long, not JSON, or a field is missing or of the wrong type.
    """
    name, entry = container.name, container.entries.get(METADATA)
    if entry is not None and (entry.raw_length > MAX_BYTES or entry.codec not in (CODEC_JSON, CODEC_DEFLATED)):
        raise HyrfFormatError(
            f"{name}: the metadata has {entry.raw_length} bytes in codec {entry.codec}, and {MAX_BYTES} bytes at most "
            f"in codecs {CODEC_JSON} and {CODEC_DEFLATED} can be read; the file is damaged or newer than this hyrfpack"
        )
    if entry is not None and entry.codec == CODEC_JSON and entry.raw_length != entry.length:
        raise HyrfFormatError(
            f"{name}: the metadata has {entry.length} bytes and says it decodes to {entry.raw_length}; the file is "
            "damaged, write it again"
        )
    data = bytes(container[METADATA].data)  # refuses a file without any
    if entry is not None and entry.codec == CODEC_DEFLATED:
        data = _inflate(data, entry.raw_length, name)
    try:
        values = json.loads(data.decode("utf-8"), parse_constant=_finite, parse_float=_finite)
    # Nesting without end overflows the parser's stack, and a number of 5,000 digits is a ValueError.
    except (ValueError, RecursionError) as error:
        raise HyrfFormatError(f"{name}: the metadata is not valid JSON ({error}); write the file again") from error
    if not isinstance(values, dict):
        raise HyrfFormatError(f"{name}: the metadata is not a JSON object; write the file again")
    if _is_deep(values):
        raise HyrfFormatError(f"{name}: the metadata is nested deeper than {MAX_DEPTH} levels; write the file again")
    values = {"layers": [], **values}
    values = {item.name: values.get(item.name) for item in fields(Metadata)}
    try:
        for key, kind in (("gaussians", int), ("rules", dict), ("settings", dict), ("provenance", dict)):
            _check(values[key], kind, key)
        _check(values["config"], _CONFIG, "config")
        _check([values["profile"], values["writer"]], (str, str), "profile or writer")
        if not 0 <= values["gaussians"] < 1 << 40:
            raise ValueError(f"there cannot be {values['gaussians']} Gaussians")
        layers = values["layers"]
        _check(layers, list, "layers")
        _check(layers, (int,) * min(len(layers), MAX_LAYERS), "layers")
        if layers and (min(layers) < 0 or sum(layers) != values["gaussians"]):
            raise ValueError(f"its layers do not add up to {values['gaussians']} Gaussians")
    except ValueError as error:
        raise HyrfFormatError(f"{name}: the metadata is not valid: {error}; write the file again") from error
    return Metadata(**values)


def _inflate(data: bytes, length: int, name: str) -> bytes:
    """Exactly `length` bytes out of a zlib stream; never more are made."""
    inflater = zlib.decompressobj()
    try:
        text = inflater.decompress(data, length + 1)
    except zlib.error as error:
        raise HyrfFormatError(f"{name}: the metadata cannot be unpacked ({error}); write the file again") from error
    if len(text) != length or not inflater.eof or inflater.unused_data:
        raise HyrfFormatError(f"{name}: the metadata does not unpack to {length} bytes; write the file again")
    return text


def _check(value: Any, kind: type | tuple | dict, path: str) -> None:
    """Raise ValueError unless a JSON value has the types of `kind`. Keys that `kind` lacks may have any."""
    if isinstance(kind, dict):
        _check(value, dict, path)
        for key, inner in kind.items():
            _check(value.get(key), inner, f"{path}.{key}")
    elif isinstance(kind, tuple):
        if type(value) is not list or len(value) != len(kind):
            raise ValueError(f"'{path}' must be a list of {len(kind)}")
        for item, inner in zip(value, kind, strict=True):
            _check(item, inner, path)
    elif kind is float:
        if type(value) not in (int, float) or abs(value) > sys.float_info.max:
            raise ValueError(f"'{path}' must be a finite number")
    elif kind is int and type(value) is int and abs(value) >= MAX_INTEGER:
        raise ValueError(f"'{path}' is an integer of more than 64 bits")
    elif type(value) is not kind:
        raise ValueError(f"'{path}' must be of type {kind.__name__}")


def _is_deep(value: object) -> bool:
    """Whether objects and lists are nested deeper than MAX_DEPTH; found level by level, so that any depth can be."""
    level: list[Any] = [value]
    for _ in range(MAX_DEPTH + 1):
        level = [item for item in level if isinstance(item, (dict, list, tuple))]
        if not level:
            return False
        level = [inner for item in level for inner in (item.values() if isinstance(item, dict) else item)]
    return True


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:20]} is not finite")
    return value
