"""Starting one command as several processes on this machine, by torchrun's own launcher."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence

from hyrfpack.errors import HyrfError


def launch(command: Sequence[str], processes: int, say: Callable[[str], None] = print) -> int:
    """Run `python -m hyrfpack COMMAND ...` as so many processes that find each other, and wait for them.

    What they print comes through. Where one ends before its time, the others are told to, and killed half a minute
    later if they do not. Signals are passed on to them.

    Args:
        command: words after `hyrfpack`.
        processes: how many, 1 or more.
        say: told which process was killed, where rank 0 has reported its own failure for that.

    Returns:
        The exit code of the first that failed, 0 where none did.

    Raises:
        HyrfError: torch has no launcher here, or rank 0 was killed, which it cannot say itself.
    """
    try:
        from torch.distributed.elastic.multiprocessing.api import SignalException
        from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
        from torch.distributed.launcher.api import LaunchConfig, elastic_launch
    except ImportError as error:
        raise HyrfError(
            f"this build of torch cannot start processes that talk to each other ({error}); leave out `processes`"
        ) from error
    logging.disable()  # its reports of what the processes tell themselves
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
        elastic_launch(config, sys.executable)("-u", "-m", "hyrfpack", *command)
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if failure.exitcode >= 0:
            return failure.exitcode
        killed = (
            f"process {rank} of {processes} was ended by {signal.Signals(-failure.exitcode).name}, perhaps for want of "
            "memory; what was written before is kept"
        )
        if rank == 0:
            raise HyrfError(killed) from error
        say(f"Error: {killed}")
        return 2
    except SignalException:
        return 1
    finally:
        logging.disable(logging.NOTSET)
    return 0
