"""PlayCanvas SOG, version 2: meta.json and lossless WebP pictures, in a stored zip (`.sog`) or unbundled in a folder.

Each pixel of a picture belongs to one Gaussian, row by row from the top left, in the order of a Morton curve. Source:
the PlayCanvas user manual, "The SOG Format" (developer.playcanvas.com).

    means_l, means_u    RGB    low and high bytes of a position: sign(x) log(1 + |x|), in 65535 steps from means.mins
                               to means.maxs
    scales              RGB    indices into scales.codebook: natural logarithms of standard deviations
    quats               RGBA   127.5 + 127.5 sqrt(2) times the three smallest components, in the order wxyz, of the
                               sign whose largest component is positive; A = 252 + the index of the largest
    sh0                 RGBA   indices into sh0.codebook: harmonics of band 0; A = 255 opacity
    shN_labels          RG     low and high bytes of the number of a palette row
    shN_centroids       RGB    the palette, 64 rows side by side, with one pixel for each coefficient of bands 1 and
                               up: indices into shN.codebook
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from PIL import Image

from hyrfpack.errors import HyrfDataError
from hyrfpack.quant.morton import morton_codes
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.formats.palette import build_palette, find_nearest_entries
from hyrfpack.splats.formats.smallest_three import drop_largest, restore_largest
from hyrfpack.splats.formats.validation import build_valid_splats
from hyrfpack.splats.names import SOG_META_NAME as META_NAME
from hyrfpack.splats.splats import MAX_ABS_HARMONIC, Splats, clamp_harmonics

_PICTURES_BY_GROUP = {
    "means": ("means_l.webp", "means_u.webp"),
    "scales": ("scales.webp",),
    "quats": ("quats.webp",),
    "sh0": ("sh0.webp",),
    "shN": ("shN_centroids.webp", "shN_labels.webp"),
}
_CODEBOOK_ENTRIES = 256
_PALETTE_ROWS_PER_PICTURE_ROW = 64
_MIN_SCALE = 1e-12  # because the logarithm of 0 is not finite

# On baked scenes of 20,000 to 30,000 Gaussians of degree 3, a palette row for 4 Gaussians loses 0.06 dB and takes 29 %
# of the file. A row for 8 loses 0.12 dB in a file 15 % smaller; a row for 2 loses 0.02 dB in a file a quarter larger.
_GAUSSIANS_PER_PALETTE_ROW = 4
_MAX_WRITTEN_PALETTE_ROWS = 16384  # because more rows take much longer
_MAX_PALETTE_ROWS = 65536  # because labels have 16 bits

# Higher settings (method 4 to 6, quality 75 to 100) take up to 30 times as long and make these pictures larger.
_WEBP_OPTIONS = {"lossless": True, "exact": True, "method": 2, "quality": 50}

_MAX_GAUSSIANS = 1 << 26
# The limits below protect a reader against small files that would unpack to very large arrays.
_MAX_PIXELS_PER_GAUSSIAN = 4
_MAX_EXTRA_PIXELS = 1 << 16
_MAX_META_BYTES = 1 << 20
_MAX_GAUSSIANS_WITHOUT_BYTES = 1 << 20  # each further Gaussian needs a byte of the file


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """Encode splats as a `.sog` file. The same splats give the same bytes.

    Positions are mapped by sign(x) log(1 + |x|) and rounded to 1 / 65535 of the scene's extent. Opacities are rounded
    to 1 / 255, and rotations by less than a degree. Scales and colours become one of 256 values, and harmonics of
    bands 1 and up the nearest row of a palette. Scales below 1e-12 become 1e-12, and harmonics beyond +-100,000 that
    limit, with a warning. The order of the Gaussians changes. A
    file without Gaussians has degree 0.

    Raises:
        HyrfDataError: there are more than 67,108,864 Gaussians.
    """
    splats = clamp_harmonics(splats, "SOG")
    bundle = io.BytesIO()
    with zipfile.ZipFile(bundle, "w") as archive:
        for name, data in encode_files(splats).items():
            member = zipfile.ZipInfo(name)  # dated 1980, so that the bytes do not depend on the time
            member.create_system = 3  # Unix, so that the bytes do not depend on the operating system
            archive.writestr(member, data)
    return bundle.getvalue()


def encode_files(splats: Splats, group_sizes: Sequence[int] = ()) -> dict[str, bytes]:
    """Encode splats as the files of an unbundled SOG, by name; programs open such a folder through its meta.json.

    Args:
        splats: the splats.
        group_sizes: sizes of groups of consecutive splats. Groups keep their order, and the Morton curve orders the
            splats in each group. Without any, all splats are one group.
    """
    # Distances of larger ones would overflow float32.
    splats = replace(splats, harmonics=splats.harmonics.clip(-MAX_ABS_HARMONIC, MAX_ABS_HARMONIC))
    count = len(splats)
    if count > _MAX_GAUSSIANS:
        raise HyrfDataError(
            f"SOG: {count:,} Gaussians are too many, a file holds {_MAX_GAUSSIANS:,}",
            fix="write a PLY instead",
        )
    log_positions = np.sign(splats.positions) * np.log1p(np.abs(splats.positions))
    mins, maxs = (log_positions.min(0), log_positions.max(0)) if count else (np.zeros(3), np.zeros(3))
    steps = np.rint((log_positions - mins) / np.where(maxs > mins, maxs - mins, 1) * 65535).astype(np.uint16)
    group_numbers = np.repeat(np.arange(len(group_sizes)), group_sizes) if group_sizes else np.zeros(count, np.int64)
    order = np.lexsort((morton_codes(steps), group_numbers))  # stable
    splats, steps = splats[order], steps[order]

    scale_book, scales = _quantize_to_codebook(np.log(np.maximum(splats.scales, _MIN_SCALE)))
    color_book, colors = _quantize_to_codebook(splats.harmonics[:, 0])
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
        book, palette, labels = _build_harmonics_palette(splats)
        files["shN_centroids.webp"] = _encode_webp(palette)
        columns["shN_labels.webp"] = np.column_stack((labels & 255, labels >> 8, np.zeros_like(labels)))
        rows = palette.shape[0] * _PALETTE_ROWS_PER_PICTURE_ROW
        meta["shN"] = {"count": rows, "bands": splats.degree, "codebook": book.tolist()}
    for group, names in _PICTURES_BY_GROUP.items():
        if group in meta:
            meta[group]["files"] = list(names)

    width = max(4, 4 * math.ceil(math.sqrt(count) / 4))
    height = max(4, 4 * math.ceil(count / width / 4))
    for name, values in columns.items():
        pixels = np.zeros((height * width, values.shape[1]), np.uint8)
        pixels[:count] = values
        files[name] = _encode_webp(pixels.reshape(height, width, -1))
    return {META_NAME: json.dumps(meta, separators=(",", ":")).encode(), **files}


def unzip(data: bytes, name: str) -> dict[str, bytes]:
    """Unpack meta.json and the pictures that it names from a `.sog` bundle, for `decode_files`.

    Args:
        data: the bundle's bytes.
        name: the file's name in error messages.

    Raises:
        HyrfDataError: the bytes are not a zip, are damaged, lack a file, or would unpack to far more than their size.
    """
    bytes_left = 2 * len(data) + _MAX_META_BYTES  # a zip shrinks pictures little, because they are compressed
    files = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for member_name in (
                META_NAME,
                *picture_names(archive.read(_find_member(archive, META_NAME, _MAX_META_BYTES, name)), name),
            ):
                member = _find_member(archive, member_name, bytes_left, name)
                bytes_left -= member.file_size
                files[member_name] = archive.read(member)
    except HyrfDataError:
        raise
    except Exception as error:  # zipfile lets a dozen types of error through from the modules that it uses
        raise HyrfDataError(f"{name}: the zip cannot be unpacked ({error})", fix="get the file again") from error
    return files


def picture_names(meta: bytes, name: str) -> list[str]:
    """List the pictures that a meta.json names: plain file names in its own folder.

    Raises:
        HyrfDataError: `meta` is damaged, or a name is not a plain file name.
    """
    parsed = _parse_meta(meta, name)
    return list(
        dict.fromkeys(
            _get_picture_name(parsed, group, i, name) for group in _list_groups(parsed) for i in _picture_numbers(group)
        )
    )


def decode(data: bytes, name: str) -> Splats:
    """Decode a `.sog` bundle. Raises the errors of `unzip` and `decode_files`."""
    return decode_files(unzip(data, name), name)


def decode_files(files: Mapping[str, bytes], name: str) -> Splats:
    """Decode meta.json and the pictures that it names.

    Args:
        files: contents by file name, from `unzip` or a folder.
        name: the name of the bundle or folder in error messages.

    Raises:
        HyrfDataError: a file is missing, damaged or contradicts another; the version is 1; or there are more Gaussians
            than such small files can hold.
    """
    meta = _parse_meta(_get_file(files, META_NAME, name), name)
    count = meta.get("count")
    size = sum(map(len, files.values()))
    if type(count) is not int or not 0 <= count <= min(_MAX_GAUSSIANS, size + _MAX_GAUSSIANS_WITHOUT_BYTES):
        raise HyrfDataError(
            f"{name}: {META_NAME} gives {count!r:.40} as count of Gaussians in {size:,} bytes",
            fix="the file is damaged, export it again",
        )

    def pixels(group: str, number: int = 0) -> np.ndarray:
        file = _get_picture_name(meta, group, number, name)
        picture = _read_picture(
            _get_file(files, file, name), _MAX_PIXELS_PER_GAUSSIAN * count + _MAX_EXTRA_PIXELS, f"{name}: {file}"
        )
        picture = picture.reshape(-1, 4)
        if len(picture) < count:
            raise HyrfDataError(
                f"{name}: {file} has {len(picture):,} pixels for {count:,} Gaussians",
                fix="the file is damaged, export it again",
            )
        return picture[:count]

    mins, maxs = (_get_floats(meta, "means", key, name, 3) for key in ("mins", "maxs"))
    steps = pixels("means", 0)[:, :3] + 256.0 * pixels("means", 1)[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # results that are not finite are rejected below
        log_positions = mins + steps / 65535 * (maxs - mins)
        positions = np.sign(log_positions) * np.expm1(np.abs(log_positions))
        scales = np.exp(_look_up_codebook(meta, "scales", pixels("scales")[:, :3], name))
    colors = pixels("sh0")
    harmonics = _look_up_codebook(meta, "sh0", colors[:, :3], name)[:, None]
    if "shN" in meta:
        palette = _read_palette(meta, files, name)
        labels = pixels("shN", 1)[:, :2] @ np.array((1, 256))
        if labels.max(initial=0) >= len(palette):
            raise HyrfDataError(
                f"{name}: shN_labels refers to row {labels.max()} of a palette with {len(palette)} rows",
                fix="the file is damaged, export it again",
            )
        harmonics = np.concatenate((harmonics, palette[labels]), axis=1)
    quats = _unpack_quats(pixels("quats"), name)
    opacities = colors[:, 3] / np.float32(255)
    return build_valid_splats(name, positions, scales, quats, opacities, harmonics, meta.get("antialias") is True)


def _quantize_to_codebook(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise values (...) to a codebook.

    Up to 256 distinct values are kept exactly. Otherwise the steps between entries are almost even, because even steps
    cost the fewest bytes for their error. Far from the median they grow, so that one outlier does not make all steps
    coarse: the steps are even in asinh((v - median) / s), with s 8 times the mean distance from the median.

    Returns:
        book: (256,) float32 ascending entries.
        indices: (...) uint8 indices of the nearest entries.
    """
    distinct = np.unique(values)
    if len(distinct) <= _CODEBOOK_ENTRIES:
        book = np.pad(distinct, (0, _CODEBOOK_ENTRIES - len(distinct)), mode="edge" if len(distinct) else "constant")
        return book.astype(np.float32), np.searchsorted(distinct, values).astype(np.uint8)
    middle = float(np.median(values))
    spread = 8 * float(np.abs(values - middle).mean(dtype=np.float64))
    low, high = np.arcsinh((distinct[[0, -1]].astype(np.float64) - middle) / spread)
    book = (middle + spread * np.sinh(np.linspace(low, high, _CODEBOOK_ENTRIES))).astype(np.float32)
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def _look_up_codebook(meta: dict, group: str, entries: np.ndarray, name: str) -> np.ndarray:
    """Look up codebook indices (...) of a group; returns (...) float32 values."""
    book = _get_floats(meta, group, "codebook", name, _CODEBOOK_ENTRIES).astype(np.float32)
    return book[entries]


