"""Choose a torch device, and upload photos to it."""

from __future__ import annotations

import logging
import re
from collections.abc import Hashable
from functools import cache
from itertools import chain

import numpy as np
import torch
from torch import Tensor

from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError
from hyrfpack.kernel_errors import PLAIN_TORCH_VARIABLE
from hyrfpack.ops.dispatch import (
    GPU_OPERATIONS,
    MIXED_PRECISION,
    has_triton,
    is_plain_torch_requested,
    set_replaced_operations,
)
from hyrfpack.parallel.child_items import Row
from hyrfpack.parallel.ranks import Ranks, uses_gloo_on_gpus
from hyrfpack.scene import Picture
from hyrfpack.self_test import SelfTest, is_temporary, load_or_run_self_test

_LOG = logging.getLogger(__name__)

NO_TRITON_NOTE = (
    "Triton is not installed, so the GPU runs plain torch, far slower than kernels would be; install the package "
    "'triton' that fits this torch"
)
OLD_GPU_NOTE = (
    "this GPU is of a generation before NVIDIA's Ampere, which the kernels are not made for: they run slowly; "
    "`precision='float32'` and `device='cpu'` are worth a try"
)
_FASTER_CPU = "`device='cpu'` may be faster"
NO_METAL_NOTE = (
    "there are no kernels for Apple's GPU: it runs the plain torch reference, which is slow; `device='cpu'` is faster"
)


def choose_device(name: str | torch.device = "auto", *, self_test: bool = True) -> torch.device:
    """Return the torch device of a name, after checking that it can be used.

    A warning is logged if the named device has no kernels or runs them slowly. On first use of a GPU a self-test of the
    kernels runs there; its result is stored. Operations whose kernels failed it run as plain torch on that GPU, and a
    warning names them. A torch.device was chosen before, and is only checked.

    Args:
        name: "auto", "cpu", "cuda" (torch's current CUDA or ROCm device), "cuda:N" or "mps"; or a torch.device. "auto"
            means a CUDA or ROCm device if one is usable and Triton is installed, otherwise the CPU.
        self_test: False uses all kernels untested, or as the process has set them before.

    Returns:
        The device. "cuda:N" also becomes torch's current device, on which kernels are launched.

    Raises:
        HyrfError: there is no such device, or this process was forked from one that uses the GPU.
    """
    is_named = isinstance(name, str)
    if isinstance(name, torch.device):
        name = str(name) if name.type == "cuda" else name.type
    if not re.fullmatch(r"auto|cpu|mps|cuda(:[0-9]{1,3})?", name):
        raise HyrfError(f"'{name}' is not a device", fix="use auto, cpu, cuda, cuda:N or mps")
    kind, _, number = name.partition(":")
    # Asking torch for GPUs marks later forks as bad, even on a machine without a GPU. So is_available() is checked too.
    if kind in ("auto", "cuda") and torch.cuda._is_in_bad_fork() and torch.cuda.is_available():
        raise HyrfError(
            "this process was forked from one that uses the GPU, and cannot use it too",
            fix="start it with the 'spawn' method of multiprocessing, or use `device='cpu'`",
        )
    if kind == "auto":
        kind = name = "cuda" if torch.cuda.is_available() and has_triton() else "cpu"
    if kind == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if not count:
            raise HyrfError(
                f"device '{name}' is not available: torch sees no NVIDIA or AMD GPU",
                fix="install a GPU build of torch or use `device='cpu'`",
            )
        if int(number or 0) >= count:
            raise HyrfError(
                f"device '{name}' is not available: torch sees {format_count(count, 'GPU')}",
                fix="use `device='cuda:0'`" if count == 1 else f"use a number from 0 to {count - 1}",
            )
        if is_named and not has_triton():
            _LOG.warning(NO_TRITON_NOTE)
        elif is_named and not torch.version.hip and torch.cuda.get_device_capability(name) < (8, 0):
            _LOG.warning(OLD_GPU_NOTE)
        if is_named and self_test and has_triton():
            set_replaced_operations(_find_failed_operations(_with_index(torch.device(name))))
        make_current(torch.device(name))
    if kind == "mps":
        if not torch.backends.mps.is_available():
            raise HyrfError("device 'mps' is not available: torch sees no Apple GPU", fix="use `device='cpu'`")
        if is_named:
            _LOG.warning(NO_METAL_NOTE)
    return torch.device(name)


