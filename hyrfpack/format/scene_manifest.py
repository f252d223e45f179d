"""The manifest of a scene folder, `scene.json`: chunks of a model, each at several levels of detail.

`docs/reference/scene-folder.md` specifies it, `scene.schema.json` beside this module describes it for other programs.
This module imports neither torch nor numpy.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from hyrfpack.checks import check_text
from hyrfpack.config.split import MAX_LEVELS, MAX_TITLE_LENGTH
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import MAX_FILE_BYTES
from hyrfpack.format.metadata import MAX_GAUSSIANS, MAX_NESTING_DEPTH, is_too_deep, writer_name
from hyrfpack.format.part_names import ONE_PART_NAME, check_part_names, reject_constant
from hyrfpack.format.run_folder import MAX_MANIFEST_BYTES
from hyrfpack.format.run_folder import SCENE_FORMAT_NAME as FORMAT_NAME
from hyrfpack.format.run_folder import SCENE_MANIFEST_FILE as MANIFEST_NAME
from hyrfpack.format.sections import MAX_PARTS
from hyrfpack.format.shared import is_file_name

# The two major versions differ, so that an older reader refuses a scene of several parts. Otherwise it would draw all
# chunks with the fields of one part.
ONE_PART_VERSION, PARTS_VERSION = (1, 0), (2, 0)
MAX_CHUNKS = 1 << 16
MAX_ERROR_RADII = 16
MAX_CAMERAS = 1024
MAX_NUMBERS_PER_CAMERA = 32
_MAX_QUAT_LENGTH_ERROR = 1e-6  # equals `rotations.MAX_LENGTH_ERROR`, whose module needs numpy
_CHECKSUM_PATTERN = re.compile(r"[0-9a-f]{8}")
_VERSION_PATTERN = re.compile(r"(\d{1,4})\.(\d{1,4})")


@dataclass(frozen=True)
class SceneFile:
    """A file of a scene folder.

    Attributes:
        file: its name in the folder.
        bytes: its size.
        crc32: CRC-32 of its bytes, as 8 hexadecimal digits.
    """

    file: str
    bytes: int
    crc32: str


@dataclass(frozen=True)
class ScenePart(SceneFile):
    """A part of the scene, by its shared file: the fields, the exposure map and the provenance of its model.

    Attributes:
        name: name of the part; no two are equal.
    """

    name: str = ONE_PART_NAME


@dataclass(frozen=True)
class ChunkLevel(SceneFile):
    """A chunk at one level of detail.

    Attributes:
        gaussians: number of its Gaussians.
        errors: mean squared error of a pixel that shows the chunk, if this level takes the place of the finest one, at
            each of the manifest's `error_radii`; 0 for the finest level.
    """

    gaussians: int
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Chunk:
    """Gaussians of one region.

    Attributes:
        low, high: corners of the box that holds them, three standard deviations included, world units.
        levels: from the finest to the coarsest.
        part: number of the part that its Gaussians belong to.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    levels: tuple[ChunkLevel, ...]
    part: int = 0

    @property
    def center(self) -> tuple[float, float, float]:
        """The centre of the box."""
        x, y, z = ((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))
        return x, y, z

    @property
    def radius(self) -> float:
        """Half the diagonal of the box, world units."""
        return math.dist(self.low, self.high) / 2


@dataclass(frozen=True)
class Manifest:
    """The manifest of a scene folder.

    Attributes:
        gaussians: number of Gaussians of all chunks at the finest level.
        parts: the parts, one for each model that was split. The first is the scene, whose frame, background, viewpoint
            and cameras are those of the manifest.
        chunks: the chunks.
        error_radii: radii of a chunk's projection in pixels, rising, for which its levels have errors. The radius of a
            chunk in a view is its `radius` times the focal length, divided by its distance.
        frame: frame of the scene, as in the `config` of its files.
        background: whether a background sphere lies behind the Gaussians.
        solid: colour behind everything without one.
        viewpoint: the viewpoint to orbit around, as in `provenance`; empty if the model has none.
        cameras: cameras of the capture as lists of numbers, as in `provenance`.
        title, licence: texts for people; empty if unknown.
        writer: program that wrote the folder.
    """

    gaussians: int
    parts: tuple[ScenePart, ...]
    chunks: tuple[Chunk, ...]
    error_radii: tuple[float, ...]
    frame: dict[str, Any]
    background: bool
    solid: tuple[float, float, float]
    viewpoint: dict[str, Any] = field(default_factory=dict)
    cameras: tuple[tuple[float, ...], ...] = ()
    title: str = ""
    licence: str = ""
    writer: str = field(default_factory=writer_name)

    @property
    def files(self) -> list[SceneFile]:
        """All files of the folder but the manifest."""
        return [*self.parts, *(level for chunk in self.chunks for level in chunk.levels)]

    @property
    def shared_bytes(self) -> int:
        """Bytes of the shared files of all parts."""
        return sum(part.bytes for part in self.parts)

    @property
    def total_bytes(self) -> int:
        """Bytes of all files but the manifest."""
        return sum(item.bytes for item in self.files)

    def to_dict(self) -> dict[str, Any]:
        """Return the manifest as values for JSON. One of several parts has version 2.0, another one has no `parts`."""
        values = asdict(self)
        version = PARTS_VERSION if len(self.parts) > 1 else ONE_PART_VERSION
        if version == ONE_PART_VERSION:
            (part,) = values.pop("parts")
            values["shared"] = {key: value for key, value in part.items() if key != "name"}
            values["chunks"] = [{key: chunk[key] for key in ("low", "high", "levels")} for chunk in values["chunks"]]
        return {"format": FORMAT_NAME, "version": "{}.{}".format(*version), **values}

    def to_json(self) -> bytes:
        """Return the text of the manifest. Equal manifests give equal bytes."""
        text = json.dumps(self.to_dict(), separators=(",", ":"), sort_keys=True, allow_nan=False)
        return (text + "\n").encode("ascii")


