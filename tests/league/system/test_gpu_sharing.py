"""Sharing of a GPU by matches and training: the pace of stretches on a simulated clock, and the locks, real ones."""

import os
import random
import threading
import time
from dataclasses import replace

import jax
import numpy as np
import pytest

import arenas
from agents.rollout.rollout import make_play, scripts_for
from league.config import experiment as configuration
from league.config.run_spec import RunSpec
from league.matches.time_slices import TimeSlices
from league.runtime.worker import Worker
from league.runtime.worker_process import WorkerSpec
from league.snapshots.codec import seat
from league.system import gpu_sharing
from league.system.gpu_sharing import SPARE, GpuLock, Pace
from storage.errors import LeaseLost
from storage.records import Job
from tests.league.conftest import ROOT
from tests.league.leagues import filled


class Clock:
    """Time that passes where somebody says so."""

    def __init__(self):
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def stretches(
    pace: Pace, clock: Clock, rng: random.Random, until: float, iteration: float
) -> list[tuple[float, float]]:
    """(begin, seconds) of stretches up to some time, each of which waits for an iteration of training first."""
    played = []
    while clock.now < until:
        pace.wait()
        clock.sleep(rng.uniform(0.0, iteration))
        more = True
        while more:
            took = rng.uniform(0.05, 0.4)
            played.append((clock.now, took))
            clock.sleep(took)
            more = pace.took(took)
    return played


@pytest.mark.parametrize(("share", "iteration"), [(0.1, 0.6), (0.1, 3.0), (0.25, 0.2), (0.02, 0.5)])
def test_matches_keep_to_their_share_over_any_half_minute_and_nearly_use_it(share, iteration):
    clock = Clock()
    pace = Pace(share, lambda: True, clock, clock.sleep)
    played = stretches(pace, clock, random.Random(1), 100.0 + 2000.0, iteration)

    def taken(since: float, until: float) -> float:
        return sum(max(0.0, min(at + took, until) - max(at, since)) for at, took in played)

    for since in np.arange(100.0, 2060.0, 1.5):
        assert taken(since, since + 30.0) <= share * (30.0 + SPARE) + 0.4
    assert abs(pace.recent() - taken(clock.now - 30.0, clock.now) / 30.0) < 1e-6
    assert taken(100.0, 2100.0) >= 0.85 * share * 2000.0


def test_there_is_no_pause_where_nobody_trains_and_it_ends_when_training_does():
    clock, trains = Clock(), True
    pace = Pace(0.1, lambda: trains, clock, clock.sleep)
    pace.wait()
    assert clock.now == 100.0
    assert not pace.took(2.0)
    clock.sleep(gpu_sharing.LOOK)
    trains = False
    pace.wait()
    assert clock.now == 100.0 + gpu_sharing.LOOK
    pace.took(50.0)
    pace.wait()
    assert clock.now == 100.0 + gpu_sharing.LOOK


def test_a_share_of_all_never_pauses_and_one_of_nothing_waits_for_the_end_of_training():
    clock = Clock()
    whole = Pace(1.0, lambda: True, clock, clock.sleep)
    whole.took(50.0)
    whole.wait()
    assert clock.now == 100.0
    Pace(0.0, lambda: clock.now < 160.0, clock, clock.sleep).wait()
    assert 160.0 <= clock.now <= 160.0 + 2 * gpu_sharing.LOOK


def test_a_batch_that_is_another_worker_s_now_is_given_up_in_its_pause():
    def lost() -> bool:
        raise RuntimeError("another worker has it")

    with pytest.raises(RuntimeError, match="another worker"):
        Pace(0.1, lost).wait()


def test_a_stretch_has_the_gpu_alone_and_comes_next_though_training_never_rests(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_sharing, "ITERATION", 1.0)
    training, over, iterations, overlaps, played = threading.Event(), threading.Event(), 0, 0, []

    def train() -> None:
        nonlocal iterations
        turns = GpuLock("0", tmp_path)
        while not over.is_set():
            with turns.training():
                training.set()
                time.sleep(0.002)
                training.clear()
            iterations += 1

    learner = threading.Thread(target=train)
    learner.start()
    turns = GpuLock("0", tmp_path)
    try:
        for _ in range(20):
            before = iterations
            with turns.playing():
                overlaps += training.is_set()
                played.append(iterations - before)
                time.sleep(0.002)
                overlaps += training.is_set()
    finally:
        over.set()
        learner.join()
    assert overlaps == 0
    assert max(played) <= 2  # the iteration that was under way, and one that began while the lock was asked for


