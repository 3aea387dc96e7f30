"""Turns of a small league in one process: who learns, what is written, what a restart changes, what goes wrong."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from agents.settings import Architecture
from league import plan
from league.config import experiment as configuration
from league.config import presets
from league.config.experiment import PlayerSettings
from league.jobs import decode
from league.policies import add_scripts
from league.standing import Standing, episode_scores
from league.train import PlayerDiverged, Trainer
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule, turn_score
from storage import arrays
from storage.errors import LeaseLost
from storage.records import League, Player
from storage.store import Store

LEAGUE = "duel"


def settings(schedule=Schedule(), opponents=Opponents(), **changes):  # noqa: B008  (frozen)
    config = presets.duel()
    training = replace(config.training, worlds=16, rollout=8, turn=4, schedule=schedule, opponents=opponents, **changes)
    return replace(config, deterministic=True, training=training, budget=configuration.Budget(steps=10**9))


@pytest.fixture(scope="module")
def arena():
    return presets.duel().arena.build(engine="c")


def new_store(place, arena):
    store = Store.open(place, create=True)
    store.create_league(League(LEAGUE, ""))
    store.add_players([Player(LEAGUE, t.name, i, "main", t.roster) for i, t in enumerate(arena.teams)])
    return store


@pytest.fixture
def store(tmp_path, arena):
    with new_store(tmp_path / "store", arena) as store:
        yield store


def claim(store, config):
    planned = plan.next_turns(config, Standing.of(store, LEAGUE))
    store.queue(planned.jobs, planned.phases)
    claimed = store.claim(LEAGUE, ["train"], "me", 60)
    assert claimed is not None
    lease, job = claimed
    return lease, decode(job)


def turns(store, config, arena, count):
    """Let one worker do the next turns as planned; the trainer afterwards."""
    trainer = Trainer(config, arena, store.players(LEAGUE), config.training.worlds)
    for _ in range(count):
        lease, turn = claim(store, config)
        for _ in trainer.turn(store, turn, lambda: False):
            pass
        trainer.commit(store, lease, turn)
    return trainer


def history(store):
    return [(c.player, c.iteration, c.digest) for c in store.checkpoints(LEAGUE)]


def ends(store):
    return {name: (c.iteration, c.digest) for name, c in store.newest_checkpoints(LEAGUE).items()}


@pytest.mark.parametrize("kind", ["simultaneous", "leapfrog"])  # in leapfrog the critic of who rests learns beside
def test_that_players_learn_at_the_same_time_changes_no_byte(store, arena, tmp_path, monkeypatch, kind):
    config = settings(Schedule(kind, period=1), device="cpu")
    assert turns(store, config, arena, 2).squad.each is not map
    monkeypatch.setattr("league.squad.beside", lambda learners: map)
    with new_store(tmp_path / "other", arena) as other:
        turns(other, config, arena, 2)
        assert ends(other) == ends(store)


def test_simultaneously_both_learn_and_are_frozen_on_the_axis(store, arena):
    turns(store, settings(), arena, 4)
    assert sorted((i, player) for player, i, _ in history(store)) == [
        (iteration, player) for iteration in (0, 1, 2, 4) for player in ("blue", "red")
    ]
    assert len({digest for *_, digest in history(store)}) == 8
    frozen = store.snapshots(LEAGUE, "red")
    assert [s.iteration for s in frozen] == [0, 1, 2, 4]
    assert [s.initial for s in frozen] == [True, False, False, False]
    assert [s.parent for s in frozen] == [None, "red@0", "red@1", "red@2"]
    assert store.checkpoint(LEAGUE, "blue").step == 4 * 16 * 8


def test_every_iteration_leaves_a_point_of_the_learning_curve(store, arena):
    turns(store, settings(), arena, 4)
    points = store.curves(LEAGUE, "blue")
    assert [p.iteration for p in points] == [1, 2, 3, 4]
    wanted = {"entropy", "ratio", "policy_loss", "value_loss", "explained_variance", "steps_per_second", "past_share"}
    assert wanted <= set(points[0].values)
    assert points[-1].step == store.checkpoint(LEAGUE, "blue").step


@pytest.mark.slow
def test_variants_of_the_learner_go_on_in_another_process(store, arena):
    config = settings(opponents=Opponents("uniform", past=0.5, groups=2))
    learner = replace(
        config.learner, architecture=Architecture((8,), squash=2.0, state_std=True), critic_input="all",
        share_actors=True, decay_steps=800, kl_stop=0.05,
    )  # fmt: skip
    config = replace(config, learner=learner)
    turns(store, config, arena, 2)
    trainer = turns(store, config, arena, 1)  # which knows of the first two what the store says
    assert trainer.squad.learners["blue"].critic_learners[0].network.trunk.observation_mean.shape == (40,)
    kept, points = store.checkpoint(LEAGUE, "blue"), store.curves(LEAGUE, "blue")
    state = arrays.from_bytes(store.blobs.get(kept.digest))
    assert kept.iteration == len(points) == 2
    assert 0 < state["steps"] < kept.step  # it learns from its own worlds alone, not from red's against the past
    assert [p.values["lr"] for p in points] == pytest.approx([1e-3, 1e-3 * (1 - state["steps"] / 2 / 800)])


@pytest.mark.slow
@pytest.mark.parametrize(("sees", "size", "units"), [("privileged", 68, 0), ("same", 42, 0), ("privileged", 68, 5)])
def test_critics_that_see_more_go_on_in_another_process_to_the_same_bytes(store, arena, tmp_path, sees, size, units):
    """Also with past opponents for each, and one that rests: what a critic knows is in its player's checkpoint."""
    config = settings(Schedule("leapfrog", period=1), opponents=Opponents("uniform", past=0.5, groups=2))
    architecture = replace(config.learner.architecture, recurrent=units)
    config = replace(config, learner=replace(config.learner, critic_input=sees, chunk=4, architecture=architecture))
    turns(store, config, arena, 2)
    trainer = turns(store, config, arena, 2)  # as after a kill
    assert trainer.squad.learners["blue"].critic_learners[0].network.trunk.observation_mean.shape == (size,)
    assert all(-1e3 < p.values["value_loss"] < 1e3 for p in store.curves(LEAGUE))
    with new_store(tmp_path / "other", arena) as other:
        turns(other, config, arena, 4)
        assert ends(other) == ends(store)


