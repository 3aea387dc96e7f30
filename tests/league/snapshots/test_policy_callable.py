"""A snapshot as a callable: the mean action of every kind of network, memory, sizes, and what does not fit."""

import numpy as np
import pytest

import arenas
from agents.policy.jax_policy import mean_action
from agents.policy.networks import Actor
from agents.settings import Architecture
from arenas.rosters import AgentSizes, roster_text
from league.config.experiment import Config, dumps
from league.queries.query import Open
from league.snapshots.codec import freeze, thaw
from league.snapshots.policy_callable import policy_callable
from storage.records import ArenaKey, League, Player, Snapshot
from storage.store import Store
from tests.league.snapshots.scrambled import scrambled_arrays
from tests.league.snapshots.test_program_export import KINDS, by_numpy, scrambled


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A league with a snapshot of two agents for every kind of network."""
    roster = roster_text([AgentSizes("listener", 2, 1)] * 2)
    with Store.open(tmp_path_factory.mktemp("callable"), create=True) as store:
        store.create_league(League("cup", ""))
        store.add_players([Player("cup", "blue", 0, "main", roster)])
        for number, kind in enumerate(KINDS.values()):
            digest = store.blobs.put(freeze([scrambled(2 * number, **kind), scrambled(2 * number + 1, **kind)]))
            store.add_snapshots([Snapshot("cup", f"blue@{number}", digest, roster, "blue", iteration=number)])
        yield Open(store, "cup")


@pytest.mark.parametrize("number", range(len(KINDS)), ids=list(KINDS))
def test_its_actions_are_those_of_the_networks_one_agent_after_the_other(number, opened, tmp_path):
    policy, kind = policy_callable(opened, f"blue@{number}"), list(KINDS.values())[number]
    acts, memories = [], []
    for agent in (0, 1):
        (tmp_path / str(agent)).mkdir()
        acts.append(by_numpy(scrambled(2 * number + agent, **kind), tmp_path / str(agent)))
        memories.append(np.zeros((5, kind.get("recurrent", 0)), np.float32))
    seen = np.random.default_rng(number).normal(size=(4, 5, 4)).astype(np.float32)
    for t, rows in enumerate(seen):
        if t == 3:  # an episode begins in the first world
            policy.reset(np.arange(5) == 0)
            for memory in memories:
                memory[0] = 0.0
        actions = policy(rows)
        for agent, act in enumerate(acts):
            own, after = act(rows[:, 2 * agent : 2 * agent + 2], np.zeros((5, 1), np.float32), memories[agent])
            memories[agent] = np.array(after)
            np.testing.assert_allclose(actions[:, [agent]], own, atol=1e-5)


def test_one_world_is_a_row_and_drawn_actions_differ_from_the_mean(opened):
    policy = policy_callable(opened, "blue@0")
    one = policy(np.ones(4))
    assert one.shape == (2,)
    np.testing.assert_allclose(policy(np.ones((3, 4))), np.tile(one, (3, 1)), atol=1e-6)
    drawn = policy(np.ones((2000, 4)), explore=True)
    assert np.ptp(drawn, axis=0).min() > 0.1
    np.testing.assert_allclose(drawn.mean(0), one, atol=0.1)


def test_observations_of_another_size_are_refused(opened):
    with pytest.raises(ValueError, match=r"blue@0 takes observations \(n, 4\) or \(4,\), and got \(2, 3\)"):
        policy_callable(opened, "blue@0")(np.zeros((2, 3)))


@pytest.mark.parametrize("elsewhere", [True, False])
def test_a_policy_acts_as_in_matches_wherever_it_learnt(elsewhere, tmp_path):
    settings = arenas.settings("tests/arenas/race.py:race")
    arena = settings.build(engine="c", threads=1)
    roster = arena.teams[0].roster
    policy = scrambled_arrays(Actor(6, 2, Architecture((7, 6)), 0.8))
    policy["trunk.observation_var"][[1, 4]] = 0.0  # inputs that never moved where it learnt
    learnt = ArenaKey("race", "another" if elsewhere else arena.config_hash, "c")
    with Store.open(tmp_path, create=True) as store:
        store.create_league(League("cup", dumps(Config(arena=settings))))
        store.add_players([Player("cup", "blue", 0, "main", roster)])
        store.add_snapshots([Snapshot("cup", "moved", store.blobs.put(freeze([policy])), roster, arena=learnt)])
        found = policy_callable(Open(store, "cup"), "moved")
        (played,) = thaw(store, store.snapshots("cup")[0], arena)
    seen = np.random.default_rng(0).normal(size=(5, 6)).astype(np.float32)
    np.testing.assert_allclose(found(seen), mean_action(played, seen), atol=1e-5)
    other = seen + np.eye(6, dtype=np.float32)[4]
    assert np.allclose(found(other), found(seen)) == elsewhere