def parse_manifest(data: bytes, name: str = MANIFEST_NAME) -> Manifest:
    """Parse the text of a manifest; it is safe on untrusted input.

    Args:
        data: the bytes of the file.
        name: name of the file in error messages.

    Raises:
        HyrfFormatError: the text is not a manifest, is damaged, or has another major version.
    """
    try:
        if len(data) > MAX_MANIFEST_BYTES:
            raise ValueError(f"it has {len(data):,} bytes and may have {MAX_MANIFEST_BYTES:,}")
        values = json.loads(data.decode("utf-8"), parse_constant=reject_constant)
        if not isinstance(values, dict) or values.get("format") != FORMAT_NAME:
            raise HyrfFormatError(f"{name}: this is not the manifest of a scene folder", fix="check the path")
        if is_too_deep(values):
            raise ValueError(f"it is nested deeper than {MAX_NESTING_DEPTH} levels")
        return _parse_values(values, _read_major_version(values.get("version"), name))
    # Deep nesting overflows the parser's stack, and Python converts no integer of 5,000 digits (ValueError).
    except (ValueError, RecursionError) as error:
        raise HyrfFormatError(
            f"{name}: the manifest is damaged ({error!s:.200})", fix="copy the whole folder again, or split it again"
        ) from error


def _read_major_version(version: object, name: str) -> int:
    match = _VERSION_PATTERN.fullmatch(version) if isinstance(version, str) else None
    if match is None:
        raise ValueError("it has no version")
    if (major := int(match[1])) not in (known := (ONE_PART_VERSION[0], PARTS_VERSION[0])):
        raise HyrfFormatError(
            f"{name}: the scene has version {version} and this hyrfpack reads versions {known[0]} and {known[1]}",
            fix="update hyrfpack",
        )
    return major


def _parse_values(values: Mapping[str, Any], major: int) -> Manifest:
    """Build a manifest of checked values; unknown keys are ignored, as later minor versions may add some."""
    radii = _get_numbers(values, "error_radii", range(1, MAX_ERROR_RADII + 1), minimum=0)
    if any(a >= b for a, b in zip((0.0, *radii), radii, strict=False)):
        raise ValueError("'error_radii' do not rise")
    parts = _parse_parts(values, major)
    chunks = tuple(
        _parse_chunk(item, len(radii), len(parts)) for item in _get_list(values, "chunks", range(MAX_CHUNKS + 1))
    )
    manifest = Manifest(
        gaussians=_get_integer(values, "gaussians"),
        parts=parts,
        chunks=chunks,
        error_radii=radii,
        frame=_get_frame(values),
        background=_get_typed(values, "background", bool),
        solid=_get_triple(values, "solid"),
        viewpoint=dict(_get_object(values, "viewpoint")),
        cameras=tuple(
            _get_numbers({"cameras": camera}, "cameras", range(1, MAX_NUMBERS_PER_CAMERA + 1))
            for camera in _get_list(values, "cameras", range(MAX_CAMERAS + 1))
        ),
        **{key: _get_text(values, key) for key in ("title", "licence", "writer")},
    )
    if sum(chunk.levels[0].gaussians for chunk in chunks) != manifest.gaussians:
        raise ValueError(f"the chunks do not add up to {manifest.gaussians:,} Gaussians")
    names = [item.file.lower() for item in manifest.files]  # Some file systems ignore case.
    name, count = Counter(names).most_common(1)[0]  # there is at least the file of one part
    if count > 1:
        raise ValueError(f"two files are named '{name}'")
    return manifest