def choose_own_device(name: str | torch.device, ranks: Ranks, *, self_test: bool = True) -> torch.device:
    """Choose the device of one of several processes: "auto" and "cuda" give each process on a machine its own GPU.

    Args:
        name: as for `choose_device`.
        ranks: the processes, all of which call this.
        self_test: as for `choose_device`. An operation that failed on one process's GPU runs as plain torch on all.

    Raises:
        HyrfError: `choose_device` fails on one process, or two would share a GPU; it is raised on all processes.
    """
    device = ranks.run_on_all(lambda: choose_device(name, self_test=self_test and ranks.is_single))
    if device.type == "cuda" and not ranks.is_single:
        if device.index is None:
            device = choose_device(torch.device("cuda", ranks.local_rank % torch.cuda.device_count()))
        gpus = ranks.all_gather(str(torch.cuda.get_device_properties(device).uuid))
        if len(set(gpus)) < len(gpus) and not uses_gloo_on_gpus():
            raise HyrfError(
                f"{ranks.size} processes have {len(set(gpus))} GPUs between them, and each needs its own",
                fix="start one process for each GPU with `device='cuda'`, or use `device='cpu'`",
            )
        if isinstance(name, str) and self_test and has_triton():
            _agree_on_failed_operations(device, ranks)
    return device


def _agree_on_failed_operations(device: torch.device, ranks: Ranks) -> None:
    """Test the kernels on the GPUs of all processes; operations that failed on any of them are replaced on all."""
    failed: frozenset[str] = frozenset()
    for is_first in (True, False):  # The first process of a machine stores the result that the others then read.
        if (ranks.local_rank == 0) == is_first:
            failed = ranks.run_on_all(lambda: _find_failed_operations(device))
        else:
            ranks.run_on_all(lambda: None)
    set_replaced_operations(chain(*ranks.all_gather(failed)))


@cache
def _find_failed_operations(device: torch.device) -> frozenset[str]:
    """Return the operations whose kernels do not work on a GPU. A warning names them, once in this process."""
    where = describe_device(device)
    if is_plain_torch_requested():
        _LOG.info(f"{PLAIN_TORCH_VARIABLE} is set: {where} runs plain torch in place of kernels")
        return frozenset(GPU_OPERATIONS)
    test = load_or_run_self_test(device)
    if not test.can_launch:
        _LOG.warning(f"{test.problem}; this run uses plain torch on {where}, far slower; {_FASTER_CPU}")
        return frozenset(GPU_OPERATIONS)
    if test.problem is not None:
        _LOG.warning(f"the kernels could not be tested on {where} ({test.problem}); they are used")
    for sentence in describe_failed_operations(test, where):
        _LOG.warning(sentence)
    return frozenset(test.failed_operations)


def describe_failed_operations(test: SelfTest, where: str) -> list[str]:
    """Return sentences on kernels that do not work, on those that could not be tested now, and on mixed precision.

    Each says why, how much slower plain torch is, and what to do.
    """
    failed = test.failed_operations
    mixed = failed.pop(MIXED_PRECISION, None)
    broken = {operation: row for operation, row in failed.items() if not is_temporary(row)}
    untested = {operation: row for operation, row in failed.items() if is_temporary(row)}
    faster = f"; {_FASTER_CPU}" if "rasterize" in failed else ""
    sentences = []
    if broken:
        sentences.append(
            f"the kernels of {len(broken)} of {len(GPU_OPERATIONS)} operations do not work on {where}, which computes "
            f"them in plain torch instead: {_group_by_reason(broken)}{faster}; please report this, with the output of "
            "'hyrfpack doctor'"
        )
    if untested:
        sentences.append(
            f"the kernels of {len(untested)} of {len(GPU_OPERATIONS)} operations could not be tested on {where}, which "
            f"computes them in plain torch in this run: {_group_by_reason(untested)}{faster}; the next run tests them "
            "again"
        )
    if mixed is not None:
        again = "; the next run tests it again" if is_temporary(mixed) else ""
        sentences.append(
            f"mixed precision does not work on {where} ({mixed['note']}), which uses float32 kernels instead, as with "
            f"`precision='float32'`{again}"
        )
    return sentences


