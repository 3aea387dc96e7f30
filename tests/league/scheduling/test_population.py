"""Population based training: who copies whom, what is inherited, and that a kill changes nothing."""

from dataclasses import replace

import numpy as np
import pytest

from league.commands.run import status
from league.config import experiment as configuration
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.queries.query import Open
from league.runtime.validation import validate
from league.scheduling import turn_scheduler
from league.scheduling.population import copy_now, read, surely_scores
from league.snapshots.codec import add_scripts
from league.state.jobs import decode
from league.state.league_state import LeagueState
from league.training.learner_factory import settings_of
from matchmaking.opponents import Opponents
from matchmaking.pbt import Pbt
from matchmaking.ratings.ladder import Ladder, Pool
from matchmaking.schedule import Schedule
from storage.blobs import arrays
from storage.records import Checkpoint, League, Player
from storage.store import Store
from tests.league.leagues import BLUE, RED, games, match, player, snapshot
from tests.league.turns import LEAGUE, claim, ends, new_trainer, settings, turns

OTHER = player("blue-2", 0, group="2")
PBT = Pbt(ready=500, by="win_rate")


def league_state(*meetings, matches=(), step=600, players=(BLUE, OTHER, RED)):
    frozen = [snapshot(p, i) for p in players for i in (0, 4)]
    ladder = Ladder(Pool.of(frozen, players), matches)
    at = {p.name: Checkpoint("cup", p.name, f"state of {p.name}", step, 6, 6.0) for p in players}
    return LeagueState(players, frozen, at, meetings=meetings, ladder=ladder)


def copies(state, pbt=PBT, who=OTHER):
    config = configuration.default("rock-paper-scissors")
    return copy_now(replace(config, training=replace(config.training, pbt=pbt)), state, who)


WEAK = games("red@4", 10, 90, who="blue-2", iteration=5), games("red@4", 60, 40, iteration=5)


def test_who_surely_scores_less_copies_the_other_and_not_the_other_way_round():
    copied = ("blue", "state of blue", "blue@4")
    assert copies(league_state(*WEAK)) == copied
    assert copies(league_state(*WEAK), who=BLUE) is None
    alike = games("red@4", 55, 45, who="blue-2", iteration=5), WEAK[1]
    assert copies(league_state(*alike)) is None  # weaker, and not surely
    assert copies(league_state()) is None
    assert copies(league_state(*WEAK), who=RED) is None  # nobody else is of its team


def test_only_who_has_learnt_long_enough_since_its_last_copy_copies_or_is_copied():
    assert copies(league_state(*WEAK), replace(PBT, ready=600))
    assert copies(league_state(*WEAK), replace(PBT, ready=601)) is None
    assert copies(league_state(*WEAK), Pbt()) is None
    state = league_state(*WEAK)
    gone_on = [replace(s, parent="blue@4") if s.name == "blue-2@4" else s for s in state.snapshots]
    state = replace(state, snapshots=gone_on)  # at step 400
    assert copies(state) is None
    assert copies(state, replace(PBT, ready=200))
    paused = replace(BLUE, paused="diverged")
    assert copies(replace(league_state(*WEAK), players=(paused, OTHER, RED))) is None


def test_by_rating_the_newest_rated_snapshots_are_compared():
    by_rating = replace(PBT, by="rating")
    assert copies(league_state(*WEAK), by_rating) is None
    rated = [match("blue-2@4", "red@0", 30, 70), match("blue@4", "red@0", 70, 30), match("blue@0", "red@0", 50, 50)]
    state = league_state(matches=rated)
    assert copies(state, by_rating) == ("blue", "state of blue", "blue@4")
    config = configuration.default("rock-paper-scissors")
    config = replace(config, training=replace(config.training, pbt=by_rating))
    low, high = surely_scores(config, state, "blue-2", "blue")
    assert low < state.ladder.ratings.expected("blue-2@4", "blue@4") < high < 0.45
    few = [match("blue-2@4", "red@0", 3, 7), match("blue@4", "red@0", 7, 3), match("blue@0", "red@0", 5, 5)]
    assert copies(league_state(matches=few), by_rating) is None


# Turns ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arena():
    return configuration.default("rock-paper-scissors").arena.build()


def population(**changes):
    """Two of blue who meet a script that always chooses rock: one learns to beat it, the other hardly learns."""
    pbt = Pbt(1024, "win_rate", hyperparameters=("lr", "entropy_coef"), inherit=1.0, mutate=0.0, within=1000.0)
    config = settings(Schedule(), Opponents("fixed", victim="rock"))
    players = (
        PlayerSettings("blue", "blue", group="1", lr=0.01), PlayerSettings("blue", "slow", group="2", lr=1e-4),
        PlayerSettings("red", "red", "fixed", group="1"), PlayerSettings("red", "red-2", "fixed", group="2"),
    )  # fmt: skip
    training = replace(config.training, pbt=replace(pbt, **changes))
    return replace(config, arena=configuration.default("rock-paper-scissors").arena, training=training, players=players)


def test_a_players_own_rate_is_that_of_its_actors_alone():
    config = population()
    slow = settings_of(config, Player(LEAGUE, "slow", 0, "main", "roster", "2"))
    assert (slow.lr, slow.critic_lr) == (1e-4, config.learner.critic_lr)
    assert settings_of(config, Player(LEAGUE, "other", 0, "main", "roster", "2")) == config.learner


