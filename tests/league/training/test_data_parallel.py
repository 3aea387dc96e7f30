"""A turn spread over two processes on a CPU: what is learnt, what a kill costs, who ends when."""

import os
import pickle
import signal
import sqlite3
import threading
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from agents.devices.distributed import SINGLE_PROCESS, Communicator
from league.config import experiment as configuration
from league.config.run_spec import RunSpec
from league.runtime.worker import Worker
from league.runtime.worker_process import WorkerSpec
from league.scheduling import turn_scheduler
from league.state.jobs import decode
from league.state.league_state import LeagueState
from league.training.data_parallel import one_host
from league.training.trainer import PlayerDiverged, Trainer
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.blobs import arrays
from storage.errors import Superseded, Unavailable
from storage.records import League, Player
from storage.store import Store
from tests.league.conftest import call, held_amid_a_turn, start, wait_for

LEAGUE = "spread"
DEFAULT = configuration.default("rock-paper-scissors")
CONFIG = replace(
    DEFAULT, league=LEAGUE, deterministic=True, budget=configuration.Budget(steps=7 * 16 * 8),
    training=replace(DEFAULT.training, worlds=16, rollout_length=8, iterations_per_turn=4, devices=2, device="cpu"),
)  # fmt: skip


def new_store(place: Path) -> Store:
    arena = CONFIG.arena.build(engine="auto", worlds=16, threads=1)
    store = Store.open(place, create=True)
    store.create_league(League(LEAGUE, ""))
    store.add_players([Player(LEAGUE, t.name, i, "main", t.roster) for i, t in enumerate(arena.teams)])
    return store


@pytest.fixture
def store(tmp_path):
    with new_store(tmp_path / "store") as store:
        yield store


class Lead:
    """A train worker alone with a store."""

    def __init__(self, store: Store, config: configuration.Config = CONFIG):
        self.store, self.config = store, config
        post = WorkerSpec(RunSpec.of(str(Path(store.where).parent), config), ("train",), 0, os.getppid(), 2)
        self.worker = Worker(store, config, post, threading.Event())

    def __enter__(self) -> "Lead":
        return self

    def __exit__(self, *_: object) -> None:
        self.worker._drop_trainer()

    def turn(self) -> bool:
        """One turn as planned, if there is any to do."""
        planned = turn_scheduler.next_turns(self.config, LeagueState.of(self.store, LEAGUE))
        self.store.queue(planned.jobs, planned.phases)
        claimed = self.store.claim(LEAGUE, ["train"], "me", 60)
        if claimed is not None:
            self.worker._run_job(*claimed)
        return claimed is not None

    def processes(self) -> list:
        return [line.process for line in self.worker._loaded["trainer"]._ranks]


def ends(store: Store) -> dict:
    return {name: (c.iteration, c.step, c.digest) for name, c in store.newest_checkpoints(LEAGUE).items()}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A league that was trained to its end by one worker, and what it ended with."""
    with new_store(tmp_path_factory.mktemp("ranks") / "store") as store:
        with Lead(store) as lead:
            while lead.turn():
                pass
        yield store, ends(store)


@pytest.mark.slow
def test_two_ranks_train_a_league_and_count_what_both_have_learnt_from(undisturbed):
    store, found = undisturbed
    assert {name: each[:2] for name, each in found.items()} == dict.fromkeys(("blue", "red"), (7, 7 * 16 * 8))
    assert {job.state for job in store.jobs(LEAGUE)} == {"done"}
    assert [s.iteration for s in store.snapshots(LEAGUE, "blue")] == [0, 1, 2, 4, 7]
    points = store.curves(LEAGUE, "blue")
    assert [p.iteration for p in points] == list(range(1, 8))
    assert points[-1].values["episodes"] == 16 * 8  # of both ranks: a game is one decision


class Seat(Communicator):
    """A place among two ranks, with nobody in the other."""

    size = 2

    def __init__(self, rank: int):
        self.rank = rank


def test_each_rank_plays_games_of_its_own_in_its_part_of_the_worlds(store):
    arena = CONFIG.arena.build(engine="auto", worlds=8, threads=1)
    planned = turn_scheduler.next_turns(CONFIG, LeagueState.of(store, LEAGUE))
    turn = decode(planned.jobs[0])
    trainers = [Trainer(CONFIG, arena, store.players(LEAGUE), 16, each) for each in (Seat(0), Seat(1), SINGLE_PROCESS)]
    assert [trainer.asked for trainer in trainers] == [8, 8, 16]
    for purpose in ("worlds", "rollout"):
        keys = {tuple(jax.random.key_data(trainer._key(turn, purpose)).tolist()) for trainer in trainers}
        assert len(keys) == 3
    first, second, alone = (trainer.pool.learners["red"].save() for trainer in trainers)
    assert all(np.array_equal(first[k], second[k]) and np.array_equal(first[k], alone[k]) for k in first)


@pytest.mark.slow
def test_a_rank_that_dies_costs_a_try_and_no_byte(undisturbed, store):
    with Lead(store) as lead:
        lead.turn()
        lead.turn()
        one, other = lead.processes()
        os.kill(other.pid, signal.SIGSTOP)  # the first one comes to where it waits for it
        killer = threading.Timer(1.0, other.kill)
        killer.start()
        assert lead.turn()
        (job,) = [job for job in store.jobs(LEAGUE) if job.state != "done"]
        assert (job.state, job.failures) == ("queued", 1)
        assert "rank 1 of 2 died (exit code -9)" in str(job.error)
        assert not one.is_alive()
        while ends(store) != undisturbed[1]:
            if not lead.turn():
                time.sleep(0.5)  # a failed job waits before it is tried again
                assert not store.jobs(LEAGUE, "failed")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ladder", "leapfrog"])
def test_phases_end_and_are_copied_and_critics_of_who_rests_follow_alike_on_all_ranks(store, kind):
    """Ranks that were not alike would have been found out at the end of a turn."""
    schedule, opponents = Schedule(kind, period=2), Opponents("uniform", past=0.6, groups=3)
    config = replace(CONFIG, training=replace(CONFIG.training, schedule=schedule, opponents=opponents))
    with Lead(store, config) as lead:
        while lead.turn():
            pass
    assert {job.state for job in store.jobs(LEAGUE)} == {"done"}
    at = {name: each[:2] for name, each in ends(store).items()}
    # Three groups of two worlds on each rank, 12 worlds in all: it takes 10 iterations to 896 steps.
    wanted = {"ladder": [(10, 960), (10, 960)], "leapfrog": [(6, 576), (4, 384)]}[kind]
    assert at == dict(zip(("blue", "red"), wanted, strict=True))


def spoil(store: Store, player: str) -> None:
    """Make the player's checkpoint one whose weights are finite, and what they give is not."""
    kept = store.checkpoint(LEAGUE, player)
    assert kept is not None
    state = dict(arrays.from_bytes(store.blobs.get(kept.digest)))
    name = next(name for name in state if name.endswith("weight"))
    state[name] = np.full_like(state[name], 3e38)
    bad = store.blobs.put(arrays.to_bytes(state))
    with closing(sqlite3.connect(store.where)) as db, db:
        db.execute("UPDATE checkpoints SET digest = ? WHERE digest = ?", (bad, kept.digest))
        db.execute("UPDATE jobs SET payload = replace(payload, ?, ?)", (kept.digest, bad))  # the next turn's bases


