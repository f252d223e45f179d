"""Rank and world size from the environment, the rendezvous of processes, and their collective operations."""

from __future__ import annotations

import dataclasses
import os
import socket
from types import SimpleNamespace

import pytest
import rank_tasks as tasks
import torch
import torch.distributed as dist
from fake_gpu import use_fake_gpu
from hypothesis import given
from hypothesis import strategies as st
from rank_processes import free_port, needs_ranks, run_on_ranks, torchrun_environment

from hyrfpack import device as devices
from hyrfpack.device import choose_own_device
from hyrfpack.errors import HyrfError
from hyrfpack.parallel import ranks as ranks_module
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks, join_processes, ranks_from_environment, rendezvous_address

SRUN_ENVIRONMENT = {
    "SLURM_STEP_NUM_TASKS": "7",
    "SLURM_PROCID": "5",
    "SLURM_LOCALID": "1",
    "SLURM_NODEID": "2",
    "SLURM_STEP_TASKS_PER_NODE": "2(x3),1",
    "SLURM_STEP_NODELIST": "gpu[07-09,12],cpu3",
    "SLURM_JOB_ID": "41",
    "SLURM_STEP_ID": "3",
}


# -- rank and world size ---------------------------------------------------------------------------------------------


def test_without_a_launcher_there_is_one_process():
    others = {"LOCAL_RANK": "3", "MASTER_PORT": "x"}
    assert ranks_from_environment({}) == ranks_from_environment(others) == SINGLE_PROCESS == Ranks()
    assert SINGLE_PROCESS.is_single and SINGLE_PROCESS.is_main


def test_ranks_are_read_from_the_environment_of_torchrun():
    environment = {
        **torchrun_environment(5, 8, 1),
        "LOCAL_RANK": "1",
        "LOCAL_WORLD_SIZE": "4",
        "TORCHELASTIC_RESTART_COUNT": "2",
    }
    assert ranks_from_environment(environment) == Ranks(5, 8, 1, 4, 2)
    assert not ranks_from_environment(environment).is_main and not ranks_from_environment(environment).is_single


def test_rank_and_size_alone_are_those_of_one_machine():
    assert ranks_from_environment({"RANK": "1", "WORLD_SIZE": "3"}) == Ranks(1, 3, 1, 3)


def test_ranks_are_read_from_the_environment_of_srun():
    assert ranks_from_environment(SRUN_ENVIRONMENT) == Ranks(5, 7, 1, 2)
    last = {**SRUN_ENVIRONMENT, "SLURM_PROCID": "6", "SLURM_LOCALID": "0", "SLURM_NODEID": "3"}
    assert ranks_from_environment(last) == Ranks(6, 7, 0, 1)
    assert ranks_from_environment({**SRUN_ENVIRONMENT, "SLURM_RESTART_COUNT": "1"}).restarts == 1


def test_the_environment_of_torchrun_precedes_that_of_slurm():
    assert ranks_from_environment({**SRUN_ENVIRONMENT, "RANK": "0", "WORLD_SIZE": "2"}) == Ranks(0, 2, 0, 2)


