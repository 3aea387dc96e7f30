"""Traps in which public leagues were caught. docs/traps.md says which test stands at which."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import distribution, policy_params
from agents.settings import Architecture, HappoConfig
from league.scheduling import match_scheduler
from league.snapshots.codec import freeze, thaw
from league.state.jobs import decode
from storage.records import League, Snapshot
from storage.store import Store
from tests.league.leagues import match
from tests.league.plans import league_state, snapshots, training

ROOT = Path(__file__).parents[3]
NAMED = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


def test_each_trap_of_the_page_has_its_tests():
    rows = [line for line in (ROOT / "docs/traps.md").read_text().splitlines() if line.startswith("| ")][1:]
    assert len(rows) >= 9
    for row in rows:
        named = NAMED.findall(row)
        assert named, row
        for file, name in named:
            assert f"def {name}(" in (ROOT / file).read_text(), f"{file} has no {name}"


def test_a_frozen_policy_carries_what_it_knows_of_observations(tmp_path):
    learner = HappoLearner([3], [2], HappoConfig(Architecture((8,)), normalise_observations=True), 1, "cpu")
    trunk = learner.actors[0].trunk
    trunk.observation_mean.fill_(5.0)
    trunk.observation_var.fill_(4.0)
    trunk.observation_clip.fill_(10.0)
    now = [{key: tensor.numpy().copy() for key, tensor in policy.items()} for policy in learner.export()]
    with Store.open(tmp_path, create=True) as store:
        store.create_league(League("cup", ""))
        frozen = Snapshot("cup", "blue@1", store.blobs.put(freeze(now)), "puck:3:2", "blue")
        trunk.observation_mean.fill_(-5.0)  # it learns on
        (policy,) = thaw(store, frozen, arena=None)  # type: ignore[arg-type]  (asked only for scripts)
    seen = np.array([[4.0, 5.0, 6.0], [9.0, 1.0, 5.0]], np.float32)
    mean, _ = distribution(policy, seen)
    np.testing.assert_array_equal(mean, distribution(policy_params(now[0]), seen)[0])
    blind = {**now[0], "trunk.observation_mean": np.zeros(3, np.float32)}
    assert np.abs(mean - distribution(policy_params(blind), seen)[0]).max() > 1e-3


def test_two_that_meet_again_play_other_games():
    """Else deterministic policies would play one game again and again, and it would count as many."""
    state, seeds, played = league_state(snapshots=snapshots(0, 1)), set(), []
    for _ in range(3):
        (job,) = match_scheduler.next_matches(training(), state).jobs
        seeds.add(decode(job).seed)
        played += [match(*pair, 8, 8) for pair in decode(job).lineups]
        state = replace(state, ladder=state.ladder.extended(played[-4:], [s.name for s in state.snapshots]))
    assert len(seeds) == 3
