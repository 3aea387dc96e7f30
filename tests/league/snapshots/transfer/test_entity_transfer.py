"""Policies that encode sets of entities play and learn on in teams of other sizes."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import distribution
from agents.settings import Architecture
from arenas.games.pursuit.swarm import SwarmSettings
from league.commands import cli
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.queries.query import Open
from league.runtime.bootstrap import create, players_of, validate_stage_starts
from league.runtime.checkpoint_compat import validate_start
from league.snapshots import policy_file
from league.snapshots.codec import freeze, thaw
from league.training.learner_factory import new_learner
from storage.blobs import arrays
from storage.records import Checkpoint, Job, Snapshot
from storage.store import Store


def settings(number: int, entities: int = 8) -> Config:
    config = Config(arena=SwarmSettings(pucks=number, rovers=number), league=f"of-{number}")
    architecture = Architecture((16,), entities=entities)
    return replace(config, learner=replace(config.learner, architecture=architecture))


@pytest.fixture(scope="module")
def arena_of():
    return {number: settings(number).arena.build(engine="c", threads=1) for number in (2, 3)}


def made(store: Store, config: Config, arena) -> None:
    """A league with a first policy and a checkpoint of both teams."""
    create(store, config, arena)
    snapshots, checkpoints = [], []
    for player in store.players(config.league):
        learner = new_learner(config, arena, player)
        assert isinstance(learner, HappoLearner)
        frozen = store.blobs.put(freeze([{k: v.numpy() for k, v in each.items()} for each in learner.export()]))
        name, state = player.name, store.blobs.put(arrays.to_bytes(learner.save()))
        snapshots.append(Snapshot(config.league, f"{name}@0", frozen, player.roster, name, initial=True))
        checkpoints.append(Checkpoint(config.league, name, state, 0, 0, 0.0))
    store.queue([Job(config.league, "any", "made")])
    claimed = store.claim(config.league, ["any"], "here", 60)
    assert claimed is not None
    store.finish(claimed[0], checkpoints=checkpoints, snapshots=snapshots)


def ran(*args: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main(list(map(str, args)))
    return ended.value.code or 0


def test_two_rovers_play_among_three(tmp_path, arena_of, capsys):
    with Store.open(tmp_path / "two", create=True) as two, Store.open(tmp_path / "three", create=True) as three:
        made(two, settings(2), arena_of[2])
        made(three, settings(3), arena_of[3])
        file = tmp_path / "rovers.safetensors"
        assert ran("export", "guards@0", "-o", file, "--store", tmp_path / "two") == 0
        assert ran("import", file, "--as", "pair", "--store", tmp_path / "three") == 0
        assert (
            "It learnt as leatherback:31:2+leatherback:31:2: its sets of entities have other" in capsys.readouterr().out
        )
        snapshot = next(s for s in three.snapshots("of-3") if s.name == "pair")
        policies = thaw(three, snapshot, arena_of[3])
        before = thaw(two, next(s for s in two.snapshots("of-2") if s.name == "guards@0"), arena_of[2])
        again = policy_file.export(Open(three, "of-3"), "pair")
        assert [agent["entities"] for agent in again.about["agents"]] == [[[3, 5, 8], [2, 7, 8]]] * 3
    states = jax.jit(jax.vmap(arena_of[3].reset))(jax.random.split(jax.random.key(0), 4))
    seen = np.asarray(states.observations["guards/0"])
    alone = seen[:, [*range(24), *range(29, 36)]]  # without the third puck and the other's third rover
    seen = seen.copy()
    seen[:, 24:29] = seen[:, 36:43] = 0.0
    for i, source in enumerate((0, 1, 0)):  # three take the two policies in turn
        for one, other in zip(distribution(policies[i], seen), distribution(before[source], alone), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-6)


def test_a_policy_without_sets_is_refused_as_before(tmp_path, arena_of, capsys):
    with Store.open(tmp_path / "two", create=True) as two, Store.open(tmp_path / "three", create=True) as three:
        made(two, settings(2, entities=0), arena_of[2])
        made(three, settings(3), arena_of[3])
    file = tmp_path / "rovers.safetensors"
    assert ran("export", "guards@0", "-o", file, "--store", tmp_path / "two") == 0
    assert ran("import", file, "--as", "pair", "--store", tmp_path / "three") == 2
    assert "The policy is for leatherback:31:2+leatherback:31:2, and league 'of-3'" in capsys.readouterr().err


def test_three_against_three_go_on_from_two_against_two(tmp_path, arena_of):
    with Store.open(tmp_path / "store", create=True) as store:
        made(store, settings(2), arena_of[2])
        config = replace(settings(3), after=("of-2",))
        players = players_of(config, arena_of[3])
        validate_start(store, config, arena_of[3], players)
        validate_stage_starts(str(tmp_path / "store"), config, [(config, arena_of[3])])
        flat = replace(settings(3, entities=0), after=("of-2",))
        with pytest.raises(ConfigError, match=r"puck sees 38 numbers and acts with 2 here, and sees 26 .* encode what"):
            validate_stage_starts(str(tmp_path / "store"), flat, [(flat, arena_of[3])])