def test_a_slurm_batch_script_is_one_process_whatever_its_number_of_tasks():
    script = {"SLURM_JOB_ID": "41", "SLURM_NTASKS": "8", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
    script |= {"SLURM_TASKS_PER_NODE": "4(x2)", "SLURM_JOB_NODELIST": "gpu[1-2]"}
    assert ranks_from_environment(script) == SINGLE_PROCESS


@given(st.lists(st.integers(1, 6), min_size=1, max_size=8), st.data())
def test_slurm_task_counts_give_the_local_world_size(tasks, data):
    """The counts are written out, or shortened as SLURM does for successive machines with the same count."""
    words, place = [], 0
    while place < len(tasks):
        most = next((n for n in range(place, len(tasks)) if tasks[n] != tasks[place]), len(tasks)) - place
        times = data.draw(st.integers(1, most))
        words.append(f"{tasks[place]}(x{times})" if times > 1 else str(tasks[place]))
        place += times
    machine = data.draw(st.integers(0, len(tasks) - 1))
    environment = {
        "SLURM_STEP_NUM_TASKS": str(sum(tasks)),
        "SLURM_PROCID": str(sum(tasks[:machine])),
        "SLURM_LOCALID": "0",
        "SLURM_NODEID": str(machine),
        "SLURM_STEP_TASKS_PER_NODE": ",".join(words),
    }
    assert ranks_from_environment(environment) == Ranks(sum(tasks[:machine]), sum(tasks), 0, tasks[machine])


@pytest.mark.parametrize(
    "environment",
    [
        {"RANK": "0"},
        {"WORLD_SIZE": "2"},
        {"RANK": "2", "WORLD_SIZE": "2"},
        {"RANK": "-1", "WORLD_SIZE": "2"},
        {"RANK": "0", "WORLD_SIZE": "0"},
        {"RANK": "", "WORLD_SIZE": ""},
        {"RANK": "one", "WORLD_SIZE": "2"},
        {"RANK": "1.0", "WORLD_SIZE": "2"},
        {"RANK": "\u00b2", "WORLD_SIZE": "8"},
        {"RANK": "0", "WORLD_SIZE": "9" * 5000},
        {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "2"},
        {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "3"},
        {"RANK": "0", "WORLD_SIZE": "2", "TORCHELASTIC_RESTART_COUNT": "no"},
        {**SRUN_ENVIRONMENT, "SLURM_PROCID": "7"},
        {**SRUN_ENVIRONMENT, "SLURM_LOCALID": "2"},
        {**SRUN_ENVIRONMENT, "SLURM_STEP_NUM_TASKS": "many"},
        {**SRUN_ENVIRONMENT, "SLURM_NODEID": "none"},
    ],
    ids=lambda environment: "-".join(environment.values())[-30:],
)
def test_an_environment_that_makes_no_sense_is_a_clear_error(environment):
    with pytest.raises(HyrfError, match=r"environment.*unset RANK and WORLD_SIZE") as refusal:
        ranks_from_environment(environment)
    assert "\n" not in str(refusal.value)


# -- the rendezvous address ------------------------------------------------------------------------------------------


def test_the_rendezvous_address_of_torchrun_is_taken():
    assert rendezvous_address({"MASTER_ADDR": "node1", "MASTER_PORT": "29500"}) == ("node1", 29500)
    assert rendezvous_address({**SRUN_ENVIRONMENT, "MASTER_ADDR": "node1", "MASTER_PORT": "29500"}) == ("node1", 29500)


@pytest.mark.parametrize(
    ("machines", "first"),
    [
        ("gpu[07-09,12],cpu3", "gpu07"),
        ("gpu[12,07-09]", "gpu12"),
        ("cpu3,gpu[07-09]", "cpu3"),
        ("gpu-a-[1-2]", "gpu-a-1"),
        ("node1", "node1"),
        ("a.b.example,c", "a.b.example"),
    ],
)
def test_processes_of_srun_rendezvous_on_the_first_machine(machines, first):
    assert rendezvous_address({"SLURM_STEP_NODELIST": machines})[0] == first


def test_the_default_rendezvous_is_on_this_machine():
    assert rendezvous_address({})[0] == "127.0.0.1"


@given(st.integers(0, 2**32), st.integers(0, 6))
def test_each_job_step_has_its_own_unprivileged_port(job, step):
    environment = {"SLURM_JOB_ID": str(job), "SLURM_STEP_ID": str(step)}
    port = rendezvous_address(environment)[1]
    others = [rendezvous_address({**environment, "SLURM_JOB_ID": str(job + more)})[1] for more in (1, 2, 3)]
    others += [rendezvous_address({**environment, "SLURM_STEP_ID": str(step + 1)})[1]]
    assert 1024 < port < 2**16 and port not in others and port == rendezvous_address(environment)[1]


def test_a_port_that_is_no_number_is_a_clear_error():
    with pytest.raises(HyrfError, match="MASTER_PORT is 'http'"):
        rendezvous_address({"MASTER_PORT": "http"})


# -- joining ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def no_network(monkeypatch) -> None:
    """Joining other processes fails the test."""
    monkeypatch.setattr(dist, "init_process_group", lambda *_, **__: pytest.fail("the network was touched"))


@pytest.mark.usefixtures("no_network")
@pytest.mark.parametrize(
    "environment",
    [
        {},
        torchrun_environment(0, 1, 1),
        {**SRUN_ENVIRONMENT, "SLURM_STEP_NUM_TASKS": "1", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"},
    ],
)
def test_a_single_process_opens_no_network_connection(environment):
    before = dict(os.environ)
    with join_processes(environment) as ranks:
        assert ranks.is_single and ranks.is_main
        values = torch.tensor([1.0, 2.0])
        assert ranks.all_reduce(values) is values and values.tolist() == [1.0, 2.0]
        assert ranks.all_gather("word") == ["word"] and ranks.broadcast("word") == "word"
        assert ranks.run_on_all(lambda: 3) == ranks.run_on_main(lambda: 3) == 3
    assert dict(os.environ) == before


@pytest.mark.usefixtures("no_network")
def test_a_torch_without_gloo_is_a_clear_error(monkeypatch):
    monkeypatch.setattr(dist, "is_gloo_available", lambda: False)
    with pytest.raises(HyrfError, match=f"torch {torch.__version__}.* without gloo.*one process".replace("+", r"\+")):
        with join_processes(torchrun_environment(0, 2, free_port())):
            pass


@needs_ranks
def test_a_port_that_is_taken_is_a_clear_error_that_says_what_to_do(monkeypatch):
    monkeypatch.setenv("HYRFPACK_THREADS", "1")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(HyrfError, match=rf"process 0 of 2 .*127.0.0.1:{port}.*set MASTER_PORT to a free one"):
            with join_processes(torchrun_environment(0, 2, port)):
                pass
    assert not dist.is_initialized()


# -- collective operations -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def collective_results() -> list[dict]:
    """The results of the collective operations in each of three processes."""
    return [end.result for end in run_on_ranks(tasks.call_collectives, size=3)]


@needs_ranks
def test_each_process_knows_its_rank(collective_results):
    assert [results["ranks"] for results in collective_results] == [Ranks(rank, 3, rank, 3) for rank in range(3)]


@needs_ranks
def test_processes_that_have_joined_already_stay_joined(collective_results):
    """A program that uses this as a library has joined by itself, and continues after the call."""
    assert all(
        results["joined again"] == results["ranks"] and results["still initialized"] for results in collective_results
    )


@needs_ranks
def test_collectives_return_the_values_of_all_ranks_in_order(collective_results):
    for rank, results in enumerate(collective_results):
        assert results["gathered"] == [{"rank": 0}, {"rank": 1}, {"rank": 2}]
        assert results["broadcast"] == ("by", 0) and results["summed"] == [3.0, 3.0]
        assert results["returned"] == 10 * rank and results["returned by the main process"] == ("rank", 0)


@needs_ranks
def test_an_error_on_one_rank_is_raised_on_all_ranks(collective_results):
    assert {results["error on the last"] for results in collective_results} == {
        "process 2 of 3: photo 2 is bad; replace it"
    }


@needs_ranks
def test_an_error_on_all_ranks_is_raised_as_on_one_process(collective_results):
    assert [results["error on all"] for results in collective_results] == [
        f"photo {rank} is bad; replace it" for rank in range(3)
    ]


@needs_ranks
def test_an_error_of_the_main_process_is_raised_on_all_ranks(collective_results):
    assert {results["error on the main process"] for results in collective_results} == {
        "process 0 of 3: photo 0 is bad; replace it"
    }


@needs_ranks
def test_gradients_are_averaged_and_a_missing_gradient_counts_as_zero(collective_results):
    for results in collective_results:
        assert results["averaged"] == [[1.0] * 3] * 2 and results["averaged of idle"] == [0.0, 0.0]
        assert results["sums"] == [3.0, 3.0]


@needs_ranks
def test_each_process_of_a_machine_has_at_least_one_thread(collective_results):
    assert all(int(results["threads"]) >= 1 for results in collective_results)


@needs_ranks
@pytest.mark.parametrize("leaver", [0, 1])
def test_a_process_that_ends_silently_is_noticed_at_once(leaver):
    ends = run_on_ranks(tasks.exit_one_rank, leaver, size=3, timeout_seconds=30)
    refusals = [end.error_text for rank, end in enumerate(ends) if rank != leaver]
    assert all("one of the 3 processes has ended or does not respond (" in said for said in refusals)
    assert all("\n" not in said and ".cc:" not in said for said in refusals)


@needs_ranks
@pytest.mark.parametrize(("leaver", "how"), [(0, "kill"), (1, "kill"), (2, "error")])
def test_a_process_that_ends_is_noticed_within_seconds_by_those_that_wait_for_a_gpu(leaver, how):
    ends = run_on_ranks(tasks.exit_one_rank_while_others_wait, leaver, how, size=3, timeout_seconds=100)
    assert all(0 <= end.result < 10 for rank, end in enumerate(ends) if rank != leaver)


@needs_ranks
def test_a_process_that_leaves_without_an_error_is_not_lost():
    ends = run_on_ranks(tasks.exit_one_rank_while_others_wait, 1, "leave", size=2, timeout_seconds=60)
    assert [end.result for end in ends] == [-1.0, 0.0]


@needs_ranks
def test_the_next_collective_operation_after_a_loss_names_the_process():
    first, _ = run_on_ranks(tasks.collect_after_a_loss, size=2, timeout_seconds=60)
    assert (
        first.result is not None and "one of the 2 processes has ended or does not respond (process 1)" in first.result
    )
    assert "\n" not in first.result


def test_the_operations_queued_on_a_gpu_are_aborted_by_nccl_alone(monkeypatch):
    aborted = []
    for name in ("nccl", "gloo"):
        backend = SimpleNamespace(name=lambda name=name: name, abort=lambda name=name: aborted.append(name))
        world = SimpleNamespace(_get_backend=lambda device, backend=backend: backend)
        monkeypatch.setattr(ranks_module.dist, "is_initialized", lambda: True)
        monkeypatch.setattr(ranks_module.dist, "group", SimpleNamespace(WORLD=world))
        ranks_module._abort_gpu_communication()
    assert aborted == ["nccl"]


# -- sharing ---------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers()), st.integers(1, 9))
def test_every_item_has_one_rank_and_shares_differ_by_one_item_at_most(items, size):
    shares = [Ranks(rank, size, rank, size).share(items) for rank in range(size)]
    assert sorted(item for share in shares for item in share) == sorted(items)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert [shares[place % size][place // size] for place in range(len(items))] == items


# -- devices ---------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class FakeRank(Ranks):
    """A rank for which `others` stands in for the values of the other ranks."""

    others: tuple[object, ...] = ()

    def all_gather(self, item):
        return [item, *self.others]

    def raise_if_any(self, problem):
        if problem is not None:
            raise problem


@pytest.fixture
def two_gpus(monkeypatch):
    """Two fake GPUs. Tensors claim to be on the first; the second can only be chosen."""
    with use_fake_gpu():
        properties = lambda gpu: SimpleNamespace(uuid=f"uuid of {torch.device(gpu).index}", name="a GPU")  # noqa: E731
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
        monkeypatch.setattr(torch.cuda, "get_device_properties", properties)
        monkeypatch.setattr(devices, "has_triton", lambda: True)
        yield


@pytest.mark.usefixtures("two_gpus")
@pytest.mark.parametrize("name", ["auto", "cuda"])
def test_each_process_has_its_own_gpu(name):
    first, second = (FakeRank(rank, 2, rank, 2, others=(f"uuid of {1 - rank}",)) for rank in range(2))
    assert choose_own_device(name, first, self_test=False) == torch.device("cuda:0")
    assert choose_own_device(name, second, self_test=False) == torch.device("cuda:1")


@pytest.mark.usefixtures("two_gpus")
@pytest.mark.parametrize(("name", "rank", "other"), [("cuda:0", 0, "uuid of 0"), ("cuda", 2, "uuid of 0")])
def test_two_processes_on_one_gpu_are_rejected(name, rank, other):
    with pytest.raises(HyrfError, match=r"3 processes have 1 GPUs.*each needs its own.*`device='cpu'`"):
        choose_own_device(name, FakeRank(rank, 3, rank, 3, others=(other, other)))


@pytest.mark.usefixtures("two_gpus")
def test_two_processes_share_a_gpu_where_gloo_sends_its_tensors(monkeypatch):
    monkeypatch.setenv("HYRFPACK_COLLECTIVES", "gloo")
    rank = FakeRank(2, 3, 2, 3, others=("uuid of 0",) * 2)
    assert choose_own_device("cuda", rank, self_test=False) == torch.device("cuda:0")


def test_unknown_collectives_are_a_clear_error(monkeypatch):
    monkeypatch.setenv("HYRFPACK_COLLECTIVES", "mpi")
    with pytest.raises(HyrfError, match="HYRFPACK_COLLECTIVES is 'mpi'; set it to gloo or nccl"):
        ranks_module.uses_gloo_on_gpus()


def test_processes_share_the_cpu():
    assert choose_own_device("cpu", FakeRank(1, 2, 1, 2)) == torch.device("cpu")


@pytest.mark.usefixtures("two_gpus")
def test_one_process_has_the_current_gpu():
    assert choose_own_device("cuda", SINGLE_PROCESS) == torch.device("cuda")
