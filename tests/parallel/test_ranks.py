"""Which of several processes this one is, where they meet, and what they tell each other."""

from __future__ import annotations

import dataclasses
import os
import socket
from types import SimpleNamespace

import pytest
import ranked_work as work
import torch
import torch.distributed as dist
from hypothesis import given
from hypothesis import strategies as st
from pretend_gpu import pretended_gpu
from ranked import free_port, needs_ranks, together, told_by_torchrun

from hyrfpack import device as devices
from hyrfpack.device import choose_own_device
from hyrfpack.errors import HyrfError
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks, join_processes, ranks_from_environment, rendezvous_address

SRUN = {
    "SLURM_STEP_NUM_TASKS": "7",
    "SLURM_PROCID": "5",
    "SLURM_LOCALID": "1",
    "SLURM_NODEID": "2",
    "SLURM_STEP_TASKS_PER_NODE": "2(x3),1",
    "SLURM_STEP_NODELIST": "gpu[07-09,12],cpu3",
    "SLURM_JOB_ID": "41",
    "SLURM_STEP_ID": "3",
}


# -- who this is -----------------------------------------------------------------------------------------------------


def test_where_nobody_has_started_others_there_is_one_process():
    others = {"LOCAL_RANK": "3", "MASTER_PORT": "x"}
    assert ranks_from_environment({}) == ranks_from_environment(others) == SINGLE_PROCESS == Ranks()
    assert SINGLE_PROCESS.is_single and SINGLE_PROCESS.is_main