def _parse_parts(values: Mapping[str, Any], major: int) -> tuple[ScenePart, ...]:
    if major == ONE_PART_VERSION[0]:
        return (ScenePart(**_get_file_values(_get_object(values, "shared"))),)
    items = _get_list(values, "parts", range(2, MAX_PARTS + 1))
    if not all(isinstance(item, dict) for item in items):
        raise ValueError("a part is not an object")
    check_part_names([item.get("name") for item in items])
    return tuple(ScenePart(**_get_file_values(item), name=item["name"]) for item in items)


def _parse_chunk(item: object, radius_count: int, part_count: int) -> Chunk:
    if not isinstance(item, dict):
        raise ValueError("a chunk is not an object")
    low, high = _get_triple(item, "low"), _get_triple(item, "high")
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise ValueError("the box of a chunk is not in order")
    levels = []
    for level in _get_list(item, "levels", range(1, MAX_LEVELS + 1)):
        if not isinstance(level, dict):
            raise ValueError("a level is not an object")
        errors = _get_numbers(level, "errors", range(radius_count, radius_count + 1), minimum=0)
        levels.append(ChunkLevel(**_get_file_values(level), gaussians=_get_integer(level, "gaussians"), errors=errors))
    part = _get_integer(item, "part") if part_count > 1 else 0
    if part >= part_count:
        raise ValueError(f"a chunk belongs to part {part}, and there are {part_count} parts")
    return Chunk(low, high, tuple(levels), part)


def _get_file_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the checked attributes of a `SceneFile`."""
    name, checksum = values.get("file"), values.get("crc32")
    if not is_file_name(name):
        raise ValueError(f"{name!r:.80} is not the name of a .hyrf file in the folder")
    if not isinstance(checksum, str) or not _CHECKSUM_PATTERN.fullmatch(checksum):
        raise ValueError(f"the checksum of {name} is not 8 hexadecimal digits")
    return {"file": name, "bytes": _get_integer(values, "bytes", MAX_FILE_BYTES), "crc32": checksum}


def _get_typed(values: Mapping[str, Any], key: str, kind: type) -> Any:
    """Return the value of a key. Like all functions below, it raises ValueError if the value is not valid."""
    value = values.get(key)
    if type(value) is not kind:
        raise ValueError(f"'{key}' must be of type {kind.__name__}")
    return value


def _get_object(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    return _get_typed(values, key, dict)


def _get_list(values: Mapping[str, Any], key: str, lengths: range) -> list[Any]:
    items = _get_typed(values, key, list)
    if len(items) not in lengths:
        raise ValueError(f"'{key}' has {len(items):,} entries, not {lengths.start} to {lengths.stop - 1:,}")
    return items


def _get_frame(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the frame after a check of what readers of the manifest need of it; the files have the whole frame."""
    frame = _get_object(values, "frame")
    _get_triple(frame, "center")
    (scale,) = _get_numbers({"scale": [frame.get("scale")]}, "scale", range(1, 2))
    if scale <= 0:
        raise ValueError("'scale' must be positive")
    if "rotation" in frame:
        length = math.hypot(*_get_numbers(frame, "rotation", range(4, 5)))
        if abs(length - 1) > _MAX_QUAT_LENGTH_ERROR:
            raise ValueError("'rotation' does not have unit length")
    return dict(frame)


def _get_text(values: Mapping[str, Any], key: str) -> str:
    text = _get_typed(values, key, str)
    check_text(f"'{key}'", text, MAX_TITLE_LENGTH)
    return text


def _get_integer(values: Mapping[str, Any], key: str, maximum: int = MAX_GAUSSIANS) -> int:
    """Return an integer from 0 to `maximum`."""
    value = values.get(key)
    if isinstance(value, float) and value.is_integer():  # such as 3.0, which JSON Schema and JavaScript accept
        value = int(value)
    else:
        value = _get_typed(values, key, int)
    if not 0 <= value <= maximum:
        raise ValueError(f"'{key}' is out of range")
    return value


def _get_triple(values: Mapping[str, Any], key: str) -> tuple[float, float, float]:
    x, y, z = _get_numbers(values, key, range(3, 4))
    return x, y, z


def _get_numbers(values: Mapping[str, Any], key: str, lengths: range, minimum: float = -math.inf) -> tuple[float, ...]:
    """Return a list of finite numbers, at least `minimum`, whose length is one of `lengths`."""
    numbers = _get_list(values, key, lengths)
    if not all(type(number) in (int, float) for number in numbers):
        raise ValueError(f"'{key}' holds a value that is not a number")
    try:
        floats = tuple(map(float, numbers))
    except OverflowError:
        raise ValueError(f"'{key}' holds a number out of range") from None
    if not all(math.isfinite(number) and number >= minimum for number in floats):
        raise ValueError(f"'{key}' holds a number out of range")
    return floats
