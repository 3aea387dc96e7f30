"""Turns of a small league in one process: what they write, what a restart changes, what goes wrong."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import arenas
from agents.settings import Architecture
from league.config import experiment as configuration
from league.config.experiment import PlayerSettings
from league.scheduling import turn_scheduler
from league.state.league_state import LeagueState
from league.training.setback import PlayerDiverged
from league.training.trainer import Trainer
from league.training.training_recorder import TrainingRecorder
from league.training.update_pool import UpdatePool, run_inline
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.blobs import arrays
from storage.errors import LeaseLost
from storage.recordings.recording import from_bytes
from storage.records import RATED_PURPOSES, League, Player
from storage.store import Store
from tests.league.conftest import PUCKS
from tests.league.turns import LEAGUE, claim, ends, new_store, new_trainer, settings, turns

RACE = arenas.settings(PUCKS[1])


@pytest.fixture(scope="module")
def pucks():
    """An arena that compiles in half the time of a duel's, for settings that need programs of their own."""
    return RACE.build(engine="c", threads=1)


@pytest.fixture
def puck_store(tmp_path, pucks):
    """A store with a league in that arena."""
    with new_store(tmp_path / "store", pucks) as store:
        yield store


@pytest.mark.parametrize("kind", ["simultaneous", "leapfrog"])  # in leapfrog the critic of who rests learns beside
def test_that_players_learn_at_the_same_time_changes_no_byte(duel_store, duel, tmp_path, monkeypatch, kind):
    config, pool = settings(Schedule(kind, period=1), device="cpu"), "league.training.learner_pool.UpdatePool"
    monkeypatch.setattr(pool, lambda learners, one_here: UpdatePool(learners))  # as in a league that need not repeat
    turns(duel_store, config, duel, 2)
    asked = set()  # whether a deterministic league wants one update at a time
    monkeypatch.setattr(
        pool, lambda learners, one_here: asked.add(one_here) or (lambda updates: [run_inline(each) for each in updates])
    )
    with new_store(tmp_path / "other", duel) as other:
        turns(other, config, duel, 2)
        assert ends(other) == ends(duel_store)
    assert asked == {config.deterministic} == {True}


def test_an_episode_of_training_is_recorded_with_what_critics_made_of_it_and_changes_no_byte(
    duel_store, duel, tmp_path
):
    config = settings(Schedule("leapfrog", period=2), resting_critics=False, record_every=2)
    turns(duel_store, config, duel, 4)
    with new_store(tmp_path / "other", duel) as other:
        turns(other, replace(config, training=replace(config.training, record_every=0)), duel, 4)
        assert ends(other) == ends(duel_store)
        assert other.matches(LEAGUE) == []
    (match,) = duel_store.matches(LEAGUE)
    assert (match.purpose, match.a, match.b) == ("training", "blue@1", "red@0")  # snapshots, before they learnt on
    assert match.wins + match.draws + match.losses + match.voids == 1
    assert duel_store.totals(LEAGUE, RATED_PURPOSES) == {}
    found = from_bytes(duel_store.blobs.get(str(match.recording)))
    assert found.header.sides == ("blue@2", "red@0")
    frozen = {s.name: s.digest for s in duel_store.snapshots(LEAGUE)}
    assert found.header.digests == (frozen["blue@2"], frozen["red@0"])
    assert found.values.keys() == {"blue"}  # red's critic stands still, and would judge what it has never seen
    values, hold = found.values["blue"], duel.timing.hold
    assert np.isfinite(values).all()
    assert (values == np.repeat(values[::hold], hold)).all()
    assert len(set(values)) == match.steps == found.steps / hold


