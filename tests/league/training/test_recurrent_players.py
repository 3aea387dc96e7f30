"""Players that remember, all the way: turns, checkpoints, snapshots, matches, files."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.batch import Batch
from agents.learner.happo import HappoLearner
from agents.settings import Architecture
from arenas.arena import Arena
from league.config import experiment as configuration
from league.config.build import build
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.scheduling import turn_scheduler
from league.snapshots import policy_file
from league.snapshots.codec import add_scripts, freeze
from league.snapshots.transfer import warm_start
from league.snapshots.transfer.warm_start import Source, WarmStart
from league.state.jobs import RatingMatch, decode
from league.state.league_state import LeagueState
from league.training.trainer import Trainer
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.blobs import arrays
from storage.errors import StorageError
from storage.records import Snapshot
from storage.store import Store
from tests.league.turns import new_store, new_trainer

LEAGUE, UNITS = "memory", 5
GAME = configuration.default("rock-paper-scissors")
RATING = replace(GAME.rating, milestones=())  # the clock ends no turn, however slow the machine is
GAME = replace(GAME, league=LEAGUE, rating=RATING, arena=replace(GAME.arena, rules=replace(GAME.arena.rules, rounds=3)))


def settings(schedule=Schedule(), opponents=Opponents(), architecture=None, **changes) -> Config:  # noqa: B008  (frozen)
    """A league of 12 worlds, whose rollouts of 8 decisions are two chunks and no whole number of episodes."""
    size = {"worlds": 12, "rollout_length": 8, "iterations_per_turn": 4}
    training = replace(GAME.training, schedule=schedule, opponents=opponents, device="cpu", **size)
    architecture = architecture or Architecture((6,), recurrent=UNITS)
    learner = replace(GAME.learner, architecture=architecture, chunk_length=4, minibatches=2)
    config = replace(GAME, training=training, learner=learner, budget=configuration.Budget(steps=10**9))
    return replace(config, **{"deterministic": True, **changes})


@pytest.fixture(scope="module")
def arena() -> Arena:
    return GAME.arena.build()


@pytest.fixture
def store(tmp_path, arena) -> Iterator[Store]:
    with new_store(tmp_path / "store", arena, settings()) as store:
        yield store


def turns(store: Store, config: Config, arena: Arena, count: int, trainer: Trainer | None = None) -> Trainer:
    """Let one process do the next turns as planned; a new one, if none is given."""
    trainer = trainer or new_trainer(config, arena, store)
    for _ in range(count):
        planned = turn_scheduler.next_turns(config, LeagueState.of(store, LEAGUE))
        store.queue(planned.jobs, planned.phases)
        lease, job = store.claim(LEAGUE, ["train"], "me", 60)
        for _ in trainer.turn(store, decode(job), lambda: False):
            pass
        trainer.commit(store, lease, decode(job))
    return trainer


def ends(store: Store) -> dict[str, tuple[int, str]]:
    return {name: (c.iteration, c.digest) for name, c in store.newest_checkpoints(LEAGUE).items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "schedule",
    [Schedule(), Schedule("leapfrog", period=3)],
    ids=["simultaneous", "leapfrog"],
)
def test_killed_after_every_turn_a_league_ends_with_the_same_bytes(schedule, store, arena, tmp_path):
    config = settings(schedule, Opponents("uniform", past=0.5, groups=2))
    turns(store, config, arena, 5)
    with new_store(tmp_path / "other", arena, settings()) as other:
        for _ in range(5):
            turns(other, config, arena, 1)
        assert ends(other) == ends(store)
    state = arrays.from_bytes(store.blobs.get(store.checkpoint(LEAGUE, "blue").digest))
    fresh = new_trainer(config, arena, store, 12).pool.learners["blue"].save()
    for network in ("actor.0", "critic"):
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            assert (state[f"{network}.gru.{name}"] != fresh[f"{network}.gru.{name}"]).any(), name


class CriticObservations:
    """Every batch that critics have learnt from, and what they remembered after it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.by_learner: dict[HappoLearner, list[tuple[Batch, list[torch.Tensor]]]] = {}
        for name in ("learn", "update_critic_only"):
            monkeypatch.setattr(HappoLearner, name, self._noted(getattr(HappoLearner, name)))

    def _noted(self, update):
        def noting(learner: HappoLearner, batch: Batch):
            found = update(learner, batch)
            self.by_learner.setdefault(learner, []).append((batch, [m.clone() for m in learner.final_memories]))
            return found

        return noting


