"""Players that start from one snapshot of another league: which networks they get, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from league.config import experiment as configuration
from league.config.schema import ConfigError
from league.snapshots import policy_file
from league.snapshots.codec import freeze
from league.snapshots.transfer import predecessors, warm_start
from storage.blobs import arrays
from storage.errors import StorageError, UnknownName
from storage.records import Player
from tests.agents.conftest import make_batch
from tests.agents.trios import FULL, new_learner
from tests.league.leagues import filled, player, snapshot

ROSTER = "rover:4:2+rover:4:2+tank:3:1"


@pytest.fixture
def store(tmp_path):
    with filled(tmp_path / "store") as store:
        yield store


def frozen(learner) -> bytes:
    return freeze([{k: v.numpy().copy() for k, v in each.items()} for each in learner.export()])


def test_players_start_from_a_snapshots_networks_and_its_statistics_count_its_steps(store):
    learner = new_learner(FULL, seed=3)
    owner = replace(player("gold", 0), roster=ROSTER)
    store.add_players([owner])
    for iteration in (1, 2):
        learner.learn(make_batch(learner, seed=iteration))
        store.add_snapshots([snapshot(owner, iteration, store.blobs.put(frozen(learner)), step=700 * iteration)])
    fresh = new_learner(FULL, seed=9)
    mine = Player("next", "mine", 1, "main", ROSTER)
    (found,) = warm_start.of(store, [mine], ["cup/gold@1"]).values()
    assert found.critic is None
    assert warm_start.start(store, fresh, found) == "cup/gold@1"
    given = arrays.from_bytes(store.blobs.get(next(s for s in store.snapshots("cup") if s.name == "gold@1").digest))
    taken = arrays.from_bytes(frozen(fresh))
    assert all(np.array_equal(taken[name], given[name]) for name in given)
    counts = [value for name, value in fresh.save().items() if name.startswith("actor") and name.endswith(".observed")]
    assert all((count == 700).all() for count in counts)


def test_a_first_snapshot_with_statistics_acts_as_before_after_the_next_batch_of_another_game(store):
    learner = new_learner(FULL, seed=3)
    owner = replace(player("gold", 0), roster=ROSTER)
    store.add_players([owner])
    learner.learn(make_batch(learner, seed=1))
    store.add_snapshots([snapshot(owner, 0, store.blobs.put(frozen(learner)), step=0)])
    fresh = new_learner(replace(FULL, lr=1e-12), seed=9)
    (found,) = warm_start.of(store, [Player("next", "mine", 1, "main", ROSTER)], ["cup/gold@0"]).values()
    warm_start.start(store, fresh, found)
    seen = torch.linspace(-1.0, 1.0, 8)[:, None].expand(8, 4)
    before, statistics = fresh.actors[0](seen).mean.clone(), fresh.actors[0].trunk.observation_mean.clone()
    fresh.learn(make_batch(fresh, seed=2))
    assert not torch.allclose(fresh.actors[0].trunk.observation_mean, statistics)
    torch.testing.assert_close(fresh.actors[0](seen).mean, before, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "error", "says"),
    [
        ("cup/gold@9", UnknownName, "gold@9"),
        ("cap/blue@1", UnknownName, "cap/blue@1"),
        ("cup/pusher", StorageError, "cup/pusher is a script"),
    ],
)
def test_a_snapshot_without_networks_is_refused(store, name, error, says):
    with pytest.raises(error, match=says):
        predecessors.forerunners(store, [name])


@pytest.mark.parametrize("name", ["main/", "/blue@4", "a b/blue@4", "main/blue@4/x"])
def test_what_names_no_snapshot_is_no_forerunner(name):
    with pytest.raises(ConfigError, match="after"):
        configuration.loads(f'after = ["{name}"]')


def test_players_start_from_a_file_as_from_the_policy_that_comes_with_the_league(store, tmp_path):
    shipped = policy_file.find("leatherback-push")
    file = tmp_path / "my" / "pusher.safetensors"
    file.parent.mkdir()
    file.write_bytes(shipped.read_bytes())
    mine = Player("next", "mine", 1, "main", policy_file.read(shipped).about["roster"])
    (found,) = warm_start.of(store, [mine], [str(file)]).values()
    (source,) = found.actors
    assert source is not None
    assert found.critic is None
    name, state = predecessors.state_of(store, source.league, source.player)
    _, same = predecessors.state_of(None, "leatherback-push", source.player)
    assert name == f"pusher/{policy_file.read(shipped).about['name']}"
    assert state.keys() == same.keys()
    assert all(np.array_equal(state[key], same[key]) for key in same)


def test_a_file_that_is_no_policy_is_refused(store, tmp_path):
    (tmp_path / "text.safetensors").write_text("no arrays")
    with pytest.raises(policy_file.ExchangeError, match=r"text\.safetensors is no policy that `league export` wrote"):
        predecessors.forerunners(store, [str(tmp_path / "text.safetensors")])
    with pytest.raises(StorageError, match=r"there\.safetensors"):
        predecessors.forerunners(store, [str(tmp_path / "not" / "there.safetensors")])
