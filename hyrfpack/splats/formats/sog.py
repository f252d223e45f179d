"""PlayCanvas SOG, version 2: meta.json and lossless WebP pictures, bundled in a stored zip (`.sog`) or in a folder.

A pixel of a picture belongs to a Gaussian, row by row from the top left, in the order of a Morton curve. Source: the
PlayCanvas user manual, "The SOG Format" (developer.playcanvas.com).

    means_l, means_u    RGB    low and high bytes of steps between means.mins and means.maxs, 65535 of them, of
                               sign(x) log(1 + |x|)
    scales              RGB    entries of scales.codebook: natural logarithms of standard deviations
    quats               RGBA   127.5 + 127.5 sqrt(2) times the components but the largest, which is positive, in the
                               order wxyz; A = 252 + the number of the largest
    sh0                 RGBA   entries of sh0.codebook: harmonics of band 0; A = 255 opacity
    shN_labels          RG     low and high bytes of the number of a palette row
    shN_centroids       RGB    the palette, 64 rows side by side, a pixel for each coefficient of bands 1 and up:
                               entries of shN.codebook
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from hyrfpack.errors import HyrfDataError
from hyrfpack.quant.morton import morton_codes
from hyrfpack.splats.formats.checked import checked_splats
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.formats.palette import build_palette, nearest
from hyrfpack.splats.formats.smallest_three import with_largest, without_largest
from hyrfpack.splats.names import SOG_META as META
from hyrfpack.splats.splats import Splats

_FILES = {
    "means": ("means_l.webp", "means_u.webp"),
    "scales": ("scales.webp",),
    "quats": ("quats.webp",),
    "sh0": ("sh0.webp",),
    "shN": ("shN_centroids.webp", "shN_labels.webp"),
}
_ENTRIES = 256  # of a codebook
_ABREAST = 64  # palette rows side by side
_LEAST_SCALE = 1e-12  # the logarithm of nothing is not a number

# On baked scenes of 20,000 to 30,000 Gaussians of degree 3, a row for 4 Gaussians loses 0.06 dB and takes 29 % of the
# file; one for 8 loses 0.12 dB in a file 15 % smaller, one for 2 loses 0.02 dB in one a quarter larger. Beyond the cap
# it is time that grows.
_GAUSSIANS_A_ROW = 4
_MOST_ROWS = 16384
_LARGEST_PALETTE = 65536  # that labels of 16 bits can name

# More effort (method 4 to 6, quality 75 to 100) takes up to 30 times as long, and makes larger files of these pictures.
_WEBP = {"lossless": True, "exact": True, "method": 2, "quality": 50}

_MOST_GAUSSIANS = 1 << 26
_PADDED, _FREE_PIXELS = 4, 1 << 16  # a picture has at most so many pixels a Gaussian, and these
_MOST_META = 1 << 20  # bytes
_UNEARNED = 1 << 20  # Gaussians that pictures of no size may hold; more need a byte each


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """A `.sog` file. Deterministic.

    Positions are rounded to 1 / 65535 of the scene's extent after sign(x) log(1 + |x|), opacities to 1 / 255, rotations
    by less than a degree; scales and colours to one of 256 values, and harmonics of bands 1 and up to the nearest row
    of a palette. Scales under 1e-12 become that. The order changes, and a file of no Gaussians has degree 0.

    Raises:
        HyrfDataError: more than 67,108,864 Gaussians.
    """
    bundle = io.BytesIO()
    with zipfile.ZipFile(bundle, "w") as archive:
        for name, data in encode_files(splats).items():
            member = zipfile.ZipInfo(name)  # dated 1980, not now
            member.create_system = 3  # and not by this machine's kind
            archive.writestr(member, data)
    return bundle.getvalue()


def encode_files(splats: Splats) -> dict[str, bytes]:
    """The same as `encode` as loose files by name: for a folder, opened through its meta.json."""
    count = len(splats)
    if count > _MOST_GAUSSIANS:
        raise HyrfDataError(
            f"SOG: {count:,} Gaussians are too many, a file holds {_MOST_GAUSSIANS:,}; write a PLY instead"
        )
    drawn_in = np.sign(splats.positions) * np.log1p(np.abs(splats.positions))
    mins, maxs = (drawn_in.min(0), drawn_in.max(0)) if count else (np.zeros(3), np.zeros(3))
    steps = np.rint((drawn_in - mins) / np.where(maxs > mins, maxs - mins, 1) * 65535).astype(np.uint16)
    order = np.argsort(morton_codes(steps), kind="stable")
    splats, steps = splats[order], steps[order]

    scale_book, scales = _to_codebook(np.log(np.maximum(splats.scales, _LEAST_SCALE)))
    color_book, colors = _to_codebook(splats.harmonics[:, 0])
    columns = {
        "means_l.webp": steps & 255,
        "means_u.webp": steps >> 8,
        "scales.webp": scales,
        "quats.webp": _pack_quats(splats.quats),
        "sh0.webp": np.column_stack((colors, np.rint(splats.opacities * 255))),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "hyrfpack"},
        "count": count,
        "antialias": splats.antialiased,
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist()},
        "scales": {"codebook": scale_book.tolist()},
        "quats": {},
        "sh0": {"codebook": color_book.tolist()},
    }
    files = {}
    if splats.degree and count:
        book, palette, labels = _to_palette(splats)
        files["shN_centroids.webp"] = _webp(palette)
        columns["shN_labels.webp"] = np.column_stack((labels & 255, labels >> 8, np.zeros_like(labels)))
        rows = palette.shape[0] * _ABREAST
        meta["shN"] = {"count": rows, "bands": splats.degree, "codebook": book.tolist()}
    for group, names in _FILES.items():
        if group in meta:
            meta[group]["files"] = list(names)

    width = max(4, 4 * math.ceil(math.sqrt(count) / 4))
    height = max(4, 4 * math.ceil(count / width / 4))
    for name, values in columns.items():
        pixels = np.zeros((height * width, values.shape[1]), np.uint8)
        pixels[:count] = values
        files[name] = _webp(pixels.reshape(height, width, -1))
    return {META: json.dumps(meta, separators=(",", ":")).encode(), **files}


def unzip(data: bytes, name: str) -> dict[str, bytes]:
    """The files of a `.sog` bundle that its meta.json names, and meta.json itself, for `decode_files`.

    Args:
        data: the bundle.
        name: what messages call it.

    Raises:
        HyrfDataError: not a zip, damaged, a file is missing, or it would unpack to far more than it is.
    """
    room = 2 * len(data) + _MOST_META  # pictures are packed already: a zip does not make them much smaller
    files = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for wanted in (META, *picture_names(archive.read(_member(archive, META, _MOST_META, name)), name)):
                member = _member(archive, wanted, room, name)
                room -= member.file_size
                files[wanted] = archive.read(member)
    except HyrfDataError:
        raise
    except Exception as error:  # zipfile lets through what its parts raise: a dozen kinds
        raise HyrfDataError(f"{name}: the zip cannot be unpacked ({error}); get the file again") from error
    return files


def picture_names(meta: bytes, name: str) -> list[str]:
    """The pictures that a meta.json names, plain file names that lie beside it. Raises HyrfDataError."""
    parsed = _parse(meta, name)
    return list(dict.fromkeys(_file(parsed, group, i, name) for group in _groups(parsed) for i in _numbers_of(group)))


def decode(data: bytes, name: str) -> Splats:
    """Splats of a `.sog` bundle. Errors as those of `unzip` and `decode_files`."""
    return decode_files(unzip(data, name), name)


def decode_files(files: Mapping[str, bytes], name: str) -> Splats:
    """Splats out of meta.json and the pictures that it names.

    Args:
        files: contents by name, from `unzip` or a folder.
        name: what messages call it.

    Raises:
        HyrfDataError: missing, damaged or contradictory; version 1; or more Gaussians than such small files can hold.
    """
    meta = _parse(_get(files, META, name), name)
    count = meta.get("count")
    size = sum(map(len, files.values()))
    if type(count) is not int or not 0 <= count <= min(_MOST_GAUSSIANS, size + _UNEARNED):
        raise HyrfDataError(f"{name}: {META} gives {count!r:.40} as count of Gaussians in {size:,} bytes; damaged")

    def pixels(group: str, number: int = 0) -> np.ndarray:
        file = _file(meta, group, number, name)
        picture = _read_picture(_get(files, file, name), _PADDED * count + _FREE_PIXELS, f"{name}: {file}")
        picture = picture.reshape(-1, 4)
        if len(picture) < count:
            raise HyrfDataError(f"{name}: {file} has {len(picture):,} pixels for {count:,} Gaussians; it is damaged")
        return picture[:count]

    mins, maxs = (_floats(meta, "means", key, name, 3) for key in ("mins", "maxs"))
    steps = pixels("means", 0)[:, :3] + 256.0 * pixels("means", 1)[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is refused
        drawn_in = mins + steps / 65535 * (maxs - mins)
        positions = np.sign(drawn_in) * np.expm1(np.abs(drawn_in))
        scales = np.exp(_from_codebook(meta, "scales", pixels("scales")[:, :3], name))
    colors = pixels("sh0")
    harmonics = _from_codebook(meta, "sh0", colors[:, :3], name)[:, None]
    if "shN" in meta:
        palette = _read_palette(meta, files, name)
        labels = pixels("shN", 1)[:, :2] @ np.array((1, 256))
        if labels.max(initial=0) >= len(palette):
            raise HyrfDataError(f"{name}: a label names row {labels.max()} of {len(palette)}; shN_labels is damaged")
        harmonics = np.concatenate((harmonics, palette[labels]), axis=1)
    quats = _unpack_quats(pixels("quats"), name)
    opacities = colors[:, 3] / np.float32(255)
    return checked_splats(name, positions, scales, quats, opacities, harmonics, meta.get("antialias") is True)


def _to_codebook(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A codebook (256,) float32, ascending, and the entries (...) uint8 nearest to values (...).

    Up to 256 different values are kept as they are. Otherwise steps are almost even: entries of even steps are the
    cheapest in bytes for the error that they make. But they grow far out, lest one value beyond all others make them
    coarse for all: even in asinh((v - median) / s), s 8 times the mean distance from the median.
    """
    distinct = np.unique(values)
    if len(distinct) <= _ENTRIES:
        book = np.pad(distinct, (0, _ENTRIES - len(distinct)), mode="edge" if len(distinct) else "constant")
        return book.astype(np.float32), np.searchsorted(distinct, values).astype(np.uint8)
    middle = float(np.median(values))
    spread = 8 * float(np.abs(values - middle).mean(dtype=np.float64))
    low, high = np.arcsinh((distinct[[0, -1]].astype(np.float64) - middle) / spread)
    book = (middle + spread * np.sinh(np.linspace(low, high, _ENTRIES))).astype(np.float32)
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def _from_codebook(meta: dict, group: str, entries: np.ndarray, name: str) -> np.ndarray:
    """Values (...) float32 of entries (...)."""
    book = _floats(meta, group, "codebook", name, _ENTRIES).astype(np.float32)
    return book[entries]


