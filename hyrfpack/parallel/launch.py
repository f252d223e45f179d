"""Start one command as several processes on this machine, with torchrun's launcher."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence

from hyrfpack.errors import HyrfError
from hyrfpack.parallel.child_items import signal_name

_LOG = logging.getLogger(__name__)


def launch(command: Sequence[str], processes: int) -> int:
    """Run `python -m hyrfpack COMMAND ...` as several processes that form one group, and wait until all have ended.

    The output of the processes is passed through. When one process fails, the others are asked to stop and are killed
    half a minute later if they still run. Signals are forwarded to all processes. An error that names a killed process
    is logged, unless rank 0 was killed.

    Args:
        command: the arguments after `hyrfpack`.
        processes: the number of processes, at least 1.

    Returns:
        The exit code of the first process that failed, or 0 if none failed.

    Raises:
        HyrfError: this build of torch has no launcher, or rank 0 was killed, which it cannot report itself.
    """
    try:
        from torch.distributed.elastic.multiprocessing.api import SignalException
        from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
        from torch.distributed.launcher.api import LaunchConfig, elastic_launch
    except ImportError as error:
        raise HyrfError(
            f"this build of torch cannot start processes that talk to each other ({error})",
            fix="leave out `processes`",
        ) from error
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=processes,
        rdzv_backend="c10d",
        rdzv_endpoint="127.0.0.1:0",
        run_id=f"hyrfpack-{os.getpid()}",
        max_restarts=0,
    )
    try:
        logging.disable()  # the launcher would repeat the errors that the processes print themselves
        try:
            elastic_launch(config, sys.executable)("-u", "-m", "hyrfpack", *command)
        finally:
            logging.disable(logging.NOTSET)
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if failure.exitcode >= 0:
            return failure.exitcode
        killed = HyrfError(
            f"process {rank} of {processes} was ended by {signal_name(failure.exitcode)}, perhaps because memory "
            "ran out",
            fix="use fewer `processes` or free some memory (files that were written before are kept)",
        )
        if rank == 0:
            raise killed from error
        _LOG.error(f"Error: {killed}")
        return 2
    except SignalException:
        return 1
    return 0
