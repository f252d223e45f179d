"""Record of a work folder: the inputs of each stage and the files that it wrote."""

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
from hyrfpack.format.run_folder import WORK_RECORD_FILE
from hyrfpack.parallel.threads import thread_count

RECORD_VERSION = 1
_READ_CHUNK_BYTES = 1 << 20


class WorkFolderState:
    """The record of a work folder, `make.json`, which is written as a whole after every change.

    The record of a stage has these parts:

        inputs     plain values on which the product of the stage depends
        fixed      plain values that later calls take over from the call that began the stage
        files      digests of the files that the stage wrote, by path relative to the folder
        facts      plain values for the report
        seconds    time that the stage has taken

    A stage that was begun and is not finished has neither `files` nor `facts`.

    Attributes:
        folder: the work folder.
    """

    def __init__(self, folder: Path) -> None:
        """Read the record, if any. Raises HyrfError: the folder holds something else, or the record is unreadable."""
        self.folder = folder
        self._path = folder / WORK_RECORD_FILE
        self._stage_records: dict[str, dict[str, Any]] = {}
        try:
            entries = os.listdir(folder) if folder.is_dir() else []
            if WORK_RECORD_FILE in entries:
                self._stage_records = _parse_stage_records(self._path.read_bytes())
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise HyrfError(
                f"{self._path}: the record of finished stages cannot be read ({reason})",
                fix="choose another folder with `work`, or delete this one to start again",
            ) from error
        if entries and WORK_RECORD_FILE not in entries and not all(name.startswith(".") for name in entries):
            raise HyrfError(
                f"{folder}: this folder holds other files and is not a work folder",
                fix="choose another folder with `work`",
            )

    def was_begun(self, stage: str, inputs: dict[str, Any]) -> bool:
        """Return whether a stage was begun with these inputs and is not finished."""
        record = self._stage_records.get(stage)
        return record is not None and "files" not in record and record["inputs"] == _to_json_values(inputs)

    def is_under_way(self, stage: str, inputs: dict[str, Any]) -> bool:
        """Return whether a stage was begun with these inputs, or is finished and its files are unchanged."""
        return self.was_begun(stage, inputs) or self.facts(stage, inputs) is not None

    def changed_inputs(self, stage: str, inputs: dict[str, Any]) -> list[str]:
        """Return the names of the changed inputs of a stage, or "its files"; an empty list if it was never begun."""
        if stage not in self._stage_records:
            return []
        before, now = self._stage_records[stage]["inputs"], _to_json_values(inputs)
        return sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name)) or ["its files"]

    def facts(self, stage: str, inputs: dict[str, Any]) -> dict[str, Any] | None:
        """Return the facts of a stage that is finished with these inputs and whose files are unchanged, or None."""
        record = self._stage_records.get(stage, {})
        if "files" not in record or record["inputs"] != _to_json_values(inputs):
            return None
        return record["facts"] if self._digest_files(record["files"]) == record["files"] else None

    def has_lost_files(self, stage: str, inputs: dict[str, Any]) -> bool:
        """Return whether a stage is finished with these inputs, but its files are missing or changed."""
        record = self._stage_records.get(stage, {})
        is_finished = "files" in record and record["inputs"] == _to_json_values(inputs)
        return is_finished and self.facts(stage, inputs) is None

    def inputs(self, stage: str) -> dict[str, Any]:
        """Return the inputs with which a stage was begun."""
        return dict(self._stage_records[stage]["inputs"])

    def fixed(self, stage: str) -> dict[str, Any]:
        """Return the fixed values with which a stage was begun; empty if it was never begun."""
        return dict(self._stage_records.get(stage, {}).get("fixed", {}))

    @property
    def has_finished(self) -> bool:
        """Return whether any stage is finished."""
        return any("files" in record for record in self._stage_records.values())

    def files(self, stage: str) -> dict[str, str]:
        """Return the digests of the files of a finished stage, by path relative to the folder."""
        return dict(self._stage_records.get(stage, {}).get("files", {}))

    def seconds(self, stage: str) -> float:
        """Return the time in seconds that a stage has taken in all calls together."""
        return float(self._stage_records.get(stage, {}).get("seconds", 0.0))

    def begin(self, stage: str, inputs: dict[str, Any], fixed: dict[str, Any]) -> None:
        """Record that a stage begins with these inputs and fixed values; its earlier record is dropped."""
        self._stage_records[stage] = {
            "inputs": _to_json_values(inputs),
            "fixed": _to_json_values(fixed),
            "seconds": 0.0,
        }
        self._write_record()

    def add_seconds(self, stage: str, seconds: float) -> None:
        """Record time that was spent on a stage that is not finished yet."""
        self._stage_records[stage]["seconds"] += round(seconds, 3)
        self._write_record()

    def forget(self, stage: str) -> None:
        """Remove the record of a stage that wrote nothing; with the last stage, remove the record's file.

        Raises:
            HyrfError: the record cannot be written.
        """
        self._stage_records.pop(stage, None)
        if self._stage_records:
            self._write_record()
        else:
            with suppress(OSError):
                self._path.unlink(missing_ok=True)

    def finish(self, stage: str, files: Iterable[str], facts: dict[str, Any], seconds: float) -> None:
        """Record that a stage is finished; `files` are paths relative to the folder."""
        record = self._stage_records[stage]
        record |= {"files": self._digest_files(files), "facts": _to_json_values(facts)}
        record["seconds"] += round(seconds, 3)
        self._write_record()

    def _digest_files(self, files: Iterable[str]) -> dict[str, str]:
        return {name: file_digest(self.folder / name) for name in files}

    def _write_record(self) -> None:
        content = {"version": RECORD_VERSION, "stages": self._stage_records}
        write_atomic(self._path, json.dumps(content, indent=1).encode())