def test_in_leapfrog_one_learns_while_the_others_actors_stay_byte_for_byte(store, arena):
    turns(store, settings(Schedule("leapfrog", period=2)), arena, 5)
    learnt = {player: i for player, (i, _) in ends(store).items()}
    assert learnt == {"blue": 2, "red": 2}
    of_blue = {s.iteration: s.digest for s in store.snapshots(LEAGUE, "blue")}
    assert set(of_blue) == {0, 1, 2}
    rows = [c for c in store.checkpoints(LEAGUE) if c.player == "blue" and c.iteration == 2]
    states = [arrays.from_bytes(store.blobs.get(c.digest)) for c in rows]
    for state in states:
        np.testing.assert_array_equal(state["actor.0.mean.weight"], states[0]["actor.0.mean.weight"])
    assert len(states) > 1  # its critic went on learning while it rested
    assert any((states[-1]["critic.value.weight"] != states[0]["critic.value.weight"]).ravel())


def test_leapfrog_by_steps_ends_a_turn_with_the_iteration_that_reaches_them_on_this_machines_worlds(store, arena):
    config = settings(Schedule("leapfrog", period_steps=2 * 16 * 8 + 1))
    unset = replace(config, training=replace(config.training, worlds=None))
    learnt, trainer = [], None
    for number in range(9):
        if number in (0, 4):  # in the middle of red's first turn, as after a kill
            trainer = Trainer(config, arena, store.players(LEAGUE), 16)
        lease, turn = claim(store, unset)
        learnt += [turn.learners] * sum(1 for _ in trainer.turn(store, turn, lambda: False))
        trainer.commit(store, lease, turn)
    assert learnt[:9] == [("blue",)] * 3 + [("red",)] * 3 + [("blue",)] * 3


def test_leapfrog_by_score_hands_over_as_soon_as_it_is_reached_and_freezes_who_stops(store, arena):
    config = settings(Schedule("leapfrog", period=200, until_score=0.02))
    trainer = turns(store, config, arena, 1)
    while not (phase := plan.next_turns(config, Standing.of(store, LEAGUE)).phases[0]).number:
        assert (phase.learners, phase.until) == (("blue",), {"iterations": 200, "score": 0.02})
        lease, turn = claim(store, config)
        for _ in trainer.turn(store, turn, lambda: False):
            pass
        trainer.commit(store, lease, turn)
    reached = phase.since["blue"]
    assert 0 < reached < 200
    curve = store.curves(LEAGUE, "blue")
    before = episode_scores([p for p in curve if p.iteration < reached])
    assert turn_score(before).low <= 0.02 < turn_score(episode_scores(curve)).low
    assert [s.iteration for s in store.snapshots(LEAGUE, "blue")][-1] == reached
    assert (phase.learners, phase.number) == (("red",), 1)