def _group_by_reason(failed: dict[str, Row]) -> str:
    """Return the failed operations, those with the same reason together."""
    groups: dict[str, list[str]] = {}
    for operation, row in failed.items():
        speed = f"; plain torch takes {row['slowdown']} times as long on a small input" if "slowdown" in row else ""
        groups.setdefault(f"{row['note']}{speed}", []).append(operation)
    return ", ".join(f"{', '.join(operations)} ({reason})" for reason, operations in groups.items())


def _with_index(device: torch.device) -> torch.device:
    """Return a GPU with its number; that of the current one if the device has none."""
    return torch.device("cuda", torch.cuda.current_device()) if device.index is None else device


def make_current(device: torch.device) -> None:
    """Make a GPU the current device of this thread, on which its kernels are launched.

    Each thread has a current device of its own.
    """
    if device.type == "cuda" and device.index not in (None, torch.cuda.current_device()):
        torch.cuda.set_device(device)


def describe_device(device: torch.device) -> str:
    """Return the name of a device for users, such as "cpu" or "cuda:0 (NVIDIA H200)"."""
    if device.type != "cuda":
        return device.type
    return f"{_with_index(device)} ({torch.cuda.get_device_properties(device).name})"


def upload_array(array: np.ndarray, device: torch.device) -> Tensor:
    """Copy an array to a device.

    The copy to CUDA does not block, because a blocking copy would also wait for all work that is queued there. It is
    made from pinned memory, because CUDA may wait before it copies more than 64 KiB of other memory.
    """
    tensor = torch.from_numpy(array)
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


def upload(picture: Picture, solid: np.ndarray | None, device: torch.device) -> tuple[Tensor, Tensor | None]:
    """Composite a photo over a solid colour, as `Picture.composite` does, on a device.

    Args:
        picture: the decoded photo.
        solid: (3,) float32 RGB in [0, 1] behind transparent pixels; None for black.
        device: where the result is wanted.

    Returns:
        (H, W, 3) float32 in [0, 1], and the (H, W) bool mask or None.
    """
    if device.type == "cpu":
        mask = None if picture.mask is None else torch.from_numpy(picture.mask)
        return torch.from_numpy(picture.composite(solid)), mask
    return _composite(*_upload_bytes(picture, device), solid)


class Photos:
    """A cache of uploaded photos for a run that uses each of them many times.

    On CUDA the bytes of the first photos stay on the device until they take an eighth of its memory. A run uses each
    photo once per epoch, so keeping the first ones is as good as any other choice. On other devices nothing is cached.

    Attributes:
        device: the device that photos are uploaded to.
        limit_bytes: maximum number of bytes that are kept on the device.
        nbytes: number of bytes that are kept now.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        on_gpu = device.type == "cuda"
        self.limit_bytes = torch.cuda.get_device_properties(device).total_memory // 8 if on_gpu else 0
        self.nbytes = 0
        self._kept: dict[Hashable, tuple[Tensor, Tensor | None, Tensor | None]] = {}

    def get(self, key: Hashable, picture: Picture, solid: np.ndarray | None) -> tuple[Tensor, Tensor | None]:
        """Return what `upload` returns for a photo; the same key must mean the same photo in every call."""
        if self.device.type != "cuda":
            return upload(picture, solid, self.device)
        sent = self._kept.get(key)
        if sent is None:
            sent = _upload_bytes(picture, self.device)
            if self.nbytes + picture.nbytes <= self.limit_bytes:
                self._kept[key] = sent
                self.nbytes += picture.nbytes
        return _composite(*sent, solid)


def _upload_bytes(picture: Picture, device: torch.device) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Upload colours, alpha and mask as bytes, a quarter of the size of floats, to be composited on the device."""
    alpha = None if picture.alpha is None else upload_array(picture.alpha, device)
    mask = None if picture.mask is None else upload_array(picture.mask, device)
    return upload_array(picture.rgb, device), alpha, mask


def _composite(
    colors: Tensor, alphas: Tensor | None, mask: Tensor | None, solid: np.ndarray | None
) -> tuple[Tensor, Tensor | None]:
    """Composite uploaded bytes over a solid colour, as `Picture.composite` does."""
    rgb = colors.float() * (1 / 255)
    if alphas is not None:
        alpha = alphas.float()[..., None] * (1 / 255)
        rgb *= alpha
        if solid is not None:
            rgb += (1 - alpha) * upload_array(solid, rgb.device)
    return rgb, mask