@pytest.mark.slow
def test_what_diverges_is_a_setback_of_its_player_and_the_ranks_end(store):
    with Lead(store) as lead:
        lead.turn()
        spoil(store, "blue")
        before = ends(store)
        lead.turn()
        assert "trainer" not in lead.worker._loaded
    assert ends(store) == before
    assert sum(p.setbacks for p in store.players(LEAGUE)) == 1


@pytest.mark.slow
def test_a_stop_ends_all_ranks_after_the_same_iteration_and_what_they_learnt_is_kept(store):
    config = replace(
        CONFIG,
        deterministic=False,
        budget=configuration.Budget(),
        rating=replace(CONFIG.rating, milestones=()),  # the clock ends no turn, however slow the machine is
        training=replace(CONFIG.training, iterations_per_turn=10**5),
    )
    with Lead(store, config) as lead:
        for _ in range(4):  # to iteration 4; the next turn has four
            lead.turn()
        lead.worker.stopping.set()
        lead.turn()
        at = {each[0] for each in ends(store).values()}
        assert len(at) == 1
        assert 4 < at.pop() < 8
        lead.worker.stopping.clear()
        lead.turn()  # the ranks are there still, and go on
        assert {each[0] for each in ends(store).values()} == {8}
        left = lead.processes()
    assert not any(process.is_alive() for process in left)


def test_the_gpus_of_a_worker_lie_side_by_side():
    def place(worker: int, rank: int) -> int:
        return one_host.RankSpec(RunSpec("", None, ""), worker, rank, size=2, port=0).device

    assert [place(worker, rank) for worker in (0, 1) for rank in (0, 1)] == [0, 1, 2, 3]


@pytest.mark.parametrize(
    "error",
    [Unavailable("the disk is full"), Superseded("blue has gone on"), PlayerDiverged("red", "not finite: entropy")],
)
def test_an_error_is_the_same_in_the_worker(error):
    found = one_host._from_message(*pickle.loads(pickle.dumps(one_host._as_message(error, 1))))
    assert (type(found), str(found), vars(found)) == (type(error), str(error), vars(error))


# Whole leagues -------------------------------------------------------------------------------------------------------

RUN = (
    "run", "--arena.name", "rock-paper-scissors", "--league", "tiny", "--seed", "3", "--training.worlds", "64",
    "--training.devices", "2", "--training.device", "cpu", "--deterministic", "--budget.steps", str(10**9),
    "--workers.match", "0",
)  # fmt: skip


def children(pid: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(stat.parent.name))
        except OSError:
            continue
    return found


@pytest.mark.slow
def test_killed_workers_and_managers_leave_no_rank_behind_and_the_league_goes_on(tmp_path):
    def worker(store):
        return next((w for w in store.workers("tiny", 5) if w.kinds == "train" and w.status.get("iteration")), None)

    def gone(pids):
        return wait_for(tmp_path, lambda store: not any(Path(f"/proc/{pid}").exists() for pid in pids))

    first = start(*RUN, cwd=tmp_path)
    lead = held_amid_a_turn(tmp_path, 1)  # one that is killed between two turns fails none
    left = children(lead.pid)
    assert len(left) >= 2
    os.kill(lead.pid, signal.SIGKILL)
    gone(left)
    again = wait_for(tmp_path, lambda store: (w := worker(store)) and w.pid != lead.pid and w)
    left = [again.pid, *children(again.pid)]
    first.send_signal(signal.SIGKILL)
    first.wait()
    gone(left)
    with Store.open(tmp_path / "league-data") as store:
        reached = store.checkpoint("tiny", "blue").iteration
        assert any(job.failures == 1 for job in store.jobs("tiny"))
    assert call(*RUN, "--budget.steps", str((reached + 2) * 64 * 32), cwd=tmp_path).returncode == 0
    with Store.open(tmp_path / "league-data") as store:
        assert {c.iteration for c in store.newest_checkpoints("tiny").values()} == {reached + 2}
        assert {job.state for job in store.jobs("tiny")} == {"done"}