def test_against_a_victim_one_learns_and_meets_nobody_else(store, arena):
    add_scripts(store, LEAGUE, arena, ("pusher",))
    always = Opponents("fixed", victim="pusher", groups=1)
    config = settings(Schedule("frozen", learner=1), opponents=always)
    turns(store, config, arena, 1)
    lease, turn = claim(store, config)
    assert (turn.learners, turn.past) == (("red",), {"red": (("pusher", ""),)})
    store.release(lease)
    turns(store, config, arena, 2)
    assert {player: i for player, (i, _) in ends(store).items()} == {"blue": 0, "red": 2}
    assert {p.values["past_share"] for p in store.curves(LEAGUE, "red")} == {1.0}
    assert [s.name for s in store.snapshots(LEAGUE, "blue")] == ["blue@0"]


def test_in_ladder_each_phase_is_followed_by_one_copy_however_often_the_league_is_killed(store, arena, tmp_path):
    config = settings(Schedule("ladder", period=2), resting_critics=False)
    turns(store, config, arena, 3)  # to iteration 2, and the copy
    lost = Trainer(config, arena, store.players(LEAGUE), 16)
    lease, turn = claim(store, config)
    assert sum(1 for _ in lost.turn(store, turn, lambda: False)) == 2
    store.release(lease)  # killed before it was written: to be done again, with its copy
    turns(store, config, arena, 1)
    rows = {(c.player, c.iteration): c for c in store.checkpoints(LEAGUE)}
    assert [(p, i) for p, i in rows if p == "red"] == [("red", 0), ("red", 2), ("red", 4)]
    assert rows["red", 4].step == rows["blue", 4].step == 4 * 16 * 8
    states = {key: arrays.from_bytes(store.blobs.get(c.digest)) for key, c in rows.items()}
    for i in (2, 4):
        for name, weights in states["red", i].items():
            of = states["blue", i] if name.startswith("actor.") else states["red", 0]
            np.testing.assert_array_equal(weights, of[name], err_msg=name)
    frozen = {s.name: s for s in store.snapshots(LEAGUE, "red")}
    assert list(frozen) == ["red@0", "red@2", "red@4"]
    assert frozen["red@4"].digest == store.snapshots(LEAGUE, "blue")[3].digest
    assert frozen["red@4"].parent == "blue@2"
    with Store.open(tmp_path / "other", create=True) as other:
        other.create_league(League(LEAGUE, ""))
        other.add_players(store.players(LEAGUE))
        turns(other, config, arena, 4)
        assert ends(other) == ends(store)


def test_in_ladder_a_player_that_came_further_before_takes_over_the_copy_as_its_newest(store, arena):
    turns(store, settings(Schedule("frozen", learner=1)), arena, 4)  # red at iteration 4
    turns(store, settings(Schedule("ladder", period=1)), arena, 1)
    (blue, of_blue), (red, of_red) = (ends(store)[name] for name in ("blue", "red"))
    assert (blue, red) == (1, 5)
    states = [arrays.from_bytes(store.blobs.get(digest)) for digest in (of_blue, of_red)]
    np.testing.assert_array_equal(*(state["actor.0.mean.weight"] for state in states))
    assert any((states[0]["critic.value.weight"] != states[1]["critic.value.weight"]).ravel())


def test_where_resting_critics_stand_still_a_resting_player_leaves_no_checkpoint(store, arena):
    turns(store, settings(Schedule("leapfrog", period=2), resting_critics=False), arena, 5)
    rows = Counter((c.player, c.iteration) for c in store.checkpoints(LEAGUE))
    assert set(rows.values()) == {1}


def test_a_frozen_opponent_never_changes(store, arena):
    turns(store, settings(Schedule("frozen", learner=1), resting_critics=False), arena, 4)
    assert {player for player, iteration, _ in history(store) if iteration} == {"red"}


def test_past_opponents_are_met_by_learners_that_learn_on(store, arena):
    config = settings(opponents=Opponents("uniform", past=0.5, groups=2))
    turns(store, config, arena, 4)
    assert store.checkpoint(LEAGUE, "blue").iteration == 4
    assert store.curves(LEAGUE, "blue")[-1].values["past_share"] == 0.5
    # three groups share 16 worlds: five each, so that 15 are simulated
    assert store.checkpoint(LEAGUE, "blue").step == 4 * 15 * 8


def test_worlds_whose_opponent_changed_begin_anew_and_it_is_counted(store, arena):
    config = replace(
        settings(opponents=Opponents("uniform", past=0.5, groups=4)), deterministic=False,
        budget=configuration.Budget(),
    )  # fmt: skip
    trainer = turns(store, config, arena, 6)  # to iterations 1, 2, 4, 8, 12
    share = {p.iteration: p.values["begun_anew"] for p in store.curves(LEAGUE, "blue")}
    assert any(0 < s < 1 for s in share.values())  # past groups, not those of present opponents
    assert {share[i] for i in (6, 7, 8, 10, 11, 12)} == {0}  # once a turn, at its start
    ((worlds, seats),) = trainer._worlds.values()
    assert len(seats) == 6
    assert len(worlds.age) == 12


