"""Read the photos that a run was trained on, as recorded in its folder."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hyrfpack.counts import format_count
from hyrfpack.data import LAYOUTS, load_scene
from hyrfpack.errors import HyrfDataError
from hyrfpack.format.run_folder import METRICS_FILE, MODEL_FILE, find_model
from hyrfpack.scene import Scene, is_max_size


def load_training_scene(model: str | os.PathLike[str]) -> Scene | None:
    """Read the photos that the model in a run's folder was trained on, with the same held-out photos.

    Args:
        model: the folder that `hyrfpack.train_model` wrote, or `model.hyrf` in it.

    Returns:
        The photos; None if the file is not in a run's folder, or the run has no record of its photos.

    Raises:
        HyrfDataError: the photos are missing or have changed.

    Example:
        >>> import hyrfpack
        >>> from hyrfpack.train import load_training_scene
        >>> photos = load_training_scene("runs/bonsai/model.hyrf")
        >>> len(photos.train), len(photos.test)
        (8, 2)
    """
    model = find_model(model)
    recorded = _read_recorded_photos(model)
    if recorded is None:
        return None
    path, reading, sizes = recorded
    scene = load_scene(path, **reading)
    if sizes != (len(scene.train), len(scene.test)):
        raise HyrfDataError(
            f"{path}: the set has {format_count(len(scene.train), 'photo')} to train on and {len(scene.test)} "
            f"held out, but {model} was trained on {sizes[0]} of {sum(sizes)}",
            fix="name the photos with `data`",
        )
    return scene


def read_recorded_split(model: Path, photos: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Read the arguments of `load_scene` with which a run held photos out.

    Args:
        model: file of a model.
        photos: folder of photos.
        options: other arguments of `load_scene` that are given.

    Returns:
        "test_every", and "held_out" if photos were held out by name; empty if the model is not that of a run on these
        photos, read with these options.
    """
    recorded = _read_recorded_photos(model)
    if recorded is None:
        return {}
    path, reading, _ = recorded
    is_same = all(options.get(name, reading[name]) == reading[name] for name in ("images", "layout", "model"))
    if not is_same or os.path.realpath(path) != os.path.realpath(photos):
        return {}
    return {name: reading[name] for name in ("test_every", "held_out") if name in reading}


def _read_recorded_photos(model: Path) -> tuple[str, dict[str, Any], tuple[int, int]] | None:
    """Read the record of a run's photos beside its model.

    Returns:
        The path of the photos, the other arguments of `load_scene`, and the numbers of photos to train on and held out;
        None if the model is not in the folder of a run, or the record is not valid.
    """
    if model.name != MODEL_FILE:
        return None
    try:
        recorded = json.loads((model.parent / METRICS_FILE).read_text("utf-8"))["scene"]
        reading, sizes = dict(recorded["reading"]), (recorded["train"], recorded["test"])
        path = reading.pop("path")
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    if not _is_reading(path, reading) or not all(type(size) is int for size in sizes):
        return None
    return path, reading, sizes


def _is_reading(path: object, options: dict) -> bool:
    """Return whether values from a run's folder, which may be hostile, are valid arguments of `load_scene`."""
    text = (str, type(None))
    kinds: dict[str, Any] = {"test_every": int, "images": text, "layout": str, "model": text, "max_size": int}
    held_out = options.get("held_out", [])  # The key exists only if photos were held out by name.
    if not isinstance(held_out, list) or not all(isinstance(name, str) for name in held_out):
        return False
    options = {name: value for name, value in options.items() if name != "held_out"}
    try:
        os.fsencode(str(path))
    except UnicodeEncodeError:
        return False
    if not isinstance(path, str) or "\0" in path or options.keys() != kinds.keys():
        return False
    return (
        all(isinstance(value, kinds[name]) and not isinstance(value, bool) for name, value in options.items())
        and options["layout"] in LAYOUTS
        and options["test_every"] >= 0
        and is_max_size(options["max_size"])
    )
