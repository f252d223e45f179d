"""Processes that do one piece of work together: which of them this one is, and what they tell each other.

torchrun or SLURM starts them, one a GPU as a rule, and says in the environment of each which it is (its rank); what
they send goes through torch.distributed: gloo for the CPU, NCCL for CUDA. One process alone needs no network.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from threading import Thread
from typing import TypeVar, cast

import torch
import torch.distributed as dist
from torch import Tensor

from hyrfpack.errors import HyrfError, reason_of
from hyrfpack.parallel.pool import cores

Item = TypeVar("Item")

# Until one that says nothing is taken to be gone: shares of work may be uneven. One that has ended is missed at once.
PATIENCE = timedelta(minutes=30)
PORTS = 20_000, 40_000  # that SLURM's jobs meet at, unless MASTER_PORT says where


@dataclass(frozen=True)
class Ranks:
    """The processes that work together, and which of them this is.

    What all of them call, all of them have to call in the same order; each call waits for the slowest.

    Attributes:
        rank, size: this one's number, from 0, and how many there are.
        local_rank, local_size: the same among those on this machine.
        restarts: how often their launcher has started them all anew.

    Example:
        >>> with joined() as ranks:  # one process where nobody has started more
        ...     ranks.size, ranks.share(["a", "b", "c"])
        (1, ['a', 'b', 'c'])
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1
    restarts: int = 0

    @property
    def alone(self) -> bool:
        """Whether there is no other."""
        return self.size == 1

    @property
    def leads(self) -> bool:
        """Whether this is rank 0, which writes files and speaks for all."""
        return self.rank == 0

    def share(self, items: Sequence[Item]) -> list[Item]:
        """Every `size`-th item, beginning with the `rank`-th: each is some rank's."""
        return list(items[self.rank :: self.size])

    def add(self, values: Tensor) -> Tensor:
        """Sum a tensor over all ranks, in place: of the same shape on each, and of the same bits afterwards.

        Raises:
            HyrfError: another process has gone.
        """
        if not self.alone:
            with self._all_there():
                dist.all_reduce(values)
        return values

    def told(self, item: Item) -> list[Item]:
        """What each rank has to say, by rank. Anything that can be pickled. Raises as `add`."""
        if self.alone:
            return [item]
        items = [item] * self.size
        with self._all_there():
            dist.all_gather_object(items, item)
        return items

    def first(self, item: Item) -> Item:
        """What rank 0 has to say; what others give is not looked at. Raises as `add`."""
        if self.alone:
            return item
        items = [item if self.leads else None]
        with self._all_there():
            dist.broadcast_object_list(items, src=0)
        return cast(Item, items[0])

    def agree(self, work: Callable[[], Item]) -> Item:
        """What some work comes to that each rank does for itself. Where one cannot do it, none goes on.

        Raises:
            HyrfError: of the first rank that could not do it, on all of them.
        """
        if self.alone:
            return work()
        result, problem = None, None
        try:
            result = work()
        except HyrfError as error:
            problem = error
        self.refuse(problem)
        return cast(Item, result)

    def refuse(self, problem: HyrfError | None) -> None:
        """Raise the problem of the first rank that has one on all of them."""
        problems = self.told(None if problem is None else str(problem))
        those = [rank for rank, sentence in enumerate(problems) if sentence]
        if problem is not None and len(those) == self.size:
            raise problem  # what all meet is told as by one
        if those:
            raise HyrfError(f"process {those[0]} of {self.size}: {problems[those[0]]}") from problem

    @contextmanager
    def _all_there(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:  # all of torch.distributed's are
            if isinstance(error, (torch.OutOfMemoryError, NotImplementedError)):
                raise
            reason = re.sub(r"\[\S*/\S*:\d+\] ", "", reason_of(error, 300))  # where in gloo's source it is said
            raise HyrfError(
                f"one of the {self.size} processes has ended or says nothing any more ({reason}); see what it said, "
                "and whether memory was short"
            ) from error


ALONE = Ranks()


@contextmanager
def joined(environment: Mapping[str, str] | None = None) -> Iterator[Ranks]:
    """Meet the other processes that torchrun or SLURM's srun has started; without any, there is nothing to do.

    On each machine they share its cores (HYRFPACK_THREADS of each is set, unless it is already).

    Args:
        environment: that tells of them; None for the process's own.

    Raises:
        HyrfError: what it tells makes no sense, they do not find each other, or torch was built without this.
    """
    environment = os.environ if environment is None else environment
    ranks = ranks_told_by(environment)
    if ranks.alone:
        yield ranks
        return
    if dist.is_initialized():  # by whoever calls this as a library
        yield ranks
        return
    if not (dist.is_available() and dist.is_gloo_available()):
        raise HyrfError(
            f"torch {torch.__version__} was built without gloo, by which processes talk; install another build of it, "
            "or start one process"
        )
    if "TORCHELASTIC_RUN_ID" in environment:
        _stop_with_launcher()
    os.environ.setdefault("HYRFPACK_THREADS", str(max(1, cores() // ranks.local_size)))
    address, port = meeting_point(environment)
    devices = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and dist.is_nccl_available() else "gloo"
    try:
        if "TORCHELASTIC_RUN_ID" in environment:
            # torchrun's own store, which remembers what those said that were started before.
            store = dist.PrefixStore(f"start {ranks.restarts}", dist.TCPStore(address, port, None, False, PATIENCE))
            dist.init_process_group(devices, timeout=PATIENCE, store=store, rank=ranks.rank, world_size=ranks.size)
        else:
            where = f"tcp://{address}:{port}"
            dist.init_process_group(devices, where, timeout=PATIENCE, rank=ranks.rank, world_size=ranks.size)
    except (RuntimeError, ValueError) as error:
        hint = "set MASTER_PORT to a free one" if "EADDRINUSE" in str(error) else "see whether all were started"
        raise HyrfError(
            f"process {ranks.rank} of {ranks.size} did not find the others at {address}:{port} ({reason_of(error)}); "
            f"{hint}"
        ) from error
    try:
        yield ranks
    finally:
        dist.destroy_process_group()


def _stop_with_launcher() -> None:
    """Be asked to stop when torchrun's launcher is killed, which then can tell nobody.

    Looked for, because Linux's own signal of a parent's death comes once for each of the parent's threads.
    """
    launcher = os.getppid()

    def watch() -> None:
        while os.getppid() == launcher:
            time.sleep(1)
        os.kill(os.getpid(), signal.SIGTERM)

    Thread(target=watch, daemon=True).start()


def ranks_told_by(environment: Mapping[str, str]) -> Ranks:
    """The processes that an environment tells of: torchrun's words, else those of a step of SLURM's srun.

    A job's own script under SLURM is one process, however many tasks the job may have.

    Raises:
        HyrfError: it tells only half, or what makes no sense.

    Example:
        >>> ranks_told_by({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2"})
        Ranks(rank=1, size=2, local_rank=1, local_size=2, restarts=0)
    """
    if "RANK" in environment or "WORLD_SIZE" in environment:
        rank, size = _count("RANK", environment), _count("WORLD_SIZE", environment)
        local_rank = _count("LOCAL_RANK", environment, rank)
        local_size = _count("LOCAL_WORLD_SIZE", environment, size)
        restarts = _count("TORCHELASTIC_RESTART_COUNT", environment, 0)
    elif "SLURM_STEP_NUM_TASKS" in environment and "SLURM_PROCID" in environment:
        rank, size = _count("SLURM_PROCID", environment), _count("SLURM_STEP_NUM_TASKS", environment)
        local_rank = _count("SLURM_LOCALID", environment, rank)
        local_size = min(size, _tasks_here(environment, size))
        restarts = _count("SLURM_RESTART_COUNT", environment, 0)
    else:
        return ALONE
    if not (0 <= rank < size and 0 <= local_rank < local_size <= size):
        raise HyrfError(
            f"the environment speaks of process {rank} of {size}, number {local_rank} of {local_size} on this machine, "
            "which cannot be; start them by torchrun or srun, or unset RANK and WORLD_SIZE"
        )
    return Ranks(rank, size, local_rank, local_size, restarts)


def meeting_point(environment: Mapping[str, str]) -> tuple[str, int]:
    """Address and port at which rank 0 waits for the others.

    MASTER_ADDR and MASTER_PORT where they are set; else the first machine of SLURM's step, and a port by its job.

    Example:
        >>> meeting_point({"SLURM_STEP_NODELIST": "gpu[07-09]", "SLURM_JOB_ID": "41"})
        ('gpu07', 20328)
    """
    address = environment.get("MASTER_ADDR")
    if address is None:
        # "gpu[07-09,12]-ib,cpu3": up to the first comma outside of brackets, and of each bracket the first number.
        first = re.match(r"(?:[^,\[]|\[[^\]]*\])+", environment.get("SLURM_STEP_NODELIST", "127.0.0.1"))
        address = re.sub(r"\[([^\],-]+)[^\]]*\]", r"\1", first[0]) if first else "127.0.0.1"
    low, high = PORTS
    job = _count("SLURM_JOB_ID", environment, 0) * 8 + _count("SLURM_STEP_ID", environment, 0)
    return address, _count("MASTER_PORT", environment, low + job % (high - low))


def _tasks_here(environment: Mapping[str, str], otherwise: int) -> int:
    """Tasks of a SLURM step on this machine: "2(x3),1" is two on each of three machines, and one on a fourth."""
    counts = [
        int(tasks)
        for tasks, times in re.findall(r"(\d+)(?:\(x(\d+)\))?", environment.get("SLURM_STEP_TASKS_PER_NODE", ""))
        for _ in range(int(times or 1))
    ]
    machine = _count("SLURM_NODEID", environment, 0)
    return counts[machine] if machine < len(counts) else otherwise


def _count(name: str, environment: Mapping[str, str], otherwise: int | None = None) -> int:
    text = environment.get(name)
    if text is None and otherwise is not None:
        return otherwise
    if text is None or not re.fullmatch("[0-9]{1,15}", text):
        raise HyrfError(
            f"the environment variable {name} is {'missing' if text is None else repr(text)}, where the number of a "
            "process or a port should be; start the processes by torchrun or srun, or unset RANK and WORLD_SIZE"
        )
    return int(text)