def made(place, arena, config):
    store = Store.open(place, create=True)
    store.create_league(League(LEAGUE, configuration.dumps(replace(config, league=LEAGUE))))
    roster, team = arena.teams[0].roster, {"blue": 0, "red": 1}
    store.add_players([Player(LEAGUE, p.name, team[p.team], p.role, roster, p.group) for p in config.players])
    add_scripts(store, LEAGUE, arena, None)
    return store


def until_a_copy(store, config, trainer):
    """Turns one after the other; the first in which somebody copies is done and not written."""
    for done in range(40):
        lease, turn = claim(store, config)
        for _ in trainer.turn(store, turn, lambda: False):
            pass
        if turn.copies:
            return lease, turn, done
        trainer.commit(store, lease, turn)
    raise AssertionError("nobody copied anybody")


def hyperparameters(store, name):
    state = arrays.from_bytes(store.blobs.get(store.checkpoint(LEAGUE, name).digest))
    return state, read(state, ("lr", "entropy_coef"))


@pytest.mark.slow
def test_the_weaker_goes_on_from_the_strongers_whole_state_however_often_it_is_killed(arena, tmp_path):
    config = population()
    with made(tmp_path / "a", arena, config) as store:
        lease, turn, done = until_a_copy(store, config, new_trainer(config, arena, store))
        assert turn.learners == ("slow",)
        before = hyperparameters(store, "slow")[1]
        assert before["lr"] == 1e-4
        store.release(lease)  # killed: of the copy nothing was written
        source, digest, parent = turn.copies["slow"]
        assert (source, digest) == ("blue", store.checkpoint(LEAGUE, "blue").digest)

        turns(store, config, arena, 1)
        newest = store.snapshots(LEAGUE, "slow")[-1]
        assert newest.iteration == store.checkpoint(LEAGUE, "slow").iteration
        assert newest.parent == parent
        assert hyperparameters(store, "slow")[1] == hyperparameters(store, "blue")[1] | {"lr": 0.01}
        scores = [p.values["score"] for p in store.curves(LEAGUE, "slow")]
        assert scores[-1] > scores[-5] + 0.2  # it plays as the other does now
        assert [p.values["hyperparameter.lr"] for p in store.curves(LEAGUE, "slow")][-5:] == [1e-4] + 4 * [0.01]
        told = f"goes on from {parent} since {newest.name}, is compared after 1,024 steps more"
        assert f"slow: lr 0.01, entropy_coef 0.005; {told}" in status.report(Open(store, LEAGUE))
        again = next(decode(j) for j in turn_scheduler.next_turns(config, LeagueState.of(store, LEAGUE)).jobs)
        assert not again.copies  # not ready again yet
        reached = ends(store)
    with made(tmp_path / "b", arena, config) as other:
        turns(other, config, arena, done + 1)
        assert ends(other) == reached


def test_what_is_inherited_is_perturbed_within_its_range_and_learnt_with(arena, tmp_path):
    config = population(mutate=1.0, perturb=2.0, within=1000.0, hyperparameters=("lr", "gamma"))
    with made(tmp_path, arena, config) as store:
        trainer = new_trainer(config, arena, store)
        lease, turn, _ = until_a_copy(store, config, trainer)
        trainer.commit(store, lease, turn)
        state = hyperparameters(store, "slow")[0]
        moved = read(state, ("lr", "gamma"))
        assert moved["lr"] in (pytest.approx(0.005), pytest.approx(0.02))
        horizon = (1 - moved["gamma"]) / (1 - config.learner.gamma)
        assert horizon in (pytest.approx(0.5), pytest.approx(2))
        learner = trainer.pool.learners["slow"]
        assert (learner.config.lr, learner.config.gamma) == (moved["lr"], moved["gamma"])
        again = new_trainer(config, arena, store)  # another process learns with the same
        again.pool._load(store, "slow", store.checkpoint(LEAGUE, "slow").digest, 0)
        assert again.pool.learners["slow"].config == learner.config
        np.testing.assert_array_equal(again.pool.learners["slow"].save()["rng"], learner.save()["rng"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[training.pbt]\nscore = 0.4\n", "training.pbt: nobody copies anybody while training.pbt.ready is none"),
        ("[training.pbt]\nready = 0\n", "training.pbt.ready = 0: is a number of environment steps, 1 or more"),
        ('[training.pbt]\nready = 9\nhyperparameters = ["hidden"]\n', "hidden cannot move; use some of lr, critic_lr"),
        ("deterministic = true\n[budget]\nsteps = 9\n[training.pbt]\nready = 9\n", 'use "win_rate"'),
        ('[training.pbt]\nready = 9\n[training.schedule]\nkind = "ladder"\n', "ladder copies players itself"),
        (
            '[training.pbt]\nready = 9\nhyperparameters = ["lr"]\n[learner]\ndesired_kl = 0.01\n',
            "learner.desired_kl moves lr already",
        ),
    ],
)
def test_settings_that_cannot_be_are_one_line(text, says):
    with pytest.raises(ConfigError) as refused:
        configuration.loads(text)
    assert says in refused.value.message
    assert "\n" not in refused.value.message


def test_who_has_nobody_to_copy_or_another_network_is_refused():
    text = 'arena.name = "rock-paper-scissors"\ntraining.pbt.ready = 9\n'
    with pytest.raises(ConfigError, match="no team has two players of one role"):
        validate(configuration.loads(text))
    more = "".join(f'[[players]]\nteam = "{team}"\n' for team in ("blue", "red", "blue"))
    validate(configuration.loads(text + more))
    with pytest.raises(ConfigError, match=r"the main players of blue have networks of \[64, 64\] and \[8\]"):
        validate(configuration.loads(f"{text}{more}hidden = [8]\n"))
