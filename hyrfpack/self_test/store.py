"""Keep the results of self-tests: one for each GPU, driver, and version of torch, Triton and hyrfpack."""

from __future__ import annotations

import hashlib
import json
import logging
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path

import torch

from hyrfpack import ops
from hyrfpack.atomic import write_atomic
from hyrfpack.cache_folder import open_cache_folder
from hyrfpack.errors import HyrfError
from hyrfpack.measure.machine import driver_version, package_versions
from hyrfpack.self_test.run import SelfTest, run_self_test
from hyrfpack.version import __version__

_LOG = logging.getLogger(__name__)


def load_or_run_self_test(device: torch.device) -> SelfTest:
    """Return the stored result for a GPU and these versions; if there is none, run the self-test and store its result.

    A line that the test begins is logged.
    """
    stored = load_self_test(device)
    if stored is not None:
        return stored
    name = torch.cuda.get_device_properties(device).name
    _LOG.info(
        f"testing the kernels on {name}, once for this driver and these versions of torch, Triton and hyrfpack; "
        "compiling them may take a minute"
    )
    test = run_self_test("gpu", device)
    store_self_test(test, device)
    return test


def load_self_test(device: torch.device) -> SelfTest | None:
    """Return the stored result of a self-test of this GPU with these versions, None if there is none."""
    try:
        values = json.loads(_path(device).read_text(encoding="utf-8"))["result"]
        rows = tuple(values["rows"])
        return SelfTest(values["implementation"], values["device"], rows) if all(map(_is_row, rows)) else None
    except (OSError, ValueError, KeyError, TypeError, HyrfError):
        return None  # There is none, or it is damaged.


def _is_row(value: object) -> bool:
    """Return whether a stored value has what each row of a self-test has, and a failed one its reason."""
    return (
        isinstance(value, dict) and {"item", "operation"} <= value.keys() and ("status" not in value or "note" in value)
    )


def store_self_test(test: SelfTest, device: torch.device) -> None:
    """Store a result, unless it is not conclusive or there is no writable folder."""
    if not test.is_conclusive:
        return
    with suppress(HyrfError):
        content = {"key": describe_key(device), "result": asdict(test)}
        write_atomic(_path(device), (json.dumps(content, indent=1) + "\n").encode())


def describe_key(device: torch.device) -> dict[str, object]:
    """Return what a result of the self-test holds for: the GPU, its driver, and versions."""
    return {
        "device": torch.cuda.get_device_properties(device).name,
        "driver": driver_version(),
        "torch": torch.__version__,
        **package_versions("triton"),
        "hyrfpack": __version__,
        "kernels": _kernel_digest(),
    }


def _path(device: torch.device) -> Path:
    digest = hashlib.sha256(json.dumps(describe_key(device)).encode()).hexdigest()[:16]
    return open_cache_folder("self-test") / f"{digest}.json"


@cache
def _kernel_digest() -> str:
    """Return a digest of all operations and their tests, which change between versions while hyrfpack is developed."""
    digest = hashlib.sha256()
    for folder in (Path(ops.__path__[0]), Path(__file__).parent):
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