def test_a_worker_that_takes_over_goes_on_to_the_same_bytes(store, arena, tmp_path):
    turns(store, settings(), arena, 3)
    turns(store, settings(), arena, 2)  # a fresh trainer, as after a kill
    with Store.open(tmp_path / "other", create=True) as other:
        other.create_league(League(LEAGUE, ""))
        other.add_players(store.players(LEAGUE))
        turns(other, settings(), arena, 5)
        assert ends(other) == ends(store)


def test_a_spent_budget_freezes_what_was_learnt_last(store, arena):
    config = replace(settings(), budget=configuration.Budget(steps=5 * 16 * 8))
    turns(store, config, arena, 5)
    assert [s.iteration for s in store.snapshots(LEAGUE, "blue")] == [0, 1, 2, 4, 5]
    assert not plan.next_turns(config, Standing.of(store, LEAGUE)).jobs


def test_a_turn_from_checkpoints_that_are_no_longer_the_newest_is_refused(store, arena):
    config = settings()
    turns(store, config, arena, 2)
    slow = Trainer(config, arena, store.players(LEAGUE), 16)
    lease, turn = claim(store, config)
    for _ in slow.turn(store, turn, lambda: False):
        pass
    store.release(lease)  # taken for dead: somebody else does the turn
    turns(store, config, arena, 1)
    after = ends(store)
    store.queue([_again(turn)])
    again, _ = store.claim(LEAGUE, ["train"], "slow", 60)
    with pytest.raises(LeaseLost):
        slow.commit(store, again, turn)
    assert ends(store) == after


def _again(turn):
    from league.jobs import encode

    return encode(LEAGUE, turn, "the same turn under another key")


def test_players_of_other_network_widths_learn_and_meet_in_one_batch(store, arena):
    config = replace(
        settings(opponents=Opponents("uniform", past=0.5, groups=4)),
        players=(
            PlayerSettings("blue"), PlayerSettings("red"),
            PlayerSettings("blue", "blue-wide", group="2", hidden=(32, 32)),
            PlayerSettings("red", "red-wide", group="2", hidden=(32, 32)),
        ),
    )  # fmt: skip
    wide = [Player(LEAGUE, f"{t.name}-wide", i, "main", t.roster, "2") for i, t in enumerate(arena.teams)]
    store.add_players(wide)
    trainer = turns(store, config, arena, 8)
    assert {name: i for name, (i, _) in ends(store).items()} == dict.fromkeys(ends(store), 4)
    widths = {
        name: learner.state()["actor.0.trunk.hidden.0.weight"].shape[0]
        for name, learner in trainer.squad.learners.items()
    }
    assert widths == {"blue": 64, "red": 64, "blue-wide": 32, "red-wide": 32}
    first = {s.player: s.digest for s in store.snapshots(LEAGUE) if s.initial}
    assert len(set(first.values())) == 4


def test_a_nan_in_an_actor_is_noticed_at_once_and_nothing_is_written(store, arena):
    config = settings()
    trainer = turns(store, config, arena, 3)
    before = ends(store)
    actor = trainer.squad.learners["red"].actors[0]
    actor.mean.bias.data[:] = float("nan")
    lease, turn = claim(store, config)
    with pytest.raises(PlayerDiverged, match="red diverged"):
        for _ in trainer.turn(store, turn, lambda: False):
            pass
    assert ends(store) == before
    store.setback(lease, "red", "red diverged")
    assert next(p for p in store.players(LEAGUE) if p.name == "red").setbacks == 1
    turns(store, config, arena, 1)  # back at the checkpoint, other dice, and on
    assert ends(store)["red"][0] > before["red"][0]
    assert next(p for p in store.players(LEAGUE) if p.name == "red").setbacks == 0


def test_at_the_second_setback_in_a_row_a_player_is_paused_and_the_other_learns_on(store, arena):
    config = settings()
    turns(store, config, arena, 2)
    for _ in range(2):
        lease, _ = claim(store, config)
        store.setback(lease, "red", "red diverged: entropy is nan")
    red = next(p for p in store.players(LEAGUE) if p.name == "red")
    assert red.paused == "red diverged: entropy is nan"
    before = ends(store)
    turns(store, config, arena, 1)
    after = ends(store)
    assert after["red"] == before["red"]
    assert after["blue"][0] > before["blue"][0]