def test_episodes_of_all_lengths_are_judged_by_the_same_programs(duel_store, duel, monkeypatch, caplog):
    """JAX keeps each program: with one for each length, training took 13 MB more for every episode recorded."""
    judged, calls = TrainingRecorder._judged, []
    monkeypatch.setattr(TrainingRecorder, "_judged", lambda *args: calls.append(args) or judged(*args))
    turns(duel_store, settings(record_every=2), duel, 3)
    recorder, arena, played, length, judges = calls[0]
    whole = judged(recorder, arena, played, length, judges)
    with jax.log_compiles(), caplog.at_level("WARNING"):
        part = judged(recorder, arena, played, length - 3, judges)
        assert "ompiling" not in caplog.text
        jax.jit(lambda x: x + 1)(np.ones(3))
    assert "ompiling" in caplog.text
    assert part.keys() == whole.keys() == {"blue", "red"}
    for name in part:
        np.testing.assert_array_equal(part[name], whole[name][: length - 3])


def test_a_recording_that_fails_is_told_once_and_players_learn_on(duel_store, duel, capsys, monkeypatch):
    def full(recorder):
        raise OSError("no space left")

    monkeypatch.setattr(TrainingRecorder, "_built", full)
    turns(duel_store, settings(record_every=1), duel, 3)
    assert duel_store.checkpoint(LEAGUE, "blue").iteration == 2
    assert duel_store.matches(LEAGUE) == []
    assert capsys.readouterr().err == "league: this process stops recording training, which continues: no space left\n"


def test_a_milestone_of_training_time_ends_the_turn_with_snapshots(duel_store, duel):
    config = replace(settings(), deterministic=False)
    config = replace(config, rating=replace(config.rating, milestones=()))
    turns(duel_store, config, duel, 4)
    reached = duel_store.checkpoint(LEAGUE, "blue")
    assert reached.iteration == 4  # and no snapshot is due by iterations before the eighth
    soon = f"{reached.seconds + 1e-6:.6f}s"
    turns(duel_store, replace(config, rating=replace(config.rating, milestones=(soon,))), duel, 1)
    assert {name: i for name, (i, _) in ends(duel_store).items()} == {"blue": 5, "red": 5}
    assert [s.iteration for s in duel_store.snapshots(LEAGUE, "blue")] == [0, 1, 2, 4, 5]
    turns(duel_store, config, duel, 1)
    assert [s.iteration for s in duel_store.snapshots(LEAGUE, "blue")] == [0, 1, 2, 4, 5, 8]


def test_every_iteration_leaves_a_point_of_the_learning_curve(duel_store, duel):
    turns(duel_store, settings(), duel, 4)
    points = duel_store.curves(LEAGUE, "blue")
    assert [p.iteration for p in points] == [1, 2, 3, 4]
    wanted = {"entropy", "ratio", "policy_loss", "value_loss", "explained_variance", "steps_per_second", "past_share"}
    assert wanted | {"event.out", "event.fall"} <= set().union(*(p.values for p in points))
    assert points[-1].step == duel_store.checkpoint(LEAGUE, "blue").step


@pytest.mark.slow
def test_variants_of_the_learner_go_on_in_another_process(puck_store, pucks):
    config = settings(opponents=Opponents("uniform", past=0.5, groups=2), record_every=2)
    learner = replace(
        config.learner, architecture=Architecture((8,), squash=2.0, state_std=True), critic_input="all",
        share_actors=True, lr_decay_steps=800, target_kl=0.05,
    )  # fmt: skip
    config = replace(config, arena=RACE, learner=learner)
    turns(puck_store, config, pucks, 2)
    trainer = turns(puck_store, config, pucks, 1)  # which knows of the first two what the store says
    assert trainer.pool.learners["blue"].critic_learners[0].network.trunk.observation_mean.shape == (12,)
    kept, points = puck_store.checkpoint(LEAGUE, "blue"), puck_store.curves(LEAGUE, "blue")
    state = arrays.from_bytes(puck_store.blobs.get(kept.digest))
    assert kept.iteration == len(points) == 2
    values = from_bytes(puck_store.blobs.get(str(puck_store.matches(LEAGUE)[-1].recording))).values
    assert values.keys() == {"blue", "red"}
    assert state["steps"] == kept.step  # red's worlds against the past count, as they do for budgets and snapshots
    assert [p.values["lr"] for p in points] == pytest.approx([1e-3, 1e-3 * (1 - state["steps"] / 2 / 800)])