@pytest.mark.slow
def test_critics_go_on_from_what_they_remembered_until_others_sit_down(store, arena, monkeypatch):
    seen = CriticObservations(monkeypatch)
    config = settings(
        opponents=Opponents("uniform", past=0.5, groups=4), deterministic=False, budget=configuration.Budget()
    )
    turns(store, config, arena, 6)  # to iterations 1, 2, 4, 8, 12, in one process whose worlds live on
    begun = {p.iteration: p.values["begun_anew"] for p in store.curves(LEAGUE, "blue")}
    assert any(0 < share < 1 for share in begun.values())
    for batches in seen.by_learner.values():
        assert len(batches) == 12
        went_on = 0
        for number in range(3, 12):  # from iteration 4 on there are as many groups as before
            (batch, _), (_, (before,)) = batches[number], batches[number - 1]
            assert torch.equal(batch.critic_memories[0], before)
            anew = batch.first[0][0]
            if begun[number + 1] > 0:
                assert anew.any()
            went_on += int((~anew).sum())
        assert went_on > 20


def test_a_critic_that_did_not_learn_has_forgotten(store, arena, monkeypatch):
    """It has not seen what happened meanwhile; what it remembered is of an episode that is over."""
    seen = CriticObservations(monkeypatch)
    config = settings(Schedule("leapfrog", period=2), deterministic=False, budget=configuration.Budget())
    config = replace(config, training=replace(config.training, resting_critics=False))
    trainer = turns(store, config, arena, 7)
    blue, red = (seen.by_learner[trainer.pool.learners[name]] for name in ("blue", "red"))
    for batches in (blue, red):
        assert [len(batch.critic_memories) for batch, _ in batches] == [0, 1, 0, 1]
        assert not batches[2][0].first[0][0].all()  # though its worlds went on


@pytest.mark.slow
def test_what_changes_the_width_of_a_crew_leaves_worlds_where_they_are(store, arena):
    """A policy that remembers more sits down beside others, and leaves; the others' worlds go on meanwhile."""
    config = settings(
        opponents=Opponents("uniform", past=0.5, groups=4), deterministic=False, budget=configuration.Budget()
    )
    wide = HappoLearner([1], [3], replace(config.learner, architecture=Architecture((4,), recurrent=9)), seed=5)
    trainer = turns(store, config, arena, 4)
    ((worlds, seats),) = trainer._worlds.values()
    assert worlds.memory["red/0"].shape == (len(worlds.age), UNITS)
    put = store.blobs.put(freeze([{k: v.numpy() for k, v in wide.export()[0].items()}]))
    roster = arena.teams[0].roster  # several, so that one of them is soon drawn
    store.add_snapshots([Snapshot(LEAGUE, f"wide-{i}", put, roster, "red", iteration=3) for i in range(3)])
    there = []
    for _ in range(6):
        turns(store, config, arena, 1, trainer)
        ((worlds, now),) = trainer._worlds.values()
        there.append(any(assigned[1].startswith("wide") for assigned in now))
        assert worlds.memory["red/0"].shape[1] == (9 if there[-1] else UNITS)
        assert worlds.memory["blue/0"].shape[1] == UNITS
        assert [assigned == then for assigned, then in zip(now, seats, strict=True)][:2] == [True, True]
        assert store.curves(LEAGUE, "blue")[-4].values["begun_anew"] < 1
    assert {True, False} == set(there)


# Matches and files ----------------------------------------------------------------------------------------------------


def of_kind(store: Store, arena: Arena, name: str, seed: int, **architecture) -> Snapshot:
    config = settings(architecture=Architecture((6,), **architecture)).learner
    policies = HappoLearner([1], [3], config, seed).export()
    data = freeze([{k: v.numpy() for k, v in policy.items()} for policy in policies])
    return Snapshot(LEAGUE, name, store.blobs.put(data), arena.teams[0].roster, origin="imported")


