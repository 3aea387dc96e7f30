"""The dense reward fades over steps or with success, never rises again, and a kill does not change how."""

from dataclasses import replace

import numpy as np
import pytest

import arenas
from league.config import experiment as configuration
from league.config.schema import ConfigError
from league.config.sections import Training
from league.runtime.validation import validate
from league.training import reward_shaping
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.blobs import arrays
from tests.league.turns import LEAGUE, ends, new_store, settings, turns

PENNIES = arenas.settings("matching-pennies")


def figures(episodes: int, score: float) -> dict[str, float]:
    return {"counted": episodes} | ({"score": score} if episodes else {})


def test_over_steps_it_falls_linearly_by_default_over_half_a_million():
    assert [reward_shaping.by_steps(Training(), steps) for steps in (0, 250_000, 500_000, 600_000)] == [
        1.0,
        0.5,
        0.0,
        0.0,
    ]
    assert reward_shaping.by_steps(Training(shaping_steps=1000), 250) == 0.75
    assert reward_shaping.by_steps(Training(shaping_steps=0), 0) == 0.0


def test_it_falls_with_the_running_score_and_never_rises_again():
    fades = reward_shaping.make_annealing(Training(shaping_until=0.9), teams=2)
    assert fades.weight == 1.0
    fades.note(figures(500, 0.2))
    assert (fades.score, fades.weight) == (pytest.approx(0.35), 1.0)  # half of the way from 0.5
    fades.note(figures(1000, 0.7))
    assert fades.weight == pytest.approx(0.5)
    fades.note(figures(5000, 0.1))
    assert fades.weight == pytest.approx(0.5)
    fades.note(figures(0, 0.0))
    assert fades.score == pytest.approx(0.1)
    fades.note(figures(1000, 0.95))
    assert fades.weight == 0.0
    fades.note(figures(1000, 0.0))
    assert fades.weight == 0.0


def test_alone_success_counts_from_nothing():
    fades = reward_shaping.make_annealing(Training(shaping_until=0.8), teams=1)
    fades.note(figures(1000, 0.2))
    assert fades.weight == pytest.approx(0.75)


def test_a_copy_goes_on_from_whom_it_copies_without_rising():
    learner, copy = (reward_shaping.make_annealing(Training(shaping_until=0.9), teams=2) for _ in range(2))
    learner.note(figures(1000, 0.7))
    copy.follow(learner)
    assert (copy.score, copy.weight) == (learner.score, learner.weight)
    copy.weight = 0.1
    copy.follow(learner)
    assert copy.weight == 0.1


@pytest.fixture(scope="module")
def arena():
    return PENNIES.build()


def pennies(**changes) -> configuration.Config:
    config = replace(settings(shaping_until=0.55, **changes), arena=PENNIES)
    return replace(config, learner=replace(config.learner, lr=0.02))


def test_it_is_in_the_checkpoint_and_in_the_curve_and_goes_on_as_if_nothing_had_been(arena, tmp_path):
    config = pennies(schedule=Schedule("frozen"), opponents=Opponents("uniform", past=0.5, groups=2))
    with new_store(tmp_path / "store", arena) as store, new_store(tmp_path / "other", arena) as other:
        for _ in range(5):
            turns(store, config, arena, 1)  # by a fresh trainer each, as after a kill
        turns(other, config, arena, 5)
        assert ends(store) == ends(other)
        told = [p.values["shaping_weight"] for p in store.curves(LEAGUE, "blue")]
        assert told == [p.values["shaping_weight"] for p in other.curves(LEAGUE, "blue")]
        assert told == sorted(told, reverse=True)
        assert told[0] > told[-1]
        state = arrays.from_bytes(store.blobs.get(store.checkpoint(LEAGUE, "blue").digest))
        assert float(state[reward_shaping.WEIGHT]) == told[-1]
        resting = arrays.from_bytes(store.blobs.get(store.checkpoint(LEAGUE, "red").digest))
        assert float(resting[reward_shaping.WEIGHT]) == 1.0


def test_without_the_setting_a_checkpoint_holds_nothing_of_it_and_with_it_such_a_one_is_gone_on_from(arena, tmp_path):
    config = pennies()
    without = replace(config, training=replace(config.training, shaping_until=None))
    with new_store(tmp_path / "store", arena) as store:
        turns(store, without, arena, 2)
        state = arrays.from_bytes(store.blobs.get(store.checkpoint(LEAGUE, "blue").digest))
        assert not [name for name in state if name.startswith("shaping")]
        turns(store, config, arena, 1)
        state = arrays.from_bytes(store.blobs.get(store.checkpoint(LEAGUE, "blue").digest))
        assert 0.0 < np.asarray(state[reward_shaping.WEIGHT]) <= 1.0


def test_what_contradicts_itself_is_refused_in_one_line():
    with pytest.raises(ConfigError, match=r'training\.shaping_until = 0\.8: .* not both; set one to "none"$'):
        configuration.loads("[training]\nshaping_steps = 1000\nshaping_until = 0.8\n")
    with pytest.raises(ConfigError, match=r"training\.shaping_until = 0\.5: .* has 2 teams, each of which gets 0\.5 "):
        validate(configuration.loads('arena.name = "matching-pennies"\n[training]\nshaping_until = 0.5\n'))
    assert validate(configuration.loads('arena.name = "matching-pennies"\n[training]\nshaping_until = 0.51\n'))