@pytest.mark.slow
@pytest.mark.parametrize(("sees", "size", "units"), [("privileged", 43, 0), ("same", 14, 0), ("privileged", 43, 5)])
def test_critics_that_see_more_go_on_in_another_process_to_the_same_bytes(
    puck_store, pucks, tmp_path, sees, size, units
):
    """Also with past opponents for each, and one that rests: what a critic knows is in its player's checkpoint."""
    rule = Opponents("uniform", past=0.5, groups=2)
    config = settings(Schedule("leapfrog", period=1), opponents=rule, record_every=2)
    architecture = replace(config.learner.architecture, recurrent=units)
    config = replace(
        config,
        arena=RACE,
        learner=replace(config.learner, critic_input=sees, chunk_length=4, architecture=architecture),
    )
    turns(puck_store, config, pucks, 2)
    assert not puck_store.matches(LEAGUE)
    trainer = turns(puck_store, config, pucks, 2)  # as after a kill
    assert trainer.pool.learners["blue"].critic_learners[0].network.trunk.observation_mean.shape == (size,)
    assert all(-1e3 < p.values["value_loss"] < 1e3 for p in puck_store.curves(LEAGUE))
    with new_store(tmp_path / "other", pucks) as other:
        turns(other, config, pucks, 4)
        assert ends(other) == ends(puck_store)
        kept = [m.recording for m in puck_store.matches(LEAGUE)]
        assert len(kept) == 1
        assert kept == [m.recording for m in other.matches(LEAGUE)]  # to the byte, values too
    assert all(len(from_bytes(puck_store.blobs.get(str(each))).values) > 0 for each in kept)


def test_programs_serve_another_trainer_and_are_refused_where_they_would_differ(duel_store, duel):
    config, players = settings(), duel_store.players(LEAGUE)
    first = new_trainer(config, duel, duel_store)
    assert Trainer(config, duel, players, 8, programs=first.programs).programs is first.programs
    for other in (
        replace(config, training=replace(config.training, rollout_length=4)),
        replace(config, training=replace(config.training, stagger=not config.training.stagger)),
        replace(config, learner=replace(config.learner, critic_input="privileged")),
    ):
        with pytest.raises(ValueError, match="other settings"):
            Trainer(other, duel, players, 8, programs=first.programs)


def test_past_opponents_are_met_by_learners_that_learn_on(duel_store, duel):
    config = settings(opponents=Opponents("uniform", past=0.5, groups=2))
    turns(duel_store, config, duel, 4)
    assert duel_store.checkpoint(LEAGUE, "blue").iteration == 4
    assert duel_store.curves(LEAGUE, "blue")[-1].values["past_share"] == 0.5
    # three groups share 16 worlds: five each, so that 15 are simulated
    assert duel_store.checkpoint(LEAGUE, "blue").step == 4 * 15 * 8


def lively(opponents: Opponents):
    """Settings of a league whose worlds live on from turn to turn; the clock ends no turn, however slow the machine."""
    config = settings(opponents=opponents)
    rating = replace(config.rating, milestones=())
    return replace(config, deterministic=False, budget=configuration.Budget(), rating=rating)


def test_most_worlds_go_on_where_opponents_stay_for_some_episodes(duel_store, duel):
    config = lively(Opponents("uniform", past=0.5, groups=4))
    turns(duel_store, config, duel, 9)  # to iteration 24
    shares = [p.values["begun_anew"] for p in duel_store.curves(LEAGUE, "blue") if p.iteration % 4 == 1]
    assert np.mean(shares[2:]) < 0.3  # the next test, whose turns draw anew, has more than 0.4


