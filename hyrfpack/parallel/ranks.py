"""Groups of processes that do one piece of work together: the rank of this process and collective operations.

torchrun or SLURM starts the processes, usually one for each GPU, and gives each its rank in the environment. They
communicate through torch.distributed, with gloo for the CPU and NCCL for CUDA. A single process needs no network.
With HYRFPACK_COLLECTIVES=gloo, CUDA tensors are sent by gloo, too, and processes may share a GPU; this is slow, and
tests two processes on a machine with one GPU.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from threading import Thread
from typing import TypeVar, cast

import torch
import torch.distributed as dist
from torch import Tensor

from hyrfpack.errors import HyrfError, short_reason
from hyrfpack.parallel.peer_watch import PeerWatch, connect_to_peers
from hyrfpack.parallel.threads import available_cores

Item = TypeVar("Item")

# A process that sends nothing for this long counts as ended. The time is long because shares of work may be uneven.
# If a process really ends, the others notice immediately, see `hyrfpack.parallel.peer_watch`.
COLLECTIVE_TIMEOUT = timedelta(minutes=30)
COLLECTIVES_VARIABLE = "HYRFPACK_COLLECTIVES"
# The watch over the other processes of the group that this process has joined.
_watch: PeerWatch | None = None
# Each SLURM job uses one of these ports for its rendezvous, unless MASTER_PORT is set. The job number selects the port,
# so that two jobs on one machine do not collide.
SLURM_PORTS = range(20_000, 40_000)


@dataclass(frozen=True)
class Ranks:
    """A group of processes that work together, and the place of this process in it.

    `all_reduce`, `all_gather`, `broadcast`, `run_on_all`, `run_on_main` and `raise_if_any` are collective: all
    processes have to call them in the same order, and each call waits for the slowest process.

    Attributes:
        rank, size: number of this process, from 0, and number of processes.
        local_rank, local_size: the same, counting only the processes on this machine.
        restarts: number of times that the launcher has restarted the group.

    Example:
        >>> with join_processes() as ranks:  # a single process, unless a launcher has started more
        ...     ranks.size, ranks.share(["a", "b", "c"])
        (1, ['a', 'b', 'c'])
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1
    restarts: int = 0

    @property
    def is_single(self) -> bool:
        """Return whether this process is the only one of the group."""
        return self.size == 1

    @property
    def is_main(self) -> bool:
        """Return whether this is the main process, rank 0, which writes files and prints for all."""
        return self.rank == 0

    def share(self, items: Sequence[Item]) -> list[Item]:
        """Return the share of this rank: every `size`-th item, starting with item number `rank`."""
        return list(items[self.rank :: self.size])

    def all_reduce(self, values: Tensor) -> Tensor:
        """Sum a tensor over all ranks, in place, and return it.

        The tensor needs the same shape on all ranks. Afterwards its bits are the same on all of them.

        Raises:
            HyrfError: another process has ended or does not respond.
        """
        if not self.is_single:
            with self._communication_errors():
                dist.all_reduce(values)
        return values

    def all_gather(self, item: Item) -> list[Item]:
        """Return the items of all ranks, in the order of the ranks, on each of them.

        Args:
            item: any object that can be pickled.

        Raises:
            HyrfError: another process has ended or does not respond.
        """
        if self.is_single:
            return [item]
        items = [item] * self.size
        with self._communication_errors():
            dist.all_gather_object(items, item)
        return items

    def broadcast(self, item: Item) -> Item:
        """Return the item of rank 0 on all ranks; the items of other ranks are ignored.

        Args:
            item: any object that can be pickled.

        Raises:
            HyrfError: another process has ended or does not respond.
        """
        if self.is_single:
            return item
        items = [item if self.is_main else None]
        with self._communication_errors():
            dist.broadcast_object_list(items, src=0)
        return cast(Item, items[0])

    def run_on_all(self, work: Callable[[], Item]) -> Item:
        """Run a function on every rank and return this rank's result, if it succeeded on all of them.

        Raises:
            HyrfError: the function raised one on some rank; all ranks raise that of the lowest such rank, of its type.
        """
        if self.is_single:
            return work()
        result, problem = None, None
        try:
            result = work()
        except HyrfError as error:
            problem = error
        self.raise_if_any(problem)
        return cast(Item, result)

    def run_on_main(self, work: Callable[[], Item]) -> Item:
        """Run a function on rank 0 alone, and return its result on all ranks.

        Args:
            work: returns an object that can be pickled.

        Raises:
            HyrfError: the function raised one; all ranks raise it.
        """
        return self.broadcast(cast(Item, self.run_on_all(lambda: work() if self.is_main else None)))

    def raise_if_any(self, problem: HyrfError | None) -> None:
        """Raise an error on all ranks if any of them has one: that of the lowest such rank.

        Args:
            problem: the error of this rank, or None.

        Raises:
            HyrfError: some rank has an error.
        """
        errors = self.all_gather(None if problem is None else (_known_type(problem), problem.problem, problem.fix))
        failed = [(rank, *error) for rank, error in enumerate(errors) if error is not None]
        if problem is not None and len(failed) == self.size:
            raise problem  # If all processes fail, each raises its own error, as a single process would.
        if failed:
            rank, error_type, text, fix = failed[0]
            raise error_type(f"process {rank} of {self.size}: {text}", fix=fix) from problem

    def raise_if_lost(self) -> None:
        """Raise an error if another process has ended. This is not collective.

        Call it after a wait for the GPU: a collective operation there is aborted if a process ends, and gives no usable
        result.

        Raises:
            HyrfError: another process has ended.
        """
        if not self.is_single and _watch is not None and _watch.lost is not None:
            raise self._lost_process_error(f"process {_watch.lost}")

    @contextmanager
    def _communication_errors(self) -> Iterator[None]:
        """Turn an error of torch.distributed in the block into a HyrfError, and a lost process before it, too."""
        self.raise_if_lost()
        try:
            yield
        except RuntimeError as error:  # All errors of torch.distributed have this type.
            if isinstance(error, (torch.OutOfMemoryError, NotImplementedError)):
                raise
            reason = re.sub(r"\[\S*/\S*:\d+\] ", "", short_reason(error, 300))  # without the location in gloo's source
            raise self._lost_process_error(reason) from error

    def _lost_process_error(self, reason: str) -> HyrfError:
        return HyrfError(
            f"one of the {self.size} processes has ended or does not respond ({reason})",
            fix="read the messages of that process, and check whether memory ran out",
        )


