"""Players who learn by soft actor-critic: the interface of learners holds for one that keeps what it saw."""

from dataclasses import replace

import numpy as np
import pytest

import arenas
from agents.off_policy.sac import SacLearner
from agents.settings import Architecture, ReplaySettings, SacSettings
from arenas.arena_settings import Table
from league.config import experiment as configuration
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.runtime.validation import validate
from league.snapshots.policy_file import export
from league.state.jobs import RatingMatch
from league.training.learner_factory import new_learner
from league.training.own_learner import OwnLearner
from matchmaking.opponents import Opponents
from storage.records import Player
from tests.league.turns import LEAGUE, claim, ends, new_store, new_trainer, settings, turns

GAME = arenas.settings("rock-paper-scissors")
ROCK = Opponents("fixed", victim="rock")
UNIFORM = Opponents("uniform", past=0.5, groups=2)
REPLAY = ReplaySettings(capacity=4000, start=200, saved=True)


def of(opponents=Opponents(), replay=REPLAY, critic_input="own", **own):  # noqa: B008  (frozen)
    """The settings of a league of rock, paper, scissors whose players learn by sac."""
    config = settings(opponents=opponents, device="cpu")
    sac = SacSettings(**{"replay": replay, "batch": 64, "critic_hidden": (32,), "bins": 21, **own})
    learner = replace(
        config.learner, class_="sac", sac=sac, architecture=Architecture((16,)), critic_input=critic_input
    )
    return replace(config, arena=GAME, learner=learner)


def inner(trainer, name="blue") -> SacLearner:
    """The learner itself, behind the interface."""
    learner = trainer.pool.learners[name]
    assert isinstance(learner, OwnLearner)
    assert isinstance(learner._learner, SacLearner)
    return learner._learner


def test_a_player_learns_to_beat_a_script_and_its_snapshot_is_an_ordinary_policy(store, game):
    config = of(ROCK, lr=1e-2, replay_ratio=4.0)
    turns(store, config, game, 9)  # iterations 1, 2, 4, 8, 12, ..., 32
    points = store.curves(LEAGUE, "blue")
    assert points[0].values["score"] < 0.7
    print([p.values["score"] for p in points])
    assert np.mean([p.values["score"] for p in points[-4:]]) > 0.9  # paper
    newest = store.snapshots(LEAGUE, "blue")[-1]
    about = export(Open(store, LEAGUE), newest.name).about["agents"][0]
    assert about["hidden"] == [16]
    rating = replace(config.rating, worlds=64, pairings=1)
    evaluator = MatchEvaluator(replace(config, rating=rating), game, LEAGUE)
    (match,) = evaluator.play(store, RatingMatch(((newest.name, "rock"),), 5))
    assert match.wins > 55


def test_a_worker_that_takes_over_goes_on_to_the_same_bytes(store, game, tmp_path):
    config = of(UNIFORM)
    turns(store, config, game, 4)
    turns(store, config, game, 2)  # a fresh trainer, as after a kill
    with new_store(tmp_path / "other", game) as other:
        turns(other, config, game, 6)
        assert ends(other) == ends(store)
    assert "value_loss" in store.curves(LEAGUE, "blue")[-1].values


def test_without_the_buffer_in_checkpoints_learning_waits_after_a_kill(store, game):
    config = of()
    unsaved = replace(config.learner, sac=replace(config.learner.sac, replay=replace(REPLAY, saved=False)))
    config = replace(config, learner=unsaved, deterministic=False)
    turns(store, config, game, 4)
    learning = ["value_loss" in point.values for point in store.curves(LEAGUE, "blue")]
    assert learning == [False, True, True, True]  # 128 decisions each
    turns(store, config, game, 1)
    learning = ["value_loss" in point.values for point in store.curves(LEAGUE, "blue")[4:]]
    assert learning == [False, True, True, True]


