"""Ranks that torchrun, srun or a person starts, on loopback and in two network namespaces that stand for two hosts."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from agents.devices.rendezvous import Meeting, Place, RanksError, meet
from league.system.memory import TooLarge
from league.training.data_parallel.rank_watch import RankWatch
from league.training.data_parallel.several_hosts import Ranks
from storage.store import Store
from tests.faults.servers import free_port
from tests.faults.supervisors.hosts import Host, ip, namespaces
from tests.league.conftest import ENVIRONMENT, call, command, ran_once, start, wait_for
from tests.league.training.test_data_parallel import LEAGUE, Seat, children, spoil

ITERATIONS = 60
RUN = (
    "run", "--arena.name", "rock-paper-scissors", "--league", LEAGUE, "--seed", "3", "--training.worlds", "16",
    "--training.rollout_length", "8", "--training.iterations_per_turn", "4", "--training.devices", "2",
    "--training.device", "cpu", "--deterministic", "--workers.match", "0", "--budget.rating_time", "0s",
)  # fmt: skip
SHORT = ("--budget.steps", str(ITERATIONS * 16 * 8))
ENDLESS = ("--budget.steps", str(10**9), "--training.iterations_per_turn", "100000")
WORKER = ("worker", "--ranks", "--wait", "--league", LEAGUE)


def ends(folder: Path) -> dict:
    with Store.open(folder / "league-data") as store:
        return {name: (c.iteration, c.step, c.digest) for name, c in store.newest_checkpoints(LEAGUE).items()}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict:
    """Checkpoints at the end of the league whose ranks its own worker starts."""
    return ends(ran_once(tmp_path_factory, "own-start", *RUN[1:], *SHORT))


@contextmanager
def managed(folder: Path, *budget: str) -> Iterator[subprocess.Popen]:
    """A manager without train workers."""
    manager = start(*RUN, *budget, "--workers", "0", cwd=folder)
    try:
        yield manager
    finally:
        manager.kill()
        manager.wait()


@contextmanager
def ranks(
    folder: Path, *numbers: int, size: int = 2, port: int = 0, address: str = "127.0.0.1",
    prefix: Callable[[int], tuple[str, ...]] = lambda rank: (), more: tuple[str, ...] = (),
) -> Iterator[list[subprocess.Popen]]:  # fmt: skip
    """Ranks with the variables of srun; what each says is in rankN.txt."""
    port, processes = port or free_port(), []
    try:
        for rank in numbers:
            environment = ENVIRONMENT | {
                "SLURM_PROCID": str(rank), "SLURM_NTASKS": str(size), "SLURM_LOCALID": "0", "MASTER_ADDR": address,
                "MASTER_PORT": str(port),
            }  # fmt: skip
            with (folder / f"rank{rank}.txt").open("wb") as out:
                processes.append(
                    subprocess.Popen(
                        [*prefix(rank), *command(*WORKER, *more)], cwd=folder, env=environment, stdout=out, stderr=out
                    )
                )
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def codes(processes: list[subprocess.Popen]) -> list[int]:
    return [process.wait(180) for process in processes]


def said(folder: Path, rank: int) -> str:
    return (folder / f"rank{rank}.txt").read_text()


def torchrun(folder: Path, name: str, *how: str, prefix: tuple[str, ...] = ()) -> subprocess.Popen:
    """One torchrun; what it and its ranks say is in NAME.txt."""
    line = [*prefix, sys.executable, "-m", "torch.distributed.run", *how, "-m", "league", *WORKER]
    with (folder / f"{name}.txt").open("wb") as out:
        return subprocess.Popen(line, cwd=folder, env=ENVIRONMENT, stdout=out, stderr=out)


def learning(folder: Path) -> int:
    """Wait until the ranks learn; return the process of rank 0."""
    found = wait_for(
        folder, lambda store: next((w for w in store.workers(LEAGUE, 5) if w.status.get("iteration")), None)
    )
    assert found is not None
    return found.pid


# The meeting ---------------------------------------------------------------------------------------------------------


def meet_in_threads(*places: Place, limit: float = 20) -> list[Meeting | Exception]:
    """The meeting, or the error, that `meet` gives to each place."""
    found: dict[int, Meeting | Exception] = {}

    def go(number: int, place: Place) -> None:
        try:
            found[number] = meet(place, limit)
        except Exception as error:
            found[number] = error

    threads = [threading.Thread(target=go, args=each, daemon=True) for each in enumerate(places)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    return [found[number] for number in range(len(places))]


def test_ranks_meet_and_are_told_keys():
    port = free_port()
    first, second, third = meet_in_threads(*(Place(rank, 3, "127.0.0.1", port) for rank in range(3)))
    assert isinstance(first, Meeting)
    assert isinstance(second, Meeting)
    assert isinstance(third, Meeting)
    assert first.name == second.name == third.name
    assert second.told("order") is None
    first.tell("order", "go")
    for other in (second, third.again()):
        deadline = time.monotonic() + 30  # a key that was written is there a moment later
        while other.told("order") != "go":
            assert time.monotonic() < deadline


def test_keys_of_ranks_that_have_died_are_not_taken_for_those_of_others():
    """torchrun keeps its table when it starts ranks again."""
    from torch.distributed import TCPStore  # type: ignore[attr-defined]

    table = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    places = [Place(rank, 2, "127.0.0.1", table.port, served=True) for rank in (0, 1)]
    alone = meet_in_threads(places[1], limit=1)
    assert "rank 1 of 2 met no rank 0 at 127.0.0.1" in str(alone[0])
    names = set()
    for _ in range(2):
        first, second = meet_in_threads(*places)
        assert isinstance(first, Meeting)
        assert isinstance(second, Meeting)
        assert first.name == second.name
        names.add(first.name)
    assert len(names) == 2


def test_ranks_that_disagree_about_their_number_are_told_so_and_need_a_person():
    port = free_port()
    for error in meet_in_threads(Place(0, 2, "127.0.0.1", port), Place(1, 3, "127.0.0.1", port)):
        assert str(error) == ("the ranks disagree about their number: it is 2 for rank 0 and 3 for rank 1 (WORLD_SIZE)")
        assert isinstance(error, RanksError)
        assert not error.transient


def test_two_processes_of_one_rank_are_refused():
    port = free_port()
    found = meet_in_threads(Place(0, 3, "127.0.0.1", port), *[Place(1, 3, "127.0.0.1", port)] * 2)
    assert {str(error) for error in found} == {"two processes are rank 1 of 3 (RANK)"}


@pytest.mark.slow
def test_a_rank_whose_signs_of_life_end_is_lost_and_a_wish_to_stop_reaches_rank_0():
    port = free_port()
    first, second = meet_in_threads(*(Place(rank, 2, "127.0.0.1", port) for rank in (0, 1)))
    assert isinstance(first, Meeting)
    assert isinstance(second, Meeting)
    reasons: list[str] = []
    gone, leads, follows = threading.Event(), threading.Event(), threading.Event()

    def lost(reason: str) -> None:
        reasons.append(reason)
        gone.set()

    watches = [
        RankWatch(first, leads, lost, silent=8.0),
        RankWatch(second, follows, reasons.append, silent=8.0),
    ]
    for watch in watches:
        watch.start()
    deadline = time.monotonic() + 60
    while int((first.told("beat/1") or "0").split()[0]) < 4:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert not gone.is_set()
    follows.set()
    assert leads.wait(30)
    watches[1].end()
    assert gone.wait(60)
    watches[0].end()
    assert reasons == ["rank 1 of 2 was silent for 8 s"]


def test_rank_0_raises_what_another_rank_has_left_for_and_can_do_no_more():
    port = free_port()
    first, second = meet_in_threads(*(Place(rank, 2, "127.0.0.1", port) for rank in (0, 1)))
    assert isinstance(first, Meeting)
    assert isinstance(second, Meeting)
    ranks = Ranks(first, Seat(0), threading.Event())
    ranks.order("make")
    second.tell("left/1", json.dumps(["TooLarge", "take 4096 worlds"]))
    with pytest.raises(TooLarge, match="rank 1 of 2 left: take 4096 worlds"):
        ranks.order("turn")
    assert ranks.broken == "rank 1 of 2 left: take 4096 worlds"


# Whole leagues -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_torchrun_trains_what_the_own_start_trains(undisturbed, tmp_path):
    """The same bytes: each rank plays the same games and takes the same steps, whoever has started it."""
    with managed(tmp_path, *SHORT) as manager:
        where = ("--rdzv-endpoint", f"127.0.0.1:{free_port()}", "--local-addr", "127.0.0.1")
        runner = torchrun(tmp_path, "torchrun", "--nproc-per-node", "2", "--rdzv-backend", "c10d", *where)
        try:
            assert runner.wait(240) == 0, (tmp_path / "torchrun.txt").read_text()
        finally:
            runner.kill()
        assert manager.wait(60) == 0
    assert ends(tmp_path) == undisturbed
    assert {each[:2] for each in undisturbed.values()} == {(ITERATIONS, ITERATIONS * 16 * 8)}


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_a_killed_rank_ends_the_turn_which_is_done_again(undisturbed, tmp_path, killed):
    with managed(tmp_path, *SHORT) as manager:
        with ranks(tmp_path, 0, 1) as both:
            learning(tmp_path)
            both[1 - killed].send_signal(signal.SIGSTOP)  # then the other one waits for it within a turn
            time.sleep(1)
            both[killed].kill()
            both[1 - killed].send_signal(signal.SIGCONT)
            assert codes(both)[1 - killed] == 75, said(tmp_path, 1 - killed)
        assert ends(tmp_path) != undisturbed
        with ranks(tmp_path, 0, 1) as both:
            assert codes(both) == [0, 0], said(tmp_path, 0) + said(tmp_path, 1)
        assert manager.wait(60) == 0
    assert ends(tmp_path) == undisturbed


@pytest.mark.slow
def test_what_diverges_is_a_setback_of_its_player_and_the_ranks_go_on(tmp_path):
    with managed(tmp_path, "--budget.steps", "256") as manager, ranks(tmp_path, 0, 1) as both:
        assert codes(both) == [0, 0]
        assert manager.wait(60) == 0
    with Store.open(tmp_path / "league-data") as store:
        spoil(store, "blue")
    with managed(tmp_path, "--budget.steps", str(10**9)) as manager, ranks(tmp_path, 0, 1) as both:
        wait_for(tmp_path, lambda store: any(player.paused for player in store.players(LEAGUE)))
        assert [process.poll() for process in both] == [None, None]
        assert call("stop", "--league", LEAGUE, cwd=tmp_path).returncode == 0
        assert codes(both) == [0, 0], said(tmp_path, 0) + said(tmp_path, 1)
        assert manager.wait(60) == 0


def rank_of(pid: int) -> str | None:
    """Return the rank of a process that torchrun has started."""
    with suppress(OSError):
        found = dict(each.split("=", 1) for each in Path(f"/proc/{pid}/environ").read_text().split("\0") if "=" in each)
        return found.get("RANK")
    return None


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="processes are read from /proc")
def test_torchrun_starts_all_ranks_again_when_one_is_killed(undisturbed, tmp_path):
    with managed(tmp_path, *SHORT) as manager:
        where = ("--master-addr", "127.0.0.1", "--master-port", str(free_port()))
        runner = torchrun(tmp_path, "torchrun", "--nproc-per-node", "2", *where, "--max-restarts", "2")
        try:
            first = learning(tmp_path)
            (second,) = [pid for pid in children(runner.pid) if rank_of(pid) == "1"]
            os.kill(second, signal.SIGSTOP)  # rank 0 goes on until it waits for it, amid a turn
            time.sleep(2)
            assert wait_for(tmp_path, lambda store: [j for j in store.jobs(LEAGUE) if j.state == "leased"])
            os.kill(second, signal.SIGKILL)
            assert runner.wait(240) == 0, (tmp_path / "torchrun.txt").read_text()
            assert not Path(f"/proc/{first}").exists()
        finally:
            runner.kill()
        assert manager.wait(60) == 0
    with Store.open(tmp_path / "league-data") as store:
        assert sum(job.failures for job in store.jobs(LEAGUE)) == 1
    assert ends(tmp_path) == undisturbed


@pytest.mark.slow
@pytest.mark.parametrize("asked", ["league stop", "SIGTERM at rank 1"])
def test_a_stop_ends_all_ranks_after_an_iteration(tmp_path, asked):
    with managed(tmp_path, *ENDLESS, "--no-deterministic") as manager, ranks(tmp_path, 0, 1) as both:
        learning(tmp_path)
        if asked == "league stop":
            assert call("stop", "--league", LEAGUE, cwd=tmp_path).returncode == 0
        else:
            both[1].send_signal(signal.SIGTERM)
        assert codes(both) == [0, 0], said(tmp_path, 0) + said(tmp_path, 1)
        assert "what was under way is finished" in said(tmp_path, 1)
        assert all(each[0] > 0 for each in ends(tmp_path).values())
        manager.terminate()
        assert manager.wait(60) == 0


@pytest.mark.slow
def test_numbers_that_do_not_fit_and_ranks_that_do_not_come_are_told_in_a_line(tmp_path):
    with managed(tmp_path, *SHORT):
        with ranks(tmp_path, 0, size=1) as one:
            assert codes(one) == [2]
        assert f"league: training.devices of league {LEAGUE} is 2, and 1 ranks were started" in said(tmp_path, 0)
        port = free_port()
        with ranks(tmp_path, 0, port=port) as one, ranks(tmp_path, 1, port=port, size=3) as other:
            assert codes([*one, *other]) == [2, 2]
        for rank in (0, 1):
            assert "disagree about their number: it is 2 for rank 0 and 3 for rank 1" in said(tmp_path, rank)
        for rank, absent in ((0, "no rank 1"), (1, "no rank 0")):
            with ranks(tmp_path, rank, more=("--ranks-limit", "3s")) as alone:
                assert codes(alone) == [75]
            greeting, line = said(tmp_path, rank).splitlines()
            assert greeting.startswith(f"Works for league {LEAGUE}")
            assert f"league: rank {rank} of 2 met {absent} at 127.0.0.1" in line


# Two network namespaces ----------------------------------------------------------------------------------------------


@pytest.fixture
def hosts() -> Iterator[tuple[Host, ...]]:
    """Two network namespaces with a line between them."""
    with namespaces() as made:
        if made is None:
            pytest.skip("network namespaces need permission")
        yield made


@pytest.mark.slow
def test_two_hosts_train_what_one_trains(undisturbed, hosts, tmp_path):
    runners = []
    with managed(tmp_path, *SHORT) as manager:
        try:
            for number, host in enumerate(hosts):
                where = ("--master-addr", hosts[0].address, "--master-port", "29500")
                how = ("--nnodes", "2", "--node-rank", str(number), "--nproc-per-node", "1", *where)
                runners.append(torchrun(tmp_path, f"host{number}", *how, prefix=host.prefix))
            assert codes(runners) == [0, 0], (tmp_path / "host0.txt").read_text()
        finally:
            for runner in runners:
                runner.kill()
        assert manager.wait(60) == 0
    assert ends(tmp_path) == undisturbed


@pytest.mark.slow
def test_a_host_that_vanishes_ends_the_turn_on_both(hosts, tmp_path):
    """No connection is closed: it takes as long as a lease until either side knows."""
    with (
        managed(tmp_path, *ENDLESS, "--workers.lease", "10"),
        ranks(tmp_path, 0, 1, address=hosts[0].address, prefix=lambda rank: hosts[rank].prefix) as both,
    ):
        learning(tmp_path)
        assert ip("-n", hosts[1].namespace, "link", "set", hosts[1].interface, "down")
        assert codes(both) == [75, 75], said(tmp_path, 0) + said(tmp_path, 1)
        assert "rank 1 of 2 was silent for 10 s" in said(tmp_path, 0)
        with Store.open(tmp_path / "league-data") as store:
            (job,) = [job for job in store.jobs(LEAGUE) if job.state != "done"]
            assert (job.state, job.failures) == ("queued", 1)