def _known_type(error: HyrfError) -> type[HyrfError]:
    """Return the type of an error if hyrfpack defines it, else HyrfError: other types may take other arguments."""
    return type(error) if type(error).__module__ == HyrfError.__module__ else HyrfError


SINGLE_PROCESS = Ranks()


@contextmanager
def join_processes(environment: Mapping[str, str] | None = None) -> Iterator[Ranks]:
    """Connect to the other processes that torchrun or SLURM's srun has started, while the block runs.

    A process that was started without a launcher is a group of its own. The processes on one machine share its cores:
    HYRFPACK_THREADS is set for each process, unless it is set already.

    Args:
        environment: environment variables that describe the group; None for those of this process.

    Raises:
        HyrfError: the environment is contradictory, the processes do not find each other, or torch was built without
            gloo.
    """
    environment = os.environ if environment is None else environment
    ranks = ranks_from_environment(environment)
    if ranks.is_single:
        yield ranks
        return
    if dist.is_initialized():  # The program that uses this library has connected the processes.
        yield ranks
        return
    if not (dist.is_available() and dist.is_gloo_available()):
        raise HyrfError(
            f"torch {torch.__version__} was built without gloo, which processes need to communicate",
            fix="install another build of torch, or start only one process",
        )
    if "TORCHELASTIC_RUN_ID" in environment:
        _stop_when_launcher_ends()
    os.environ.setdefault("HYRFPACK_THREADS", str(max(1, available_cores() // ranks.local_size)))
    address, port = rendezvous_address(environment)
    has_nccl = torch.cuda.is_available() and dist.is_nccl_available() and not uses_gloo_on_gpus(environment)
    devices = "cpu:gloo,cuda:nccl" if has_nccl else "gloo"
    try:
        if "TORCHELASTIC_RUN_ID" in environment:
            # This store belongs to torchrun, and after a restart it still holds the keys of the old processes. So the
            # keys of each start get a prefix.
            tcp_store = dist.TCPStore(address, port, None, False, COLLECTIVE_TIMEOUT)
            store = dist.PrefixStore(f"start {ranks.restarts}", tcp_store)
            dist.init_process_group(
                devices, timeout=COLLECTIVE_TIMEOUT, store=store, rank=ranks.rank, world_size=ranks.size
            )
        else:
            init_method = f"tcp://{address}:{port}"
            dist.init_process_group(
                devices, init_method, timeout=COLLECTIVE_TIMEOUT, rank=ranks.rank, world_size=ranks.size
            )
    except (RuntimeError, ValueError) as error:
        hint = (
            "set MASTER_PORT to a free one" if "EADDRINUSE" in str(error) else "check that all processes were started"
        )
        raise HyrfError(
            f"process {ranks.rank} of {ranks.size} did not find the others at {address}:{port} ({short_reason(error)})",
            fix=hint,
        ) from error
    global _watch
    try:
        _watch = connect_to_peers(ranks.rank, ranks.size, address, ranks.broadcast, _abort_gpu_communication)
        yield ranks
    except BaseException:
        if _watch is not None:
            _watch.close(failed=True)
        _abort_gpu_communication()  # Otherwise NCCL waits for operations that the other processes never join.
        raise
    else:
        _watch.close()
    finally:
        _watch = None
        dist.destroy_process_group()


def uses_gloo_on_gpus(environment: Mapping[str, str] | None = None) -> bool:
    """Return whether the environment asks for gloo in place of NCCL, so that processes may share a GPU.

    Raises:
        HyrfError: the variable has an unknown value.
    """
    name = (os.environ if environment is None else environment).get(COLLECTIVES_VARIABLE, "")
    if name not in ("", "gloo", "nccl"):
        raise HyrfError(f"the environment variable {COLLECTIVES_VARIABLE} is {name!r}", fix="set it to gloo or nccl")
    return name == "gloo"


def _abort_gpu_communication() -> None:
    """Abort the collective operations that are queued on this process's GPU, so that a wait for them ends."""
    with suppress(RuntimeError):  # There is no backend for CUDA, or it has ended already.
        group = dist.group.WORLD if dist.is_initialized() else None
        if group is not None and (backend := group._get_backend(torch.device("cuda"))).name() == "nccl":
            backend.abort()


def _stop_when_launcher_ends() -> None:
    """Send SIGTERM to this process once torchrun's launcher is gone: a killed launcher cannot stop its processes.

    A thread polls for this, because Linux sends its parent-death signal once for each thread of the parent.
    """
    launcher = os.getppid()

    def watch() -> None:
        while os.getppid() == launcher:
            time.sleep(1)
        os.kill(os.getpid(), signal.SIGTERM)

    Thread(target=watch, daemon=True).start()


def ranks_from_environment(environment: Mapping[str, str]) -> Ranks:
    """Return the group that environment variables describe: those of torchrun, or else those of a step of SLURM's srun.

    The batch script of a SLURM job counts as a single process, even if the job has several tasks.

    Raises:
        HyrfError: a variable is missing, or they contradict each other.

    Example:
        >>> ranks_from_environment({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2"})
        Ranks(rank=1, size=2, local_rank=1, local_size=2, restarts=0)
    """
    if "RANK" in environment or "WORLD_SIZE" in environment:
        rank, size = _read_count("RANK", environment), _read_count("WORLD_SIZE", environment)
        local_rank = _read_count("LOCAL_RANK", environment, rank)
        local_size = _read_count("LOCAL_WORLD_SIZE", environment, size)
        restarts = _read_count("TORCHELASTIC_RESTART_COUNT", environment, 0)
    elif "SLURM_STEP_NUM_TASKS" in environment and "SLURM_PROCID" in environment:
        rank, size = _read_count("SLURM_PROCID", environment), _read_count("SLURM_STEP_NUM_TASKS", environment)
        local_rank = _read_count("SLURM_LOCALID", environment, rank)
        local_size = min(size, _tasks_on_this_machine(environment, size))
        restarts = _read_count("SLURM_RESTART_COUNT", environment, 0)
    else:
        return SINGLE_PROCESS
    if not (0 <= rank < size and 0 <= local_rank < local_size <= size):
        raise HyrfError(
            f"the environment describes process {rank} of {size}, number {local_rank} of {local_size} on this "
            "machine, which is impossible",
            fix="start the processes with torchrun or srun, or unset RANK and WORLD_SIZE",
        )
    return Ranks(rank, size, local_rank, local_size, restarts)


def rendezvous_address(environment: Mapping[str, str]) -> tuple[str, int]:
    """Return the address and port at which rank 0 waits for the other processes.

    They are MASTER_ADDR and MASTER_PORT if these are set. Otherwise the address is the first machine of the SLURM
    step, and the port follows from the numbers of the job and the step.

    Example:
        >>> rendezvous_address({"SLURM_STEP_NODELIST": "gpu[07-09]", "SLURM_JOB_ID": "41"})
        ('gpu07', 20328)
    """
    address = environment.get("MASTER_ADDR")
    if address is None:
        # Of "gpu[07-09,12]-ib,cpu3", take the text before the first comma outside brackets, and the first number of
        # each bracket.
        first = re.match(r"(?:[^,\[]|\[[^\]]*\])+", environment.get("SLURM_STEP_NODELIST", "127.0.0.1"))
        address = re.sub(r"\[([^\],-]+)[^\]]*\]", r"\1", first[0]) if first else "127.0.0.1"
    job = _read_count("SLURM_JOB_ID", environment, 0) * 8 + _read_count("SLURM_STEP_ID", environment, 0)
    return address, _read_count("MASTER_PORT", environment, SLURM_PORTS[job % len(SLURM_PORTS)])


def _tasks_on_this_machine(environment: Mapping[str, str], default: int) -> int:
    """Return the number of tasks of a SLURM step on this machine, or `default` if SLURM does not give it.

    SLURM writes "2(x3),1" for two tasks on each of three machines, and one on a fourth.
    """
    counts = [
        int(tasks)
        for tasks, times in re.findall(r"(\d+)(?:\(x(\d+)\))?", environment.get("SLURM_STEP_TASKS_PER_NODE", ""))
        for _ in range(int(times or 1))
    ]
    machine = _read_count("SLURM_NODEID", environment, 0)
    return counts[machine] if machine < len(counts) else default


def _read_count(name: str, environment: Mapping[str, str], default: int | None = None) -> int:
    """Return an environment variable as a whole number, or `default` if it is not set."""
    text = environment.get(name)
    if text is None and default is not None:
        return default
    if text is None or not re.fullmatch("[0-9]{1,15}", text):
        raise HyrfError(
            f"the environment variable {name} is {'missing' if text is None else repr(text)}, where the number of a "
            "process or a port should be",
            fix="start the processes by torchrun or srun, or unset RANK and WORLD_SIZE",
        )
    return int(text)
