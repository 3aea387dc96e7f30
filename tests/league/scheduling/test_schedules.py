"""Who learns when: all at once, in leapfrog, up a ladder, or against who is frozen; and what the others keep."""

from collections import Counter
from dataclasses import replace

import numpy as np

from league.scheduling import turn_scheduler
from league.snapshots.codec import add_scripts
from league.state.league_state import LeagueState
from league.state.recent_curves import episode_scores
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule, phase_score
from storage.blobs import arrays
from storage.records import League
from storage.store import Store
from tests.league.turns import LEAGUE, claim, ends, history, new_trainer, settings, turns


def test_simultaneously_both_learn_and_are_frozen_on_the_axis(duel_store, duel):
    turns(duel_store, settings(), duel, 4)
    assert sorted((i, player) for player, i, _ in history(duel_store)) == [
        (iteration, player) for iteration in (0, 1, 2, 4) for player in ("blue", "red")
    ]
    assert len({digest for *_, digest in history(duel_store)}) == 8
    frozen = duel_store.snapshots(LEAGUE, "red")
    assert [s.iteration for s in frozen] == [0, 1, 2, 4]
    assert [s.initial for s in frozen] == [True, False, False, False]
    assert [s.parent for s in frozen] == [None, "red@0", "red@1", "red@2"]
    assert duel_store.checkpoint(LEAGUE, "blue").step == 4 * 16 * 8


def test_in_leapfrog_one_learns_while_the_others_actors_stay_byte_for_byte(duel_store, duel):
    turns(duel_store, settings(Schedule("leapfrog", period=2)), duel, 5)
    learnt = {player: i for player, (i, _) in ends(duel_store).items()}
    assert learnt == {"blue": 2, "red": 2}
    of_blue = {s.iteration: s.digest for s in duel_store.snapshots(LEAGUE, "blue")}
    assert set(of_blue) == {0, 1, 2}
    rows = [c for c in duel_store.checkpoints(LEAGUE) if c.player == "blue" and c.iteration == 2]
    states = [arrays.from_bytes(duel_store.blobs.get(c.digest)) for c in rows]
    for state in states:
        np.testing.assert_array_equal(state["actor.0.mean.weight"], states[0]["actor.0.mean.weight"])
    assert len(states) > 1  # its critic went on learning while it rested
    assert any((states[-1]["critic.value.weight"] != states[0]["critic.value.weight"]).ravel())


def test_leapfrog_by_steps_ends_a_turn_with_the_iteration_that_reaches_them_on_this_machines_worlds(duel_store, duel):
    config = settings(Schedule("leapfrog", period_steps=2 * 16 * 8 + 1))
    unset = replace(config, training=replace(config.training, worlds=None))
    learnt, trainer = [], None
    for number in range(9):
        if number in (0, 4):  # in the middle of red's first turn, as after a kill
            trainer = new_trainer(config, duel, duel_store)
        lease, turn = claim(duel_store, unset)
        learnt += [turn.learners] * sum(1 for _ in trainer.turn(duel_store, turn, lambda: False))
        trainer.commit(duel_store, lease, turn)
    assert learnt[:9] == [("blue",)] * 3 + [("red",)] * 3 + [("blue",)] * 3


def test_leapfrog_by_score_hands_over_as_soon_as_it_is_reached_and_freezes_who_stops(duel_store, duel):
    config = settings(Schedule("leapfrog", period=200, until_score=0.02))
    trainer = turns(duel_store, config, duel, 1)
    while not (phase := turn_scheduler.next_turns(config, LeagueState.of(duel_store, LEAGUE)).phases[0]).number:
        assert (phase.learners, phase.until) == (("blue",), {"iterations": 200, "score": 0.02})
        lease, turn = claim(duel_store, config)
        for _ in trainer.turn(duel_store, turn, lambda: False):
            pass
        trainer.commit(duel_store, lease, turn)
    reached = phase.since["blue"]
    assert 0 < reached < 200
    curve = duel_store.curves(LEAGUE, "blue")
    before = episode_scores([p for p in curve if p.iteration < reached])
    assert phase_score(before).low <= 0.02 < phase_score(episode_scores(curve)).low
    assert [s.iteration for s in duel_store.snapshots(LEAGUE, "blue")][-1] == reached
    assert (phase.learners, phase.number) == (("red",), 1)