def _to_palette(splats: Splats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Codebook (256,), palette as a picture (H, 64 T, 3) uint8, T coefficients a row, and labels (N,)."""
    terms = splats.harmonics.shape[1] - 1
    rows = splats.harmonics[:, 1:].reshape(len(splats), -1)
    size = _ABREAST * max(1, min(_MOST_ROWS, len(rows) // _GAUSSIANS_A_ROW) // _ABREAST)
    # The basis is orthonormal: distances of coefficients are those of colours over all directions. The weight lies
    # between that of every Gaussian alike and that of its area as it is seen; both make worse pictures.
    _, middle, largest = np.sort(splats.scales.astype(np.float64), axis=1).T
    weights = splats.opacities * (middle * largest) ** 0.25
    weights += max(0.01 * weights.mean(), 1e-30)
    palette = build_palette(rows, weights, size)
    palette = np.pad(palette, ((0, -len(palette) % _ABREAST), (0, 0)), mode="edge")
    book, entries = _to_codebook(palette)
    labels, _ = nearest(rows, book[entries])
    return book, entries.reshape(-1, _ABREAST * terms, 3), labels


def _read_palette(meta: dict, files: Mapping[str, bytes], name: str) -> np.ndarray:
    """(K, T, 3) float32 rows of harmonics of bands 1 and up, T = 3, 8 or 15."""
    file = _file(meta, "shN", 0, name)
    picture = _read_picture(_get(files, file, name), _LARGEST_PALETTE * 15, f"{name}: {file}")[..., :3]
    height, width, _ = picture.shape
    if width not in (64 * 3, 64 * 8, 64 * 15) or height * _ABREAST > _LARGEST_PALETTE:
        raise HyrfDataError(f"{name}: {file} is {width} x {height}, no palette of degree 1 to 3; it is damaged")
    return _from_codebook(meta, "shN", picture.reshape(height * _ABREAST, -1, 3), name)


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions (N, 4) wxyz to bytes (N, 4)."""
    largest, smaller = without_largest(quats)
    return np.column_stack((np.rint(np.clip(smaller * math.sqrt(2), -1, 1) * 127.5 + 127.5), 252 + largest))


def _unpack_quats(packed: np.ndarray, name: str) -> np.ndarray:
    """Bytes (N, 4) to quaternions (N, 4) wxyz."""
    tags = packed[:, 3]
    if tags.min(initial=255) < 252:
        raise HyrfDataError(f"{name}: a rotation has the tag {tags.min()}, not 252 to 255; its picture is damaged")
    return with_largest(tags - 252, (packed[:, :3] / 127.5 - 1) * math.sqrt(0.5))


def _webp(pixels: np.ndarray) -> bytes:
    """Lossless WebP of (H, W, 3 or 4) uint8; colours stay where alpha is 0."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", **_WEBP)
    return file.getvalue()


def _read_picture(data: bytes, most: int, name: str) -> np.ndarray:
    """(H, W, 4) uint8, of at most `most` pixels."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as picture:
                # Opened, not decoded.
                if picture.width * picture.height > most or picture.mode not in ("RGB", "RGBA"):
                    found = f"{picture.width} x {picture.height} pixels of {picture.mode}"
                    raise HyrfDataError(f"{name} has {found}, not RGB or too many; it is damaged")
                return np.asarray(picture.convert("RGBA"))
    except HyrfDataError:
        raise
    except Exception as error:  # whatever a decoder of pictures raises
        raise HyrfDataError(f"{name} is not a picture that can be read; get the file again") from error


def _member(archive: zipfile.ZipFile, file: str, room: int, name: str) -> zipfile.ZipInfo:
    """A file of the zip, at most `room` bytes large, packed in a way that is unpacked piece by piece."""
    if file not in archive.NameToInfo:
        raise HyrfDataError(f"{name}: the zip has no {file}; it is not a SOG, or damaged")
    member = archive.getinfo(file)
    if member.file_size > room:
        raise HyrfDataError(f"{name}: {file} unpacks to {member.file_size:,} bytes, far too many; it is damaged")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others pay no heed to the size
        raise HyrfDataError(f"{name}: {file} is packed by method {member.compress_type}; zip it stored or deflated")
    return member


def _get(files: Mapping[str, bytes], file: str, name: str) -> bytes:
    try:
        return files[file]
    except KeyError:
        raise HyrfDataError(f"{name}: {file} is missing; put it beside the others") from None


def _parse(data: bytes, name: str) -> dict:
    """meta.json, of version 2."""
    if len(data) > _MOST_META:
        raise HyrfDataError(f"{name}: {META} has {len(data):,} bytes, far too many; it is damaged")
    try:
        meta = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(f"{name}: {META} is not JSON ({error}); get the file again") from error
    if not isinstance(meta, dict):
        raise HyrfDataError(f"{name}: {META} holds no SOG; it is damaged")
    version = meta.get("version", 1)  # the first had none
    if version != 2:
        raise HyrfDataError(
            f"{name}: this is SOG version {version!r:.40} and 2 is read; convert it with splat-transform"
        )
    return meta


def _groups(meta: dict) -> list[str]:
    return [group for group in _FILES if group != "shN" or group in meta]


def _numbers_of(group: str) -> range:
    return range(len(_FILES[group]))


def _file(meta: dict, group: str, number: int, name: str) -> str:
    """The name of a picture."""
    listed = meta[group].get("files") if isinstance(meta.get(group), dict) else None
    file = listed[number] if isinstance(listed, list) and number < len(listed) else None
    if not isinstance(file, str) or not file.isprintable() or file in ("", "..") or set(file) & set("/\\:"):
        raise HyrfDataError(f"{name}: {META} names {file!r:.80} as picture {number + 1} of {group}; it is damaged")
    return file


def _floats(meta: dict, group: str, key: str, name: str, length: int) -> np.ndarray:
    """(length,) float64, finite."""
    values = meta[group].get(key) if isinstance(meta.get(group), dict) else None
    values = list(values) if isinstance(values, list) and len(values) == length else [math.nan]
    lost = length == _ENTRIES and values[0] is None  # by old writers
    # What float32 cannot hold is no more use than what is not finite.
    if not all(type(value) in (int, float) and abs(value) < 1e38 for value in values[lost:]):
        raise HyrfDataError(f"{name}: {META} needs {length} finite numbers as {group}.{key}; it is damaged")
    if lost:
        values[0] = values[1] + (values[1] - values[-1]) / 255  # as PlayCanvas puts it back
    return np.array(values, np.float64)