@pytest.mark.slow
def test_worlds_whose_opponent_changed_begin_anew_and_it_is_counted(duel_store, duel):
    config = lively(Opponents("uniform", past=0.5, groups=4, episodes=0))
    trainer = turns(duel_store, config, duel, 6)  # to iterations 1, 2, 4, 8, 12
    share = {p.iteration: p.values["begun_anew"] for p in duel_store.curves(LEAGUE, "blue")}
    assert any(0 < s < 1 for s in share.values())  # past groups, not those of present opponents
    assert share[9] > 0.4
    assert {share[i] for i in (6, 7, 8, 10, 11, 12)} == {0}  # once a turn, at its start
    ((worlds, seats),) = trainer._worlds.values()
    assert len(seats) == 6
    assert len(worlds.age) == 12


@pytest.mark.parametrize("schedule", [Schedule(), Schedule("ladder", period=8)])
def test_worlds_that_are_lost_begin_anew_and_it_is_counted(duel_store, duel, schedule):
    config = lively(Opponents())
    config = replace(config, training=replace(config.training, schedule=schedule))
    trainer = turns(duel_store, config, duel, 5)  # to iterations 1, 2, 4, 8; then a ladder copies
    turns(duel_store, config, duel, 1, trainer)
    turns(duel_store, config, duel, 1)  # in another process
    share = {p.iteration: p.values["begun_anew"] for p in duel_store.curves(LEAGUE, "blue")}
    anew = {13, 9} if schedule.kind == "ladder" else {13}
    assert share == {i: float(i in anew) for i in range(1, 17)}


def test_a_worker_that_takes_over_goes_on_to_the_same_bytes(duel_store, duel, tmp_path):
    turns(duel_store, settings(), duel, 3)
    turns(duel_store, settings(), duel, 2)  # a fresh trainer, as after a kill
    with Store.open(tmp_path / "other", create=True) as other:
        other.create_league(League(LEAGUE, ""))
        other.add_players(duel_store.players(LEAGUE))
        turns(other, settings(), duel, 5)
        assert ends(other) == ends(duel_store)


def test_a_spent_budget_freezes_what_was_learnt_last(duel_store, duel):
    config = replace(settings(), budget=configuration.Budget(steps=5 * 16 * 8))
    turns(duel_store, config, duel, 5)
    assert [s.iteration for s in duel_store.snapshots(LEAGUE, "blue")] == [0, 1, 2, 4, 5]
    assert not turn_scheduler.next_turns(config, LeagueState.of(duel_store, LEAGUE)).jobs


def test_a_turn_from_checkpoints_that_are_no_longer_the_newest_is_refused(duel_store, duel):
    config = settings()
    turns(duel_store, config, duel, 2)
    slow = new_trainer(config, duel, duel_store)
    lease, turn = claim(duel_store, config)
    for _ in slow.turn(duel_store, turn, lambda: False):
        pass
    duel_store.release(lease)  # taken for dead: somebody else does the turn
    turns(duel_store, config, duel, 1)
    after = ends(duel_store)
    duel_store.queue([_again(turn)])
    again, _ = duel_store.claim(LEAGUE, ["train"], "slow", 60)
    with pytest.raises(LeaseLost):
        slow.commit(duel_store, again, turn)
    assert ends(duel_store) == after


def _again(turn):
    from league.state.jobs import encode

    return encode(LEAGUE, turn, "the same turn under another key")


