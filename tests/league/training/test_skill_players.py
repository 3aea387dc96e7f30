"""Players over skills, all the way: turns, checkpoints, snapshots, matches, files, other learners."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.learner.happo import HappoLearner
from agents.settings import Architecture, HappoConfig, SkillSettings
from arenas.arena import Arena
from arenas.arena_settings import Table
from league.config import experiment as configuration
from league.config.build import build
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.runtime.checkpoint_compat import validate_checkpoints
from league.runtime.validation import validate
from league.snapshots import policy_file
from league.snapshots.codec import add_scripts
from league.snapshots.exports.networks import agents_of
from league.snapshots.exports.torchscript_export import torchscript_bytes
from league.snapshots.transfer import warm_start
from league.state.jobs import RatingMatch
from league.training.learner_factory import new_learner
from matchmaking.opponents import Opponents
from storage.blobs import arrays
from storage.records import League, Match, Player
from storage.store import Store
from tests.league.turns import LEAGUE, ends, new_store, new_trainer, turns

ROOT = Path(__file__).parents[3]
GAME = configuration.default("sumo-1v1-leatherback")
GAME = replace(GAME, arena=replace(GAME.arena, rules=replace(GAME.arena.rules, episode=1.0)))  # 50 decisions
SKILL = SkillSettings(("leatherback-push",), ("slot A:2",), every=4)


def settings(opponents=Opponents(), players=(), **learner) -> Config:  # noqa: B008  (frozen)
    """A league of 8 worlds and rollouts of 8 decisions, which are two commands."""
    size = {"worlds": 8, "rollout_length": 8, "iterations_per_turn": 4}
    training = replace(GAME.training, opponents=opponents, device="cpu", **size)
    own = replace(HappoConfig(Architecture((6,)), skill=SKILL, minibatches=2), **learner)
    rating = replace(GAME.rating, milestones=())
    budget = configuration.Budget(steps=10**9)
    return replace(
        GAME, league=LEAGUE, deterministic=True, training=training, learner=own, rating=rating, budget=budget,
        players=players,
    )  # fmt: skip


@pytest.fixture(scope="module")
def arena() -> Arena:
    return GAME.arena.build(engine="c", threads=1)


@pytest.fixture
def store(tmp_path, arena) -> Iterator[Store]:
    with new_store(tmp_path / "store", arena, settings()) as store:
        yield store


@pytest.mark.slow
def test_a_league_killed_after_every_turn_ends_with_the_same_bytes(store, arena, tmp_path):
    config = settings(Opponents("uniform", past=0.5, groups=2))
    turns(store, config, arena, 4)
    with new_store(tmp_path / "other", arena, settings()) as other:
        for _ in range(4):
            turns(other, config, arena, 1)
        assert ends(other) == ends(store)
    curve = store.curves(LEAGUE, "blue")
    assert [point.step for point in curve][:2] == [48, 96]  # decisions of the arena in 6 worlds, not commands


def test_skills_stay_and_strategies_learn(store, arena):
    config = settings()
    pool = turns(store, config, arena, 3).pool
    learner = pool.learners["blue"]
    assert isinstance(learner, HappoLearner)
    assert [actor.mean.out_features for actor in learner.actors] == [2]
    assert learner.config.discount == pytest.approx(config.learner.gamma**4)
    snapshots = [arrays.from_bytes(store.blobs.get(s.digest)) for s in store.snapshots(LEAGUE, "blue")]
    first, last = snapshots[0], snapshots[-1]
    same = {name for name in first if np.array_equal(first[name], last[name])}
    assert {name for name in first if name.startswith("0/skill.")} <= same
    assert "0/mean.weight" not in same
    push = policy_file.read(policy_file.find("leatherback-push")).arrays
    np.testing.assert_array_equal(last["0/skill.0.mean.weight"], push["0/mean.weight"])


def test_a_league_goes_on_with_the_skills_of_its_checkpoint(store, arena):
    """Also where the file of a skill has changed since."""
    config = settings()
    turns(store, config, arena, 1)
    checkpoint = store.checkpoint(LEAGUE, "blue")
    assert checkpoint is not None
    kept = arrays.from_bytes(store.blobs.get(checkpoint.digest))["skill.0/skill.0.mean.bias"]
    pool = new_trainer(config, arena, store).pool
    skills = pool.skills["blue"]
    assert skills is not None
    skills.arrays = tuple({**own, "skill.0.mean.bias": own["skill.0.mean.bias"] + 1.0} for own in skills.arrays)
    pool._load(store, "blue", checkpoint.digest, 0)
    np.testing.assert_array_equal(skills.arrays[0]["skill.0.mean.bias"], kept)
    acting = pool.acting("blue")[0]
    assert isinstance(acting, dict)
    np.testing.assert_array_equal(acting["skill.0.mean.bias"], kept)


@pytest.mark.parametrize("changed", [{"reach": 1.0}, {"every": 8}, {"command": ("slot B:2",)}, None])
def test_a_league_does_not_go_on_with_other_settings_of_its_skills(changed, store, arena):
    turns(store, settings(), arena, 1)
    checkpoint = store.checkpoint(LEAGUE, "blue")
    assert checkpoint is not None
    skill = SkillSettings() if changed is None else replace(SKILL, **changed)
    with pytest.raises(ConfigError, match=r"these settings of its learner: blue: .*learner\.skill"):
        validate_checkpoints(store, settings(skill=skill), arena, store.players(LEAGUE))
    validate_checkpoints(store, settings(lr=0.5), arena, store.players(LEAGUE))


@pytest.mark.slow
def test_flat_and_skilled_players_meet_in_training_and_in_matches(store, arena, tmp_path):
    """Each learns what it chooses: two numbers per command, or two per decision. Both are rated, and scripts are."""
    players = (PlayerSettings("blue"), PlayerSettings("red", flat=True))
    config = settings(players=players)
    add_scripts(store, LEAGUE, arena, None)
    pool = turns(store, config, arena, 2).pool
    assert pool.skills["red"] is None
    assert pool.skills["blue"] is not None
    names = {s.name for s in store.snapshots(LEAGUE)}
    assert {"blue@1", "red@1", "pusher"} <= names
    rating = replace(config.rating, worlds=8, pairings=2)
    evaluator = MatchEvaluator(replace(config, rating=rating), arena, LEAGUE)
    found = evaluator.play(store, RatingMatch((("blue@1", "red@1"), ("blue@1", "pusher")), 5))
    assert [isinstance(match, Match) and match.wins + match.draws + match.losses for match in found] == [4, 4]


def test_its_checkpoint_leaves_as_the_file_of_a_snapshot_would(store, arena, tmp_path):
    config = settings()
    config = replace(config, training=replace(config.training, snapshots_per_doubling=1))
    frozen = arrays.from_bytes(turns(store, config, arena, 6).pool.freeze("blue"))  # the last turn has no snapshot
    store.close()
    with Open(Store.open(tmp_path / "store"), LEAGUE) as opened:
        policy = policy_file.export_checkpoint(opened, "blue")
        assert policy is not None
        assert policy.about["name"] not in {s.name for s in opened.store.snapshots(LEAGUE)}
    assert policy.arrays.keys() == frozen.keys()
    for name, array in frozen.items():
        np.testing.assert_array_equal(policy.arrays[name], array, err_msg=name)


def test_it_leaves_as_a_file_and_comes_back(store, arena, tmp_path):
    turns(store, settings(), arena, 2)
    store.close()
    with Open(Store.open(tmp_path / "store"), LEAGUE) as opened:
        policy = policy_file.export(opened, "blue@1")
        (agent,) = policy.about["agents"]
        assert agent["action"] == 2
        assert agent["over"]["every"] == 4
        assert len(agent["over"]["skills"]) == 1
        (tmp_path / "x.safetensors").write_bytes(policy.to_bytes())
        back = policy_file.bring_in(opened, policy_file.read(tmp_path / "x.safetensors"), "back")
        assert back.digest == opened.snapshot("blue@1").digest


def test_any_learner_commands_skills(store, arena):
    """REINFORCE of the documentation, which knows nothing of skills."""
    example = str(ROOT / "docs" / "examples" / "reinforce.py") + ":Reinforce"
    config = settings(class_=example, settings=Table({"lr": 0.01}))
    validate(config)
    turns(store, config, arena, 2)
    newest = arrays.from_bytes(store.blobs.get(store.snapshots(LEAGUE, "blue")[-1].digest))
    assert newest["0/mean.weight"].shape == (2, 16)
    assert "0/skill.0.mean.weight" in newest


@pytest.mark.slow
def test_a_strategy_and_its_skill_become_one_network(store, arena, tmp_path):
    """The learner of docs/examples/distil.py imitates the TorchScript file of a policy over skills."""
    frozen = arrays.from_bytes(new_trainer(settings(), arena, store).pool.freeze("blue"))
    (agent,) = agents_of(frozen, arena.teams[0].roster)
    own = {name.removeprefix("0/"): array for name, array in frozen.items()}
    (tmp_path / "teacher.pt").write_bytes(torchscript_bytes(own, agent))
    example = str(ROOT / "docs" / "examples" / "distil.py") + ":Distil"
    taught = Table({"teachers": (str(tmp_path / "teacher.pt"),), "hidden": 32, "lr": 0.003, "epochs": 30})
    training = replace(settings().training, worlds=24, rollout_length=24)
    config = replace(settings(), learner=HappoConfig(class_=example, settings=taught), training=training)
    validate(config)
    with new_store(tmp_path / "other", arena, config) as other:
        turns(other, config, arena, 5)
        missed = [point.values["missed.0"] for point in other.curves(LEAGUE, "blue")]
        assert missed[0] > 0.8
        assert missed[-1] < 0.3
        student = arrays.from_bytes(other.blobs.get(other.snapshots(LEAGUE, "blue")[-1].digest))
        assert student["0/mean.weight"].shape == (2, 32)
        assert not any(name.startswith("0/skill.") for name in student)


@pytest.mark.slow
def test_a_league_begins_with_the_strategies_of_another(store, arena, tmp_path):
    turns(store, settings(), arena, 2)
    trained = arrays.from_bytes(store.blobs.get(store.snapshots(LEAGUE, "blue")[-1].digest))
    config = replace(settings(), league="second", after=(LEAGUE,))
    players = [Player("second", t.name, i, "main", t.roster) for i, t in enumerate(arena.teams)]
    store.create_league(League("second", configuration.dumps(config)))
    store.add_players(players)
    learner = new_learner(config, arena, players[0])
    assert isinstance(learner, HappoLearner)
    warm_start.start(store, learner, warm_start.of(store, players, (LEAGUE,))["blue"])
    np.testing.assert_array_equal(learner.actors[0].mean.weight.detach(), trained["0/mean.weight"])


BAD = {
    "learner.skill.every = 3: must divide": {"learner": {"skill": {"every": 3}}},
    "learner.skill.every = 0: must be between 1 and 1000": {"learner": {"skill": {"every": 0}}},
    "there is no skill to command": {"learner": {"skill": {"policies": [], "command": ["a"]}}},
    "'slot A:0' is no part": {"learner": {"skill": {"command": ["slot A:0"]}}},
    "architecture.recurrent = 4: a strategy over skills": {"learner": {"architecture": {"recurrent": 4}}},
}


@pytest.mark.parametrize("message", BAD)
def test_contradictions_are_one_line(message):
    with pytest.raises(ConfigError, match=message):
        build(Config, BAD[message], settings())


def test_a_skill_that_cannot_act_here_is_one_line_that_names_its_setting():
    walk = SkillSettings(("anymal-walk",), ("slot A",), every=4)
    config = replace(settings(), learner=replace(settings().learner, skill=walk))
    with pytest.raises(ConfigError, match=r"^learner.skill.policies: anymal-walk moves robots of kind anymal, and"):
        validate(config)
    config = replace(config, learner=replace(config.learner, skill=replace(walk, policies=("nobody",))))
    with pytest.raises(ConfigError, match=r"^learner.skill.policies: .*nobody"):
        validate(config)