@pytest.mark.parametrize("forget", ["never", "opponents"])
def test_games_against_opponents_that_were_drawn_no_more_are_forgotten(store, game, forget):
    config = of(UNIFORM, replay=replace(REPLAY, forget=forget))
    trainer = new_trainer(config, game, store)
    for _ in range(5):
        lease, turn = claim(store, config)
        for _ in trainer.turn(store, turn, lambda: False):
            pass
        trainer.commit(store, lease, turn)
    replay = inner(trainer).replay
    assert replay is not None
    kept, met = set(replay.tags[replay.valid].tolist()), set(inner(trainer)._tags)
    assert len(met) == 2  # the present player, and one of the past
    assert (kept <= met) == (forget == "opponents")


def test_critics_see_what_the_settings_say(store, game):
    trainer = turns(store, of(critic_input="all"), game, 3)
    assert inner(trainer)._layout.more == sum(agent.observation_size for agent in game.teams[1].agents)
    assert "value_loss" in store.curves(LEAGUE, "blue")[-1].values
    bodies = arenas.settings("sumo-1v1").build(engine="c", threads=1)
    learner = new_learner(of(critic_input="privileged"), bodies, Player(LEAGUE, "blue", 0, "main", ""))
    assert isinstance(learner, OwnLearner)
    assert learner._learner._layout.more == bodies.privileged_size > 0  # type: ignore[attr-defined]


def test_one_player_learns_by_sac_and_the_other_by_happo(store, game):
    config = replace(of(), learner=replace(of().learner, class_="happo"))
    config = replace(config, players=(PlayerSettings("blue", class_="sac"), PlayerSettings("red")))
    turns(store, config, game, 3)
    assert "temperature" in store.curves(LEAGUE, "blue")[-1].values
    assert "explained_variance" in store.curves(LEAGUE, "red")[-1].values


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"replay": replace(REPLAY, capacity=10**6)}, r"saved: 1000000 decisions are \d+ MiB in each checkpoint"),
        ({"player": {"lr": 0.1}}, r"is a setting of happo; it reads learner\.sac\.lr"),
        ({"player": {"settings": Table({"lr": 1})}}, "settings: are those of a class of yours"),
    ],
)  # fmt: skip
def test_what_sac_cannot_do_is_one_line(change, message):
    player = PlayerSettings("blue", **change.pop("player", {}))
    config = replace(of(**change), players=(player, PlayerSettings("red")))
    with pytest.raises(ConfigError, match=message) as refused:
        validate(config)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[learner]\nclass = 'sac'\ncritic_input = 'same'", "use own, all or privileged"),
        ("[learner]\nclass = 'sac'\n[learner.sac.replay]\nstart = 10\ncapacity = 5", "10 decisions are never there"),
        ("[learner]\nclass = 'sac'\n[learner.architecture]\nrecurrent = 8", "sac's actors have no memory"),
        ("deterministic = true\n[learner]\nclass = 'sac'\n[budget]\nsteps = 5\n", "learner.sac.replay.saved = true"),
        ("[learner]\nclass = 'sac'\n[learner.settings]\nlr = 1.0", "are those of a class of yours"),
        ("[learner.sac]\nbatch = 0", "must be between 1 and 1000000"),
        ("[learner]\nclass = 'sca'", "must be happo, sac, or a class in a file of yours"),
    ],
)
def test_a_setting_that_contradicts_another_is_refused(text, message):
    with pytest.raises(ConfigError, match=message) as refused:
        configuration.loads(text)
    assert "\n" not in str(refused.value)


def test_a_flag_of_happo_is_refused_where_nobody_learns_by_it():
    with pytest.raises(ConfigError, match=r"is a setting of happo.* give its own as --learner.sac.lr"):
        configuration.loads("[learner]\nclass = 'sac'", given={("learner", "lr"): "0.1"})
    configuration.loads("[learner]\nclass = 'sac'", given={("learner", "gamma"): "0.9"})