def test_against_a_victim_one_learns_and_meets_nobody_else(duel_store, duel):
    add_scripts(duel_store, LEAGUE, duel, ("pusher",))
    always = Opponents("fixed", victim="pusher", groups=1)
    config = settings(Schedule("frozen", learner=1), opponents=always)
    turns(duel_store, config, duel, 1)
    lease, turn = claim(duel_store, config)
    assert (turn.learners, turn.past) == (("red",), {"red": (("pusher", ""),)})
    duel_store.release(lease)
    turns(duel_store, config, duel, 2)
    assert {player: i for player, (i, _) in ends(duel_store).items()} == {"blue": 0, "red": 2}
    assert {p.values["past_share"] for p in duel_store.curves(LEAGUE, "red")} == {1.0}
    assert [s.name for s in duel_store.snapshots(LEAGUE, "blue")] == ["blue@0"]


def test_in_ladder_each_phase_is_followed_by_one_copy_however_often_the_league_is_killed(duel_store, duel, tmp_path):
    config = settings(Schedule("ladder", period=2), resting_critics=False)
    turns(duel_store, config, duel, 3)  # to iteration 2, and the copy
    lost = new_trainer(config, duel, duel_store)
    lease, turn = claim(duel_store, config)
    assert sum(1 for _ in lost.turn(duel_store, turn, lambda: False)) == 2
    duel_store.release(lease)  # killed before it was written: to be done again, with its copy
    turns(duel_store, config, duel, 1)
    rows = {(c.player, c.iteration): c for c in duel_store.checkpoints(LEAGUE)}
    assert [(p, i) for p, i in rows if p == "red"] == [("red", 0), ("red", 2), ("red", 4)]
    assert rows["red", 4].step == rows["blue", 4].step == 4 * 16 * 8
    states = {key: arrays.from_bytes(duel_store.blobs.get(c.digest)) for key, c in rows.items()}
    for i in (2, 4):
        for name, weights in states["red", i].items():
            of = states["blue", i] if name.startswith("actor.") else states["red", 0]
            np.testing.assert_array_equal(weights, of[name], err_msg=name)
    frozen = {s.name: s for s in duel_store.snapshots(LEAGUE, "red")}
    assert list(frozen) == ["red@0", "red@2", "red@4"]
    assert frozen["red@4"].digest == duel_store.snapshots(LEAGUE, "blue")[3].digest
    assert frozen["red@4"].parent == "blue@2"
    with Store.open(tmp_path / "other", create=True) as other:
        other.create_league(League(LEAGUE, ""))
        other.add_players(duel_store.players(LEAGUE))
        turns(other, config, duel, 4)
        assert ends(other) == ends(duel_store)


def test_in_ladder_a_player_that_came_further_before_takes_over_the_copy_as_its_newest(duel_store, duel):
    turns(duel_store, settings(Schedule("frozen", learner=1)), duel, 4)  # red at iteration 4
    turns(duel_store, settings(Schedule("ladder", period=1)), duel, 1)
    (blue, of_blue), (red, of_red) = (ends(duel_store)[name] for name in ("blue", "red"))
    assert (blue, red) == (1, 5)
    states = [arrays.from_bytes(duel_store.blobs.get(digest)) for digest in (of_blue, of_red)]
    np.testing.assert_array_equal(*(state["actor.0.mean.weight"] for state in states))
    assert any((states[0]["critic.value.weight"] != states[1]["critic.value.weight"]).ravel())


def test_where_resting_critics_stand_still_a_resting_player_leaves_no_checkpoint(duel_store, duel):
    turns(duel_store, settings(Schedule("leapfrog", period=2), resting_critics=False), duel, 5)
    rows = Counter((c.player, c.iteration) for c in duel_store.checkpoints(LEAGUE))
    assert set(rows.values()) == {1}


def test_a_frozen_opponent_never_changes(duel_store, duel):
    turns(duel_store, settings(Schedule("frozen", learner=1), resting_critics=False), duel, 4)
    assert {player for player, iteration, _ in history(duel_store) if iteration} == {"red"}
