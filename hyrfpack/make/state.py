"""What a work folder holds: for each stage what it was made from, and the files that it made."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from hyrfpack.atomic import write_atomic
from hyrfpack.errors import HyrfDataError, HyrfError

NAME, VERSION = "make.json", 1
_CHUNK = 1 << 20


class State:
    """The record of a work folder, `make.json`, written whole after every change.

    For each stage it has `inputs`, plain values that decide what the stage makes; `fixed`, further ones that stay as
    they were when the stage was begun; `files`, what it made, by their paths in the folder, with digests; `facts`,
    plain values for the report; and the `seconds` it took. A stage that has begun and is not done has no `files`.

    Attributes:
        folder: the work folder.
    """

    def __init__(self, folder: Path) -> None:
        """Raises HyrfError: the folder holds something else, or its record cannot be read."""
        self.folder = folder
        self._path = folder / NAME
        self._stages: dict[str, dict[str, Any]] = {}
        try:
            there = os.listdir(folder) if folder.is_dir() else []
            if NAME in there:
                self._stages = _stages(self._path.read_bytes())
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise HyrfError(
                f"{self._path}: what was done so far cannot be read ({reason}); name another folder with `work`, or "
                "delete this one to begin anew"
            ) from error
        if there and NAME not in there and not all(name.startswith(".") for name in there):
            raise HyrfError(f"{folder}: this folder holds something else; name another with `work`")

    def begun(self, stage: str, inputs: dict[str, Any]) -> bool:
        """Whether a stage was begun from these inputs and did not come to its end."""
        record = self._stages.get(stage)
        return record is not None and "files" not in record and record["inputs"] == _plain(inputs)

    def is_under_way(self, stage: str, inputs: dict[str, Any]) -> bool:
        """Whether a stage was begun from these inputs, or is done and its files are as it left them."""
        return self.begun(stage, inputs) or self.facts(stage, inputs) is not None

    def changed(self, stage: str, inputs: dict[str, Any]) -> list[str]:
        """What keeps a stage that was begun from being taken: names of inputs that are others now, or its files."""
        if stage not in self._stages:
            return []
        before, now = self._stages[stage]["inputs"], _plain(inputs)
        return sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name)) or ["its files"]

    def facts(self, stage: str, inputs: dict[str, Any]) -> dict[str, Any] | None:
        """What a stage that is done from these inputs came to; None where it is not, or its files are others now."""
        record = self._stages.get(stage, {})
        if "files" not in record or record["inputs"] != _plain(inputs):
            return None
        return record["facts"] if self._digests(record["files"]) == record["files"] else None

    def inputs(self, stage: str) -> dict[str, Any]:
        """What a stage was begun from."""
        return dict(self._stages[stage]["inputs"])

    def fixed(self, stage: str) -> dict[str, Any]:
        """The values that a stage was begun with and that are no inputs; empty where it was never begun."""
        return dict(self._stages.get(stage, {}).get("fixed", {}))

    @property
    def has_finished(self) -> bool:
        """Whether any stage is done."""
        return any("files" in record for record in self._stages.values())

    def files(self, stage: str) -> dict[str, str]:
        """What a stage that is done made: digests by path in the folder."""
        return dict(self._stages.get(stage, {}).get("files", {}))

    def seconds(self, stage: str) -> float:
        """That a stage took, in all commands together."""
        return float(self._stages.get(stage, {}).get("seconds", 0.0))

    def begin(self, stage: str, inputs: dict[str, Any], fixed: dict[str, Any]) -> None:
        self._stages[stage] = {"inputs": _plain(inputs), "fixed": _plain(fixed), "seconds": 0.0}
        self._write()

    def add_seconds(self, stage: str, seconds: float) -> None:
        """Record time that was spent on a stage which is not done yet."""
        self._stages[stage]["seconds"] += round(seconds, 3)
        self._write()

    def forget(self, stage: str) -> None:
        """Remove the record of a stage that left nothing, and with the last one the file.

        Raises:
            HyrfError: the record cannot be written.
        """
        self._stages.pop(stage, None)
        if self._stages:
            self._write()
        else:
            with suppress(OSError):
                self._path.unlink(missing_ok=True)

    def finish(self, stage: str, files: Iterable[str], facts: dict[str, Any], seconds: float) -> None:
        """Args: files: that the stage made, by their paths in the folder."""
        record = self._stages[stage]
        record |= {"files": self._digests(files), "facts": _plain(facts)}
        record["seconds"] += round(seconds, 3)
        self._write()

    def _digests(self, files: Iterable[str]) -> dict[str, str]:
        return {name: digest(self.folder / name) for name in files}

    def _write(self) -> None:
        content = {"version": VERSION, "stages": self._stages}
        write_atomic(self._path, json.dumps(content, indent=1).encode())


def _stages(content: bytes) -> dict[str, dict[str, Any]]:
    """The records of stages in a file's content. Raises ValueError: it is damaged, or of another version."""
    try:
        table = json.loads(content)
        if table["version"] != VERSION:
            raise ValueError("it is of another version of hyrfpack")
        stages = table["stages"]
        for record in stages.values():
            parts = [record["inputs"], *(record.get(name, {}) for name in ("fixed", "files", "facts"))]
            typed = all(isinstance(part, dict) for part in parts) and isinstance(record["seconds"], float)
            if not typed or ("files" in record) != ("facts" in record):
                raise TypeError
        return stages
    except (AttributeError, KeyError, TypeError, RecursionError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError("it is damaged") from error


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(values))


_known: dict[tuple[int, ...], str] = {}  # digests of files that were read before, by what changes with them


def digest(path: Path) -> str:
    """Of a file's content; "" where there is no such file."""
    try:
        status = os.stat(path)
        key = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
        if key not in _known:
            hasher = hashlib.blake2b(digest_size=20)
            with open(path, "rb") as file:
                while chunk := file.read(_CHUNK):
                    hasher.update(chunk)
            _known[key] = hasher.hexdigest()
        return _known[key]
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise HyrfDataError(f"{path}: the file cannot be read ({error.strerror}); check its permissions") from error


def digest_all(files: Iterable[os.PathLike[str] | str], root: Path) -> str:
    """Of files and their names below a folder: the same wherever the folder lies."""
    paths = sorted({os.path.relpath(file, root): Path(file) for file in files}.items())
    with ThreadPoolExecutor() as pool:  # reading and hashing let go of the interpreter
        digests = pool.map(digest, (path for _, path in paths))
        lines = [f"{name}\0{value}\n" for (name, _), value in zip(paths, digests, strict=True)]
    return hashlib.blake2b("".join(lines).encode("utf-8", "surrogateescape"), digest_size=20).hexdigest()
