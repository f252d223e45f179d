"""The META section: one JSON object that says what the other sections hold.

It is read without numpy, because importing numpy would make `describe_file` slow.
"""

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

CODEC_JSON = 0
CODEC_DEFLATED = 5
MAX_METADATA_BYTES = 1 << 20
# zlib adds less to text that it cannot compress. The limit bounds the time that a stream of empty blocks can take.
MAX_DEFLATE_OVERHEAD_BYTES = 1024
MAX_NESTING_DEPTH = 64  # limits the recursion of functions that walk the objects and lists
INTEGER_LIMIT = 1 << 63
MAX_GAUSSIANS = (1 << 40) - 1
# A file may declare this many Gaussians for each of its bytes, plus a constant, because equal Gaussians take no bytes.
MAX_GAUSSIANS_PER_FILE_BYTE = 32
EXTRA_GAUSSIANS_PER_FILE = 1 << 18

# JSON types of the configuration's values; a tuple stands for a list of that length. `ModelConfig` checks the ranges.
_GRID_TYPES = {"log2_table_size": int, "levels": int, "base": int, "finest": int}
_CONFIG_TYPES = {
    "frame": {"center": (float,) * 3, "scale": float, "half_extent": (float,) * 3},
    "geometry": _GRID_TYPES,
    "radiance": _GRID_TYPES,
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
    """The metadata that a reader needs before it decodes a section, and notes for people.

    Attributes:
        profile: "raw", "paper" or "compact"; informative, because each section names its own codec.
        gaussians: number of Gaussians.
        config: `ModelConfig.to_dict()`.
        rules: names of the equations that no setting changes; a reader rejects names that it does not know.
        settings: settings of the profile, informative.
        provenance: where the model comes from, informative: preset, steps, why the sizes were chosen.
        writer: program and version that wrote the file.
        layers: number of Gaussians in each layer; empty if there is one layer.
    """

    profile: str
    gaussians: int
    config: dict
    rules: dict
    settings: dict = field(default_factory=dict)
    provenance: dict = field(default_factory=dict)
    writer: str = field(default_factory=lambda: writer_name())
    layers: list[int] = field(default_factory=list)

    def to_section(self, deflate: bool = False) -> Section:
        """Encode the metadata as a section: JSON with sorted keys, without spaces, in ASCII.

        The same values give the same bytes.

        Args:
            deflate: whether to compress the JSON text by deflate.

        Raises:
            HyrfError: a value cannot be written as JSON, such as NaN and infinity, the values take more than
                MAX_METADATA_BYTES, or they are nested deeper than MAX_NESTING_DEPTH.
        """
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        if not self.layers:
            del values["layers"]
        if is_too_deep(values):
            raise HyrfError(
                f"the metadata is nested deeper than {MAX_NESTING_DEPTH} levels",
                fix="flatten the provenance",
            )
        try:
            text = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise HyrfError(
                f"the metadata cannot be written as JSON ({error!s:.200})",
                fix="give a provenance of finite numbers, texts, lists and dictionaries with texts as keys",
            ) from error
        if len(text) > MAX_METADATA_BYTES:
            raise HyrfError(
                f"the metadata takes {len(text)} bytes and may take {MAX_METADATA_BYTES}",
                fix="shorten the provenance",
            )
        data = text.encode("ascii")
        return (
            Section(METADATA, CODEC_DEFLATED, zlib.compress(data, 9), len(data))
            if deflate
            else Section(METADATA, CODEC_JSON, data, len(data))
        )


def writer_name() -> str:
    """Return the name and the version of this program, as files state them."""
    return f"hyrfpack {__version__}"


def gaussian_limit(file_length: int) -> int:
    """Return the largest number of Gaussians that a file of `file_length` bytes may hold."""
    return MAX_GAUSSIANS_PER_FILE_BYTE * file_length + EXTRA_GAUSSIANS_PER_FILE


def read_metadata(container: Container) -> Metadata:
    """Read the metadata and check the types of `config`; the other objects may hold anything.

    They are parsed once for each container, so the caller must not change them.

    Raises:
        HyrfFormatError: the section is absent, too long, not JSON, or a field is missing or of the wrong type.
    """
    if METADATA not in container.parsed:
        container.parsed[METADATA] = _parse_metadata(container)
    metadata: Metadata = container.parsed[METADATA]
    return metadata


def _parse_metadata(container: Container) -> Metadata:
    values = _parse_json_object(_read_json_text(container), container.name)
    values = {item.name: values.get(item.name, [] if item.name == "layers" else None) for item in fields(Metadata)}
    try:
        _check_values(values)
    except ValueError as error:
        raise HyrfFormatError(
            f"{container.name}: the metadata is not valid: {error}", fix="write the file again"
        ) from error
    return Metadata(**values)


def _read_json_text(container: Container) -> bytes:
    """Return the JSON text of the metadata, after a check of its sizes."""
    name, entry = container.name, container.entries.get(METADATA)
    if entry is not None and (entry.raw_length > MAX_METADATA_BYTES or entry.codec not in (CODEC_JSON, CODEC_DEFLATED)):
        raise HyrfFormatError(
            f"{name}: the metadata has {entry.raw_length} bytes in codec {entry.codec}, but only up to "
            f"{MAX_METADATA_BYTES} bytes in codecs {CODEC_JSON} and {CODEC_DEFLATED} can be read",
            fix="the file is damaged or newer than this hyrfpack, update hyrfpack or write the file again",
        )
    if entry is not None and not _is_stored_length_plausible(entry.codec, entry.length, entry.raw_length):
        raise HyrfFormatError(
            f"{name}: the metadata has {entry.length} bytes and says it decodes to {entry.raw_length}",
            fix="the file is damaged, write it again",
        )
    data = bytes(container[METADATA].data)  # raises HyrfFormatError if the section is absent
    if entry is not None and entry.codec == CODEC_DEFLATED:
        data = _inflate(data, entry.raw_length, name)
    return data


def _parse_json_object(data: bytes, name: str) -> dict[str, Any]:
    """Parse a JSON object of finite numbers, nested no deeper than MAX_NESTING_DEPTH."""
    try:
        values = json.loads(data.decode("utf-8"), parse_constant=_parse_finite, parse_float=_parse_finite)
    # Deep nesting overflows the parser's stack, and Python converts no integer of 5,000 digits (ValueError).
    except (ValueError, RecursionError) as error:
        raise HyrfFormatError(
            f"{name}: the metadata is not valid JSON ({error})",
            fix="write the file again",
        ) from error
    if not isinstance(values, dict):
        raise HyrfFormatError(f"{name}: the metadata is not a JSON object", fix="write the file again")
    if is_too_deep(values):
        raise HyrfFormatError(
            f"{name}: the metadata is nested deeper than {MAX_NESTING_DEPTH} levels",
            fix="write the file again",
        )
    return values


def _check_values(values: dict[str, Any]) -> None:
    """Raise ValueError unless the values of all fields of `Metadata` have the right types and fit each other."""
    for key, kind in (("gaussians", int), ("rules", dict), ("settings", dict), ("provenance", dict)):
        _check_type(values[key], kind, key)
    _check_type(values["config"], _CONFIG_TYPES, "config")
    if "rotation" in values["config"]["frame"]:
        _check_type(values["config"]["frame"]["rotation"], (float,) * 4, "config.frame.rotation")
    if "residual_degree" in values["config"]:
        _check_type(values["config"]["residual_degree"], int, "config.residual_degree")
    _check_type([values["profile"], values["writer"]], (str, str), "profile or writer")
    if not 0 <= values["gaussians"] <= MAX_GAUSSIANS:
        raise ValueError(f"there cannot be {values['gaussians']} Gaussians")
    layers = values["layers"]
    _check_type(layers, list, "layers")
    if len(layers) > MAX_LAYERS:
        raise ValueError(f"there are {len(layers)} layers, and there may be {MAX_LAYERS}")
    _check_type(layers, (int,) * len(layers), "layers")
    if layers and (min(layers) < 0 or sum(layers) != values["gaussians"]):
        raise ValueError(f"its layers do not add up to {values['gaussians']} Gaussians")


def _is_stored_length_plausible(codec: int, stored: int, raw: int) -> bool:
    """Return whether JSON text of `raw` bytes may take `stored` bytes in this codec."""
    return stored == raw if codec == CODEC_JSON else stored <= raw + MAX_DEFLATE_OVERHEAD_BYTES


def _inflate(data: bytes, length: int, name: str) -> bytes:
    """Decompress exactly `length` bytes of a zlib stream, and never allocate more."""
    inflater = zlib.decompressobj()
    try:
        text = inflater.decompress(data, length + 1)
    except zlib.error as error:
        raise HyrfFormatError(
            f"{name}: the metadata cannot be unpacked ({error})",
            fix="write the file again",
        ) from error
    if len(text) != length or not inflater.eof or inflater.unused_data:
        raise HyrfFormatError(f"{name}: the metadata does not unpack to {length} bytes", fix="write the file again")
    return text


def _check_type(value: Any, kind: type | tuple | dict, path: str) -> None:
    """Raise ValueError unless a JSON value has the types of `kind`; keys that `kind` lacks are ignored."""
    if isinstance(kind, dict):
        _check_type(value, dict, path)
        for key, inner in kind.items():
            _check_type(value.get(key), inner, f"{path}.{key}")
    elif isinstance(kind, tuple):
        if type(value) is not list or len(value) != len(kind):
            raise ValueError(f"'{path}' must be a list of {len(kind)}")
        for item, inner in zip(value, kind, strict=True):
            _check_type(item, inner, path)
    elif kind is float:
        if type(value) not in (int, float) or abs(value) > sys.float_info.max:
            raise ValueError(f"'{path}' must be a finite number")
    elif kind is int and type(value) is int and abs(value) >= INTEGER_LIMIT:
        raise ValueError(f"'{path}' is an integer of more than 64 bits")
    elif type(value) is not kind:
        raise ValueError(f"'{path}' must be of type {kind.__name__}")


def is_too_deep(value: object) -> bool:
    """Return whether objects and lists are nested deeper than MAX_NESTING_DEPTH.

    It works level by level instead of by recursion, so that no depth overflows the stack.
    """
    level: list[Any] = [value]
    for _ in range(MAX_NESTING_DEPTH + 1):
        level = [item for item in level if isinstance(item, (dict, list, tuple))]
        if not level:
            return False
        level = [inner for item in level for inner in (item.values() if isinstance(item, dict) else item)]
    return True


def _parse_finite(text: str) -> float:
    """Parse a number; raise ValueError if it is not finite."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:20]} is not finite")
    return value
