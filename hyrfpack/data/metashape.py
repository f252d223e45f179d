"""Read cameras that Agisoft Metashape exported as XML ("Export Cameras") beside the photos.

A camera's `transform` is world_from_camera, row by row, in the frame of its component, with OpenCV's axes. A sensor's
calibration has f, cx and cy (from the picture's centre), b1 and b2 in pixels, and k1 to k4, p1 and p2:

    x = X / Z, y = Y / Z            (fisheye: times theta / r, theta = atan r)
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y,   y' with p1 and p2, x and y exchanged
    u = w / 2 + cx + x' (f + b1) + y' b2,   v = h / 2 + cy + y' f

OpenCV's p1 is Metashape's p2 and vice versa. A component (in older files the chunk) may have a rotation, a translation
and a scale, which map it to the coordinates of exported points.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from hyrfpack.counts import format_count
from hyrfpack.data.assemble import assemble_scene
from hyrfpack.data.equirectangular import panorama_lens
from hyrfpack.data.pictures import PictureHeader
from hyrfpack.data.sidecar_files import (
    PoseEntry,
    find_first_file,
    find_listed_photos,
    find_picture_folder,
    read_sidecar_points,
)
from hyrfpack.data.transforms import pose_from_camera_axes
from hyrfpack.data.undistort import Lens, brown_coefficients
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

Element = ElementTree.Element

_FISHEYE_TYPES = ("fisheye", "equidistant", "equidistant_fisheye")
_PANORAMA_TYPE = "spherical"
_CALIBRATION_KEYS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_MIN_GEOCENTRIC_COORDINATE = 1e5  # frames with a larger translation are placed on the Earth


@dataclass(frozen=True)
class _Frame:
    """The similarity transform x -> scale R x + t from a component to the world."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: float


_IDENTITY_FRAME = _Frame(np.eye(3), np.zeros(3), 1.0)


def find_metashape(path: Path) -> Path | None:
    """Find the first file, in order of names, that holds Metashape's cameras."""
    return find_first_file(path, ".xml", _is_camera_file)


def read_metashape(path: Path, *, test_every: int, images: str | None, max_size: int) -> Scene:
    """Read cameras, and the points of a `.ply` file beside them if it has the same coordinates.

    Args:
        path: the scene folder.
        test_every, max_size: see `load_scene`.
        images: the folder of photos; None takes the one that `find_picture_folder` finds.

    Raises:
        HyrfDataError: the cameras or the photos cannot be used.
    """
    table = find_metashape(path)
    if table is None:
        raise HyrfDataError(
            f"{path}: there is no file of Metashape cameras (.xml)",
            fix="export it with Export Cameras",
        )
    chunk, notes = _choose_chunk(_parse(table), table)
    frame, component, frame_notes = _choose_frame(chunk, table)
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    entries: list[PoseEntry] = []
    lenses: dict[str | None, Lens | Callable[[Path, PictureHeader], Lens]] = {}
    unposed = 0
    for camera in _cameras(chunk):
        label, key = camera.get("label"), camera.get("sensor_id")
        transform = camera.findtext("transform")
        if transform is None or not _is_in_component(camera, component):
            unposed += 1
            continue
        where = f"{table}: camera {(label or camera.get('id') or '')[:80]!r}"
        if not label:
            raise HyrfDataError(f"{where} has no label, which is the name of its photo", fix="export the cameras again")
        if key not in sensors:
            raise HyrfDataError(
                f"{where} is of a sensor that the file does not describe",
                fix="export the cameras again",
            )
        if key not in lenses:
            lenses[key] = _lens(sensors[key], f"{table}: sensor {key}")
        matrix = _parse_numbers(transform, 16, where).reshape(4, 4)
        with np.errstate(all="ignore"):
            axes = frame.rotation @ matrix[:3, :3]
            position = frame.scale * (frame.rotation @ matrix[:3, 3]) + frame.translation
        entries.append((label, lenses[key], pose_from_camera_axes(axes, position)))
    photos, masks, found = find_listed_photos(path, find_picture_folder(path, images), entries, table.name)
    notes += frame_notes + found
    if unposed:
        left_out = "no pose in the chosen component and"
        notes.append(f"{format_count(unposed, f'photo has {left_out} was', f'photos have {left_out} were')} skipped")
    points, colors, tables = read_sidecar_points(path, photos, notes)
    return assemble_scene(
        path,
        "metashape",
        photos,
        test_every=test_every,
        max_size=max_size,
        points=points,
        point_colors=colors,
        tables=[table, *tables],
        masks=masks,
        notes=notes,
    )


def _is_camera_file(file: Path) -> bool:
    """Return whether a file starts like Metashape's XML."""
    try:
        with file.open("rb") as stream:
            head = stream.read(4096)
    except OSError:
        return False
    return b"<document" in head and b"<chunk" in head


def _parse(table: Path) -> Element:
    """Parse an XML file that declares no entities."""
    try:
        data = table.read_bytes()
    except OSError as error:
        raise HyrfDataError(f"{table}: cannot be read ({error.strerror})", fix="restore the file") from error
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:  # entities can expand a line to gigabytes
        raise HyrfDataError(f"{table}: declares entities, which Metashape does not", fix="export the cameras again")
    try:
        return ElementTree.fromstring(data)
    except Exception as error:  # raised by the parser, or by the codec of the encoding that the file declares
        raise HyrfDataError(f"{table}: not valid XML ({str(error)[:120]})", fix="export the cameras again") from error