def test_torchrun_tells_who_this_is():
    told = {**told_by_torchrun(5, 8, 1), "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "4", "TORCHELASTIC_RESTART_COUNT": "2"}
    assert ranks_from_environment(told) == Ranks(5, 8, 1, 4, 2)
    assert not ranks_from_environment(told).is_main and not ranks_from_environment(told).is_single


def test_rank_and_size_alone_are_those_of_one_machine():
    assert ranks_from_environment({"RANK": "1", "WORLD_SIZE": "3"}) == Ranks(1, 3, 1, 3)


def test_srun_tells_who_this_is():
    assert ranks_from_environment(SRUN) == Ranks(5, 7, 1, 2)
    last = {**SRUN, "SLURM_PROCID": "6", "SLURM_LOCALID": "0", "SLURM_NODEID": "3"}
    assert ranks_from_environment(last) == Ranks(6, 7, 0, 1)
    assert ranks_from_environment({**SRUN, "SLURM_RESTART_COUNT": "1"}).restarts == 1


def test_torchruns_word_goes_before_that_of_slurm():
    assert ranks_from_environment({**SRUN, "RANK": "0", "WORLD_SIZE": "2"}) == Ranks(0, 2, 0, 2)


def test_a_jobs_own_script_is_one_process_however_many_tasks_it_may_have():
    script = {"SLURM_JOB_ID": "41", "SLURM_NTASKS": "8", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
    script |= {"SLURM_TASKS_PER_NODE": "4(x2)", "SLURM_JOB_NODELIST": "gpu[1-2]"}
    assert ranks_from_environment(script) == SINGLE_PROCESS


@given(st.lists(st.integers(1, 6), min_size=1, max_size=8), st.data())
def test_slurms_counts_tell_how_many_are_on_this_machine(tasks, data):
    """Written out, or as SLURM shortens them where machines in a row have as many."""
    words, place = [], 0
    while place < len(tasks):
        most = next((n for n in range(place, len(tasks)) if tasks[n] != tasks[place]), len(tasks)) - place
        times = data.draw(st.integers(1, most))
        words.append(f"{tasks[place]}(x{times})" if times > 1 else str(tasks[place]))
        place += times
    machine = data.draw(st.integers(0, len(tasks) - 1))
    told = {
        "SLURM_STEP_NUM_TASKS": str(sum(tasks)),
        "SLURM_PROCID": str(sum(tasks[:machine])),
        "SLURM_LOCALID": "0",
        "SLURM_NODEID": str(machine),
        "SLURM_STEP_TASKS_PER_NODE": ",".join(words),
    }
    assert ranks_from_environment(told) == Ranks(sum(tasks[:machine]), sum(tasks), 0, tasks[machine])


@pytest.mark.parametrize(
    "told",
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
        {**SRUN, "SLURM_PROCID": "7"},
        {**SRUN, "SLURM_LOCALID": "2"},
        {**SRUN, "SLURM_STEP_NUM_TASKS": "many"},
        {**SRUN, "SLURM_NODEID": "none"},
    ],
    ids=lambda told: "-".join(told.values())[-30:],
)
def test_an_environment_that_makes_no_sense_is_one_sentence(told):
    with pytest.raises(HyrfError, match=r"environment.*unset RANK and WORLD_SIZE") as refusal:
        ranks_from_environment(told)
    assert "\n" not in str(refusal.value)


# -- where they meet -------------------------------------------------------------------------------------------------


def test_torchrun_says_where_to_meet():
    assert rendezvous_address({"MASTER_ADDR": "node1", "MASTER_PORT": "29500"}) == ("node1", 29500)
    assert rendezvous_address({**SRUN, "MASTER_ADDR": "node1", "MASTER_PORT": "29500"}) == ("node1", 29500)


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
def test_processes_of_srun_meet_on_the_first_machine(machines, first):
    assert rendezvous_address({"SLURM_STEP_NODELIST": machines})[0] == first


def test_without_a_word_they_meet_on_this_machine():
    assert rendezvous_address({})[0] == "127.0.0.1"


@given(st.integers(0, 2**32), st.integers(0, 6))
def test_the_port_is_a_jobs_own_and_one_that_anybody_may_open(job, step):
    told = {"SLURM_JOB_ID": str(job), "SLURM_STEP_ID": str(step)}
    port = rendezvous_address(told)[1]
    others = [rendezvous_address({**told, "SLURM_JOB_ID": str(job + more)})[1] for more in (1, 2, 3)]
    others += [rendezvous_address({**told, "SLURM_STEP_ID": str(step + 1)})[1]]
    assert 1024 < port < 2**16 and port not in others and port == rendezvous_address(told)[1]


def test_a_port_that_is_no_number_is_one_sentence():
    with pytest.raises(HyrfError, match="MASTER_PORT is 'http'"):
        rendezvous_address({"MASTER_PORT": "http"})


# -- meeting ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def no_network(monkeypatch) -> None:
    """Whoever wants to meet others fails."""
    monkeypatch.setattr(dist, "init_process_group", lambda *_, **__: pytest.fail("the network was touched"))


@pytest.mark.usefixtures("no_network")
@pytest.mark.parametrize(
    "told",
    [{}, told_by_torchrun(0, 1, 1), {**SRUN, "SLURM_STEP_NUM_TASKS": "1", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}],
)
def test_one_process_meets_nobody(told):
    before = dict(os.environ)
    with join_processes(told) as ranks:
        assert ranks.is_single and ranks.is_main
        values = torch.tensor([1.0, 2.0])
        assert ranks.all_reduce(values) is values and values.tolist() == [1.0, 2.0]
        assert ranks.all_gather("word") == ["word"] and ranks.broadcast("word") == "word"
        assert ranks.run_on_all(lambda: 3) == 3
    assert dict(os.environ) == before


@pytest.mark.usefixtures("no_network")
def test_a_torch_without_gloo_is_one_sentence(monkeypatch):
    monkeypatch.setattr(dist, "is_gloo_available", lambda: False)
    with pytest.raises(HyrfError, match=f"torch {torch.__version__}.* without gloo.*one process".replace("+", r"\+")):
        with join_processes(told_by_torchrun(0, 2, free_port())):
            pass


@needs_ranks
def test_a_port_that_is_taken_is_one_sentence_that_says_what_to_do(monkeypatch):
    monkeypatch.setenv("HYRFPACK_THREADS", "1")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(HyrfError, match=rf"process 0 of 2 .*127.0.0.1:{port}.*set MASTER_PORT to a free one"):
            with join_processes(told_by_torchrun(0, 2, port)):
                pass
    assert not dist.is_initialized()


# -- what they tell each other ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def talked() -> list[dict]:
    """What each of three processes heard."""
    return [end.result for end in together(work.talk, size=3)]


@needs_ranks
def test_each_knows_which_it_is(talked):
    assert [heard["ranks"] for heard in talked] == [Ranks(rank, 3, rank, 3) for rank in range(3)]


@needs_ranks
def test_processes_that_have_met_already_stay_together(talked):
    """A program that calls this as a library has met by itself, and goes on."""
    assert all(heard["again"] == heard["ranks"] and heard["still there"] for heard in talked)


@needs_ranks
def test_all_hear_what_each_says_by_rank(talked):
    for rank, heard in enumerate(talked):
        assert heard["told"] == [{"rank": 0}, {"rank": 1}, {"rank": 2}]
        assert heard["first"] == ("by", 0) and heard["added"] == [3.0, 3.0]
        assert heard["agreed"] == 10 * rank


@needs_ranks
def test_what_one_cannot_do_all_refuse_with_its_sentence(talked):
    assert {heard["refused by the last"] for heard in talked} == {"process 2 of 3: photo 2 is bad"}


@needs_ranks
def test_what_none_can_do_is_told_as_by_one(talked):
    assert [heard["refused by all"] for heard in talked] == [f"photo {rank} is bad" for rank in range(3)]


@needs_ranks
def test_gradients_are_means_and_none_counts_as_zeros(talked):
    for heard in talked:
        assert heard["averaged"] == [[1.0] * 3] * 2 and heard["averaged of idle"] == [0.0, 0.0]
        assert heard["sums"] == [3.0, 3.0]


@needs_ranks
def test_processes_of_one_machine_have_threads_each(talked):
    assert all(int(heard["threads"]) >= 1 for heard in talked)


@needs_ranks
@pytest.mark.parametrize("leaver", [0, 1])
def test_one_that_ends_without_a_word_is_missed_at_once(leaver):
    ends = together(work.leave, leaver, size=3, patience=30)
    refusals = [end.refusal for rank, end in enumerate(ends) if rank != leaver]
    assert all("one of the 3 processes has ended or says nothing any more (" in said for said in refusals)
    assert all("\n" not in said and ".cc:" not in said for said in refusals)


# -- sharing ---------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers()), st.integers(1, 9))
def test_every_item_is_some_ranks_and_shares_are_of_about_a_size(items, size):
    shares = [Ranks(rank, size, rank, size).share(items) for rank in range(size)]
    assert sorted(item for share in shares for item in share) == sorted(items)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert [shares[place % size][place // size] for place in range(len(items))] == items


# -- devices ---------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Pretended(Ranks):
    """One of several ranks, of which the others say what is written here."""

    others: tuple[object, ...] = ()

    def all_gather(self, item):
        return [item, *self.others]

    def raise_if_any(self, problem):
        if problem is not None:
            raise problem


@pytest.fixture
def two_gpus(monkeypatch):
    """Each tensor of the first pretended one says it is on it; the second can be chosen."""
    with pretended_gpu():
        properties = lambda gpu: SimpleNamespace(uuid=f"uuid of {torch.device(gpu).index}", name="a GPU")  # noqa: E731
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
        monkeypatch.setattr(torch.cuda, "get_device_properties", properties)
        monkeypatch.setattr(devices, "has_triton", lambda: True)
        yield


@pytest.mark.usefixtures("two_gpus")
@pytest.mark.parametrize("name", ["auto", "cuda"])
def test_each_process_has_a_gpu_of_its_own(name):
    first, second = (Pretended(rank, 2, rank, 2, others=(f"uuid of {1 - rank}",)) for rank in range(2))
    assert choose_own_device(name, first) == torch.device("cuda:0")
    assert choose_own_device(name, second) == torch.device("cuda:1")


@pytest.mark.usefixtures("two_gpus")
@pytest.mark.parametrize(("name", "rank", "other"), [("cuda:0", 0, "uuid of 0"), ("cuda", 2, "uuid of 0")])
def test_two_processes_on_one_gpu_are_refused(name, rank, other):
    with pytest.raises(HyrfError, match=r"3 processes have 1 GPUs.*each needs its own.*`device='cpu'`"):
        choose_own_device(name, Pretended(rank, 3, rank, 3, others=(other, other)))


def test_processes_share_the_cpu():
    assert choose_own_device("cpu", Pretended(1, 2, 1, 2)) == torch.device("cpu")


@pytest.mark.usefixtures("two_gpus")
def test_one_process_has_the_current_gpu():
    assert choose_own_device("cuda", SINGLE_PROCESS) == torch.device("cuda")
