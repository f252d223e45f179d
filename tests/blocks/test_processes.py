"""Several processes train blocks side by side."""

from __future__ import annotations

import signal

import rank_tasks as tasks
from rank_processes import needs_ranks, run_on_ranks
from scenes import QUIET_CONTEXT

from hyrfpack.blocks import train_blocks

pytestmark = needs_ranks


def test_two_processes_take_one_block_each_and_write_the_bytes_of_a_single_one(tmp_path):
    single = train_blocks(tasks.block_scene(), tmp_path / "one", tasks.BLOCK_CONFIG, "2x1", context=QUIET_CONTEXT)
    steps = tasks.BLOCK_CONFIG.steps
    ends = run_on_ranks(tasks.train_two_blocks, tmp_path / "two", None)
    assert [end.result for end in ends] == [(True, steps)] * 2, ends
    assert (tmp_path / "two" / "model.hyrf").read_bytes() == single.model.read_bytes()
    first, second = run_on_ranks(tasks.train_two_blocks, tmp_path / "lost", 5)
    assert second.exit_code == -signal.SIGKILL
    assert first.result == (True, 2 * steps - 4), "the block of the lost process resumes from its checkpoint of step 4"
    assert (tmp_path / "lost" / "model.hyrf").read_bytes() == single.model.read_bytes()