@pytest.mark.slow
def test_players_of_other_network_widths_learn_and_meet_in_one_batch(puck_store, pucks):
    config = replace(
        settings(opponents=Opponents("uniform", past=0.5, groups=4)), arena=RACE,
        players=(
            PlayerSettings("blue"), PlayerSettings("red"),
            PlayerSettings("blue", "blue-wide", group="2", hidden=(32, 32)),
            PlayerSettings("red", "red-wide", group="2", hidden=(32, 32)),
        ),
    )  # fmt: skip
    wide = [Player(LEAGUE, f"{t.name}-wide", i, "main", t.roster, "2") for i, t in enumerate(pucks.teams)]
    puck_store.add_players(wide)
    trainer = turns(puck_store, config, pucks, 8)
    assert {name: i for name, (i, _) in ends(puck_store).items()} == dict.fromkeys(ends(puck_store), 4)
    widths = {
        name: learner.save()["actor.0.trunk.hidden.0.weight"].shape[0]
        for name, learner in trainer.pool.learners.items()
    }
    assert widths == {"blue": 64, "red": 64, "blue-wide": 32, "red-wide": 32}
    first = {s.player: s.digest for s in puck_store.snapshots(LEAGUE) if s.initial}
    assert len(set(first.values())) == 4


def test_a_nan_in_an_actor_is_noticed_at_once_and_nothing_is_written(duel_store, duel):
    config = settings()
    trainer = turns(duel_store, config, duel, 3)
    before = ends(duel_store)
    actor = trainer.pool.learners["red"].actors[0]
    actor.mean.bias.data[:] = float("nan")
    lease, turn = claim(duel_store, config)
    with pytest.raises(PlayerDiverged, match="red diverged"):
        for _ in trainer.turn(duel_store, turn, lambda: False):
            pass
    assert ends(duel_store) == before
    duel_store.record_setback(lease, "red", "red diverged")
    assert next(p for p in duel_store.players(LEAGUE) if p.name == "red").setbacks == 1
    turns(duel_store, config, duel, 1)  # back at the checkpoint, other dice, and on
    assert ends(duel_store)["red"][0] > before["red"][0]
    assert next(p for p in duel_store.players(LEAGUE) if p.name == "red").setbacks == 0


def test_worlds_of_those_who_learn_on_live_on_after_a_player_was_paused(duel_store, duel):
    config = lively(Opponents())
    trainer = turns(duel_store, config, duel, 3)
    for _ in range(2):
        lease, _ = claim(duel_store, config)
        duel_store.record_setback(lease, "blue", "blue diverged")
    turns(duel_store, config, duel, 3, trainer)
    points = [p for p in duel_store.curves(LEAGUE, "red") if p.iteration > 2]
    assert len(points) == 10
    assert not any(p.values["begun_anew"] for p in points)


def test_a_dense_reward_that_is_not_finite_is_named_with_the_command_that_tells_more(duel_store, duel, monkeypatch):
    config = settings()
    trainer = turns(duel_store, config, duel, 1)
    ready = trainer.programs.rollout.ready

    def broken(*given):
        def collect(*rest):
            worlds, trajectory = ready(*given)(*rest)
            return worlds, trajectory._replace(shaping=trajectory.shaping.at[0, 0].set(np.nan))

        return collect

    monkeypatch.setattr(trainer.programs.rollout, "ready", broken)
    _, turn = claim(duel_store, config)
    with pytest.raises(PlayerDiverged, match=r"not finite: rewards \(shapings\); `league check [\w-]+` names the term"):
        for _ in trainer.turn(duel_store, turn, lambda: False):
            pass


def test_at_the_second_setback_in_a_row_a_player_is_paused_and_the_other_learns_on(duel_store, duel):
    config = settings()
    turns(duel_store, config, duel, 2)
    for _ in range(2):
        lease, _ = claim(duel_store, config)
        duel_store.record_setback(lease, "red", "red diverged: entropy is nan")
    red = next(p for p in duel_store.players(LEAGUE) if p.name == "red")
    assert red.paused == "red diverged: entropy is nan"
    before = ends(duel_store)
    turns(duel_store, config, duel, 1)
    after = ends(duel_store)
    assert after["red"] == before["red"]
    assert after["blue"][0] > before["blue"][0]