def _build_harmonics_palette(splats: Splats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Build a palette for the harmonics of bands 1 and up.

    Returns:
        book: (256,) codebook of the palette's numbers.
        picture: (H, 64 T, 3) uint8 palette as a picture, T coefficients per palette row.
        labels: (N,) palette row of each Gaussian.
    """
    terms = splats.harmonics.shape[1] - 1
    rows = splats.harmonics[:, 1:].reshape(len(splats), -1)
    size = _PALETTE_ROWS_PER_PICTURE_ROW * max(
        1, min(_MAX_WRITTEN_PALETTE_ROWS, len(rows) // _GAUSSIANS_PER_PALETTE_ROW) // _PALETTE_ROWS_PER_PICTURE_ROW
    )
    # The basis is orthonormal, so distances of coefficients are those of colours over all directions. The weights are a
    # compromise between equal ones and the visible areas of the Gaussians. Both of these give worse pictures.
    _, middle, largest = np.sort(splats.scales.astype(np.float64), axis=1).T
    weights = splats.opacities * (middle * largest) ** 0.25
    weights += max(0.01 * weights.mean(), 1e-30)
    palette = build_palette(rows, weights, size)
    palette = np.pad(palette, ((0, -len(palette) % _PALETTE_ROWS_PER_PICTURE_ROW), (0, 0)), mode="edge")
    book, entries = _quantize_to_codebook(palette)
    labels, _ = find_nearest_entries(rows, book[entries])
    return book, entries.reshape(-1, _PALETTE_ROWS_PER_PICTURE_ROW * terms, 3), labels


def _read_palette(meta: dict, files: Mapping[str, bytes], name: str) -> np.ndarray:
    """Read the palette as (K, T, 3) float32 harmonics of bands 1 and up, T = 3, 8 or 15."""
    file = _get_picture_name(meta, "shN", 0, name)
    picture = _read_picture(_get_file(files, file, name), _MAX_PALETTE_ROWS * 15, f"{name}: {file}")[..., :3]
    height, width, _ = picture.shape
    if width not in (64 * 3, 64 * 8, 64 * 15) or height * _PALETTE_ROWS_PER_PICTURE_ROW > _MAX_PALETTE_ROWS:
        raise HyrfDataError(
            f"{name}: {file} is {width} x {height}, no palette of degree 1 to 3",
            fix="the file is damaged, export it again",
        )
    return _look_up_codebook(meta, "shN", picture.reshape(height * _PALETTE_ROWS_PER_PICTURE_ROW, -1, 3), name)


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Pack unit quaternions (N, 4) wxyz into bytes (N, 4)."""
    largest, smaller = drop_largest(quats)
    return np.column_stack((np.rint(np.clip(smaller * math.sqrt(2), -1, 1) * 127.5 + 127.5), 252 + largest))


def _unpack_quats(packed: np.ndarray, name: str) -> np.ndarray:
    """Unpack bytes (N, 4) into quaternions (N, 4) wxyz."""
    tags = packed[:, 3]
    if tags.min(initial=255) < 252:
        raise HyrfDataError(
            f"{name}: a rotation has the tag {tags.min()}, not 252 to 255",
            fix="the file is damaged, export it again",
        )
    return restore_largest(tags - 252, (packed[:, :3] / 127.5 - 1) * math.sqrt(0.5))


def _encode_webp(pixels: np.ndarray) -> bytes:
    """Encode (H, W, 3 or 4) uint8 as a lossless WebP picture that keeps colours where alpha is 0."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", **_WEBP_OPTIONS)
    return file.getvalue()


def _read_picture(data: bytes, max_pixels: int, name: str) -> np.ndarray:
    """Decode a picture as (H, W, 4) uint8 of at most `max_pixels` pixels."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as picture:
                # The size is checked before the pixels are decoded.
                if picture.width * picture.height > max_pixels or picture.mode not in ("RGB", "RGBA"):
                    description = f"{picture.width} x {picture.height} pixels of {picture.mode}"
                    raise HyrfDataError(
                        f"{name} has {description}, but must be RGB and not larger than needed",
                        fix="the file is damaged, export it again",
                    )
                return np.asarray(picture.convert("RGBA"))
    except HyrfDataError:
        raise
    except Exception as error:  # picture decoders raise many types of error
        raise HyrfDataError(f"{name} is not a picture that can be read", fix="get the file again") from error


def _find_member(archive: zipfile.ZipFile, file: str, bytes_left: int, name: str) -> zipfile.ZipInfo:
    """Find a file in the zip and check that it has at most `bytes_left` bytes and is stored or deflated."""
    if file not in archive.NameToInfo:
        raise HyrfDataError(f"{name}: the zip has no {file}, so that it is damaged or not a SOG", fix="export it again")
    member = archive.getinfo(file)
    if member.file_size > bytes_left:
        raise HyrfDataError(
            f"{name}: {file} unpacks to {member.file_size:,} bytes, far too many",
            fix="the file is damaged, export it again",
        )
    # With other methods, zipfile does not limit how much a piece of the file unpacks to.
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise HyrfDataError(
            f"{name}: {file} is packed by method {member.compress_type}",
            fix="zip it stored or deflated",
        )
    return member


def _get_file(files: Mapping[str, bytes], file: str, name: str) -> bytes:
    try:
        return files[file]
    except KeyError:
        raise HyrfDataError(f"{name}: {file} is missing", fix="put it beside the others") from None


def _parse_meta(data: bytes, name: str) -> dict:
    """Parse a meta.json of version 2."""
    if len(data) > _MAX_META_BYTES:
        raise HyrfDataError(
            f"{name}: {META_NAME} has {len(data):,} bytes, far too many",
            fix="the file is damaged, export it again",
        )
    try:
        meta = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(f"{name}: {META_NAME} is not JSON ({error})", fix="get the file again") from error
    if not isinstance(meta, dict):
        raise HyrfDataError(f"{name}: {META_NAME} does not describe a SOG", fix="the file is damaged, export it again")
    version = meta.get("version", 1)  # files of version 1 lack the key
    if version != 2:
        raise HyrfDataError(
            f"{name}: this is SOG version {version!r:.40}, but only version 2 can be read",
            fix="convert it with splat-transform",
        )
    return meta


def _list_groups(meta: dict) -> list[str]:
    return [group for group in _PICTURES_BY_GROUP if group != "shN" or group in meta]


def _picture_numbers(group: str) -> range:
    return range(len(_PICTURES_BY_GROUP[group]))


def _get_picture_name(meta: dict, group: str, number: int, name: str) -> str:
    """Return the file name of a picture of a group, and check that it is a plain name."""
    listed = meta[group].get("files") if isinstance(meta.get(group), dict) else None
    file = listed[number] if isinstance(listed, list) and number < len(listed) else None
    if not isinstance(file, str) or not file.isprintable() or file in ("", "..") or set(file) & set("/\\:"):
        raise HyrfDataError(
            f"{name}: {META_NAME} names {file!r:.80} as picture {number + 1} of {group}",
            fix="the file is damaged, export it again",
        )
    return file


def _get_floats(meta: dict, group: str, key: str, name: str, length: int) -> np.ndarray:
    """Read a list of `length` finite numbers from meta.json as float64."""
    values = meta[group].get(key) if isinstance(meta.get(group), dict) else None
    values = list(values) if isinstance(values, list) and len(values) == length else [math.nan]
    is_first_missing = length == _CODEBOOK_ENTRIES and values[0] is None  # some old writers omit this entry
    # Numbers beyond float32 are rejected like infinite ones.
    if not all(type(value) in (int, float) and abs(value) < 1e38 for value in values[is_first_missing:]):
        raise HyrfDataError(
            f"{name}: {META_NAME} needs {length} finite numbers as {group}.{key}",
            fix="the file is damaged, export it again",
        )
    if is_first_missing:
        values[0] = values[1] + (values[1] - values[-1]) / 255  # the value that PlayCanvas restores
    return np.array(values, np.float64)