@pytest.mark.slow
def test_who_remembers_meets_who_does_not_and_scripts(store, arena):
    store.add_snapshots([
        of_kind(store, arena, "wide", 1, recurrent=8), of_kind(store, arena, "small", 2, recurrent=3, layer_norm=True),
        of_kind(store, arena, "plain", 3),
    ])  # fmt: skip
    add_scripts(store, LEAGUE, arena, ["rock"])
    config = replace(settings(), rating=replace(GAME.rating, worlds=64, pairings=4, record=False))
    pairs = (("wide", "small"), ("wide", "plain"), ("rock", "small"), ("plain", "rock"))
    played = MatchEvaluator(config, arena, LEAGUE).play(store, RatingMatch(pairs, 5))
    assert [m.wins + m.draws + m.losses for m in played] == [16] * 4
    for i, pair in enumerate(pairs):  # each as if nobody else had played
        alone = MatchEvaluator(replace(config, rating=replace(config.rating, worlds=64, pairings=4)), arena, LEAGUE)
        again = alone.play(store, RatingMatch((pair,), 5))[i]
        assert (again.wins, again.draws, again.losses, again.pairs) == (
            played[i].wins, played[i].draws, played[i].losses, played[i].pairs
        )  # fmt: skip


def test_a_trained_policy_leaves_as_a_file_and_plays_elsewhere(store, arena, tmp_path):
    turns(store, settings(), arena, 2)
    policy = policy_file.export(Open(store, LEAGUE), "blue@1")
    assert policy.about["agents"][0]["recurrent"] == UNITS
    (tmp_path / "blue.safetensors").write_bytes(policy.to_bytes())
    with new_store(tmp_path / "other", arena, settings()) as other:
        found = policy_file.bring_in(Open(other, LEAGUE), policy_file.read(tmp_path / "blue.safetensors"), "guest")
        assert other.blobs.get(found.digest) == store.blobs.get(store.snapshots(LEAGUE, "blue")[1].digest)
        add_scripts(other, LEAGUE, arena, ["rock"])
        config = replace(settings(), rating=replace(GAME.rating, worlds=16, pairings=2, record=False))
        (match, _) = MatchEvaluator(config, arena, LEAGUE).play(other, RatingMatch((("guest", "rock"),), 5))
        assert match.wins + match.draws + match.losses == 8


def test_players_go_on_from_players_that_remember_and_from_no_others(store, arena):
    turns(store, settings(), arena, 3)
    before = arrays.from_bytes(store.blobs.get(store.checkpoint(LEAGUE, "red").digest))
    sources = WarmStart((Source(LEAGUE, "red", 0),), (LEAGUE, "red"))
    learner = HappoLearner([1], [3], settings().learner, seed=77)
    warm_start.start(store, learner, sources)
    for name, array in learner.save().items():
        if name.startswith(("actor.", "critic.")):
            np.testing.assert_array_equal(array, before[name], err_msg=name)
    for other in (Architecture((6,)), Architecture((6,), recurrent=UNITS + 1)):
        with pytest.raises(StorageError, match=r"does not fit this learner: actor\.0\."):
            warm_start.start(
                store, HappoLearner([1], [3], replace(settings().learner, architecture=other), seed=7), sources
            )


@pytest.mark.slow
def test_in_ladder_those_that_rest_take_over_an_actor_that_remembers(store, arena):
    config = settings(Schedule("ladder", period=2))
    turns(store, replace(config, learner=replace(config.learner, critic_input="all")), arena, 3)
    blue, red = (arrays.from_bytes(store.blobs.get(digest)) for _, digest in ends(store).values())
    for name in (name for name in blue if name.startswith("actor.0.gru.")):
        np.testing.assert_array_equal(blue[name], red[name])
    assert (blue["critic.gru.weight_hh"] != red["critic.gru.weight_hh"]).any()


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (
            {"learner": {"architecture": {"recurrent": 8}}},
            "learner.chunk_length = 10: must divide training.rollout_length, 32",
        ),
        (
            {"learner": {"architecture": {"recurrent": 8}, "chunk_length": 64}, "training": {"rollout_length": 24}},
            "use 24, or another rollout",
        ),
        (
            {
                "learner": {"architecture": {"recurrent": 8}, "chunk_length": 32, "minibatches": 4},
                "training": {"worlds": 2},
            },
            "a batch has only 2 samples, worlds × rollout_length / chunk_length",
        ),
        ({"learner": {"architecture": {"recurrent": -1}}}, "learner.architecture.recurrent"),
        ({"learner": {"chunk_length": 0}}, "learner.chunk_length"),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused_in_one_line(given, says):
    with pytest.raises(ConfigError) as caught:
        build(Config, given)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_chunks_matter_to_nobody_who_remembers_nothing():
    assert build(Config, {"learner": {"chunk_length": 7}}).learner.sequence is None
    kept = build(Config, {"learner": {"architecture": {"recurrent": 8}, "chunk_length": 8}})
    assert configuration.loads(configuration.dumps(kept)) == kept