def _parse_stage_records(content: bytes) -> dict[str, dict[str, Any]]:
    """Parse the records of all stages. Raises ValueError: the content is damaged or of another version."""
    try:
        table = json.loads(content)
        if table["version"] != RECORD_VERSION:
            raise ValueError("another version of hyrfpack wrote it")
        stages = table["stages"]
        for record in stages.values():
            parts = [record["inputs"], *(record.get(name, {}) for name in ("fixed", "files", "facts"))]
            has_right_types = all(isinstance(part, dict) for part in parts) and isinstance(record["seconds"], float)
            if not has_right_types or ("files" in record) != ("facts" in record):
                raise TypeError
        return stages
    except (AttributeError, KeyError, TypeError, RecursionError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError("it is damaged") from error


def _to_json_values(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values as they are after a round trip through JSON, so that they compare equal to recorded ones."""
    return json.loads(json.dumps(values))


_digest_cache: dict[tuple[int, ...], str] = {}  # digests by device, inode, size and modification time of a file


def file_digest(path: Path) -> str:
    """Return the digest of a file's content; "" if there is no such file."""
    try:
        status = os.stat(path)
        key = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
        if key not in _digest_cache:
            hasher = hashlib.blake2b(digest_size=20)
            with open(path, "rb") as file:
                while chunk := file.read(_READ_CHUNK_BYTES):
                    hasher.update(chunk)
            _digest_cache[key] = hasher.hexdigest()
        return _digest_cache[key]
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise HyrfDataError(
            f"{path}: the file cannot be read ({error.strerror})",
            fix="check its permissions",
        ) from error


def files_digest(files: Iterable[os.PathLike[str] | str], root: Path) -> str:
    """Return one digest of files and their paths relative to `root`; it does not depend on where `root` lies."""
    paths = sorted({os.path.relpath(file, root): Path(file) for file in files}.items())
    with ThreadPoolExecutor(thread_count()) as pool:  # reading and hashing release the interpreter lock
        digests = pool.map(file_digest, (path for _, path in paths))
        lines = [f"{name}\0{value}\n" for (name, _), value in zip(paths, digests, strict=True)]
    return hashlib.blake2b("".join(lines).encode("utf-8", "surrogateescape"), digest_size=20).hexdigest()