def test_iterations_of_two_trainers_go_side_by_side(tmp_path):
    one, other = GpuLock("0", tmp_path), GpuLock("0", tmp_path)
    with one.training():
        began = time.monotonic()
        with other.training():
            assert time.monotonic() - began < gpu_sharing.LONGEST / 2


def test_training_goes_on_where_a_stretch_hangs(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_sharing, "LONGEST", 0.05)
    hanging, learner = GpuLock("0", tmp_path), GpuLock("0", tmp_path)
    with hanging.playing():
        for _ in range(2):
            with learner.training():
                pass
    hanging.close()
    with GpuLock("1", tmp_path).playing(), GpuLock(None).playing(), GpuLock("0", tmp_path / "gone").training():
        pass  # another GPU, none, and a folder that is not there: nothing is waited for


@pytest.mark.slow
@pytest.mark.optimised
def test_a_match_in_stretches_is_the_match_at_once_and_ends_with_its_last_episode():
    arena = arenas.load(f"{ROOT / 'tests' / 'arenas' / 'race.py'}:race", engine="c", worlds=16, threads=1)
    sprinter = list(scripts_for(arena, "puck")).index("sprinter")
    stacks = seat(arena.teams, [[[sprinter]] * 2] * 2)
    keys, recorded = jax.random.split(jax.random.key(3), 16), (0, 5)
    whole = jax.device_get(make_play(arena, recorded)(stacks, keys))
    played = TimeSlices(arena, recorded, Pace(1.0, lambda: True), GpuLock(None), length=7)
    played.compile(stacks, keys)
    compiled = {**played._begin._ready, **played._go_on._ready}
    games, seconds = played.play(stacks, keys)
    assert {**played._begin._ready, **played._go_on._ready} == compiled
    for name in ("score", "void", "at_fault", "decisions", "causes"):
        assert np.array_equal(getattr(whole, name), getattr(games, name)), name
    longest = int(whole.decisions.max())
    assert longest < arena.timing.decisions - 7  # whole stretches are left out
    assert len(games.running) == -(-longest // 7) * 7
    assert np.array_equal(games.running[:longest], whole.running[:longest])
    for k, world in enumerate(recorded):
        end = int(whole.decisions[world])
        assert np.allclose(games.frames.qpos[:end, :, k], whole.frames.qpos[:end, :, k], atol=1e-6)
        assert np.allclose(games.reward[:end, k], whole.reward[:end, k])
    assert seconds > 0.0


def test_a_worker_that_plays_looks_whether_a_turn_of_training_is_open(tmp_path):
    with filled(tmp_path / "store") as store:
        config = replace(configuration.default("sumo-1v1"), league="cup")
        post = WorkerSpec(RunSpec(store.where, None, ""), ("match",), 0, os.getppid())
        player = Worker(store, config, post, threading.Event())
        assert not player._rating.others_are_training()
        store.queue([Job("cup", "match", "a batch")])
        assert not player._rating.others_are_training()
        store.queue([Job("cup", "train", "a turn")])
        assert not player._rating.others_are_training()  # nobody on this machine trains
        store.heartbeat("elsewhere:1:train0", "cup", "train", 1, "elsewhere", {"doing": "training"})
        assert not player._rating.others_are_training()
        store.heartbeat("here:1:train0", "cup", "train", 1, player.host, {"doing": "training"})
        assert player._rating.others_are_training()
        claimed = store.claim("cup", ["train"], "somebody", 60)
        assert claimed is not None
        assert player._rating.others_are_training()
        player.stopping.set()
        assert not player._rating.others_are_training()
        player.lease_lost = True
        with pytest.raises(LeaseLost):
            player._rating.others_are_training()