def _cameras(chunk: Element) -> list[Element]:
    """List the enabled cameras, including those in groups."""
    return [camera for camera in chunk.iterfind("cameras//camera") if camera.get("enabled") not in ("false", "0")]


def _choose_chunk(document: Element, table: Path) -> tuple[Element, list[str]]:
    """Select the chunk with the most posed cameras; also return a note if there are several chunks."""
    sizes = [(sum(c.find("transform") is not None for c in _cameras(chunk)), chunk) for chunk in document.iter("chunk")]
    most = max((size for size, _ in sizes), default=0)
    if not most:
        raise HyrfDataError(
            f"{table}: no camera in it has a pose",
            fix="align the photos, then export the cameras again",
        )
    chosen = next(chunk for size, chunk in sizes if size == most)
    if len(sizes) == 1:
        return chosen, []
    return chosen, [f"there are {len(sizes)} chunks in {table.name}; the one with the most cameras ({most}) is used"]


def _is_in_component(camera: Element, component: str | None) -> bool:
    """Return whether a camera belongs to a component; without components or without an id, it belongs to any."""
    return component is None or camera.get("component_id") in (None, component)


def _choose_frame(chunk: Element, table: Path) -> tuple[_Frame, str | None, list[str]]:
    """Select the component with the most cameras; return its frame, its id (None without components), and notes.

    Geocentric coordinates, in which cameras are millions of metres from the origin, are not applied.
    """
    ids = Counter(c.get("component_id") for c in _cameras(chunk) if c.find("transform") is not None)
    component = max((key for key in ids if key is not None), key=lambda key: ids[key], default=None)
    notes = []
    count = sum(key is not None for key in ids)
    if count > 1:
        notes.append(f"there are {count} components; the one with the most cameras ({ids[component]}) is used")
    elements = [c for c in chunk.iterfind("components/component") if c.get("id") == component]
    transform = next((e.find("transform") for e in (*elements, chunk) if e.find("transform") is not None), None)
    if transform is None or transform.find("rotation") is None:
        return _IDENTITY_FRAME, component, notes
    where = f"{table}: the transform of the {'component' if elements else 'chunk'}"
    frame = _Frame(
        _parse_numbers(transform.findtext("rotation"), 9, where).reshape(3, 3),
        _parse_numbers(transform.findtext("translation") or "0 0 0", 3, where),
        float(_parse_numbers(transform.findtext("scale") or "1", 1, where)[0]),
    )
    if not frame.scale > 0 or np.abs(frame.rotation @ frame.rotation.T - np.eye(3)).max() > 1e-3:
        raise HyrfDataError(f"{where} is not a rotation with a positive scale", fix="export the cameras again")
    if np.abs(frame.translation).max() > _MIN_GEOCENTRIC_COORDINATE:
        notes.append("the cameras are georeferenced; they stay in the coordinate system of their component")
        return _IDENTITY_FRAME, component, notes
    return frame, component, notes


def _lens(sensor: Element, where: str) -> Lens | Callable[[Path, PictureHeader], Lens]:
    """Return the lens of a sensor, or for panoramas a function that returns it."""
    calibrations = {element.get("class"): element for element in sensor.iterfind("calibration")}
    calibration = calibrations.get("adjusted", next(iter(calibrations.values()), None))
    kind = (None if calibration is None else calibration.get("type")) or sensor.get("type") or "frame"
    if kind == _PANORAMA_TYPE:
        return panorama_lens
    if calibration is None:
        raise HyrfDataError(f"{where} has no calibration", fix="align the photos, then export the cameras again")
    values = dict.fromkeys(_CALIBRATION_KEYS, 0.0)
    for name in _CALIBRATION_KEYS:
        text = calibration.findtext(name)
        if text is not None:
            values[name] = float(_parse_numbers(text, 1, where)[0])
    size = calibration.find("resolution")
    if size is None:
        size = sensor.find("resolution")
    width, height = (_pixels(size, side, where) for side in ("width", "height"))
    f, k, p = values["f"], [values[f"k{i}"] for i in (1, 2, 3, 4)], (values["p2"], values["p1"])
    cx, cy = width / 2 + values["cx"], height / 2 + values["cy"]
    lens = Lens(width, height, f + values["b1"], f, cx, cy, skew=values["b2"])
    if values["p3"] or values["p4"]:
        raise HyrfDataError(
            f"{where} has p3 or p4, which are not supported",
            fix="calibrate without them, or undistort the photos",
        )
    if kind == "frame":
        return replace(lens, model="brown", coefficients=brown_coefficients(k[0], k[1], *p, k[2], 0, 0, 0, k[3]))
    if kind in _FISHEYE_TYPES:
        return replace(lens, model="fisheye", coefficients=(*k, *p) if any(p) else tuple(k))
    raise HyrfDataError(
        f"{where} is of type {kind[:40]!r}, which is not supported",
        fix="export undistorted photos instead",
    )


def _pixels(size: Element | None, side: str, where: str) -> int:
    """Read the width or the height of a resolution in pixels."""
    value = float(_parse_numbers(None if size is None else size.get(side), 1, where)[0])
    return round(value)


def _parse_numbers(text: str | None, count: int, where: str) -> np.ndarray:
    """Parse a text of `count` finite numbers to float64."""
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise HyrfDataError(
            f"{where} needs {count} finite numbers where it says {str(text)[:60]!r}",
            fix="export it again",
        )
    return np.array(values)
