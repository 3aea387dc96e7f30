"""Seats, seeds and counting of a rating batch; the games here are invented so that each world tells who it is."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from agents.rollout import Games
from league.config import presets
from league.evaluate import Referee
from league.jobs import RatingMatch
from league.policies import add_scripts
from storage.errors import StorageError
from storage.records import League, Match, PairCounts, Snapshot
from storage.store import Store

A, B, C = (Snapshot("tiny", name, f"digest of {name}", "leatherback:20:2") for name in "abc")
TASK = RatingMatch((("a", "b"), ("a", "c")), 5)


@pytest.fixture(scope="module")
def referee():
    config = presets.duel()
    config = replace(config, rating=replace(config.rating, worlds=16, pairings=2, record=False))
    return Referee(config, config.arena.build(engine="c", threads=1), "tiny")


def games(scores: list[float], void: tuple[int, ...] = (), culprits: dict[int, list[int]] | None = None) -> Games:
    """Games in which team 0 of each world scored as given; `culprits` are the teams that broke a world."""
    first = np.array(scores)
    broke = np.zeros((len(first), 2), bool)
    for world, teams in (culprits or {}).items():
        broke[world, teams] = True
    return Games(
        score=np.stack([first, 1 - first], 1), void=np.isin(np.arange(len(first)), void), culprits=broke,
        decisions=np.full(len(first), 7), frames=(), actions={}, reward=np.zeros(0), running=np.zeros(0),
    )  # fmt: skip


def seats(referee: Referee, *pairs):
    return [seating for a, b in pairs for seating in referee.seatings(a, b)]


def test_the_first_episodes_of_each_side_order_are_recorded_by_turns(referee):
    assert referee.each == 4  # two pairings of two groups
    assert referee._first(1) == (0, 8)
    assert referee._first(2) == (0, 4, 8, 12)
    assert referee._first(3) == (0, 4, 1, 8, 12, 9)
    assert sorted(referee._first(100)) == list(range(16))


def test_sides_are_swapped_and_a_seed_pair_starts_and_rolls_alike(referee):
    seating = seats(referee, (A, B), (C, A))
    assert seating == [(A, B), (B, A), (C, A), (A, C)]
    keys = np.asarray(jax.random.key_data(referee._keys(seating, seed=5))).reshape(4, 4, -1)
    assert (keys[0] == keys[1]).all()
    assert (keys[2] == keys[3]).all()
    assert len(np.unique(keys[[0, 2]].reshape(8, -1), axis=0)) == 8


def test_snapshots_of_unlike_rosters_keep_their_sides_and_are_no_seed_pairs(referee, monkeypatch):
    teams = (referee.arena.teams[0], replace(referee.arena.teams[1], agents=referee.arena.teams[1].agents * 2))
    monkeypatch.setattr(referee.arena, "teams", teams)
    other = replace(B, roster=teams[1].roster)
    assert referee.seatings(other, A) == ((A, other), (A, other))
    keys = np.asarray(jax.random.key_data(referee._keys([(A, other)] * 2, seed=5))).reshape(8, -1)
    assert len(np.unique(keys, axis=0)) == 8
    with pytest.raises(StorageError, match="cannot play sumo-1v1"):
        referee.seatings(A, C)


def test_counts_are_for_a_whatever_side_it_played(referee):
    #            A at home        A away           the other pair
    played = games([1, 1, 0.5, 0, 1, 0, 0.5, 0] + [0] * 8)
    match = referee._count(played, 0, A, B, seats(referee, (A, B), (A, C)), TASK, None)
    assert (match.wins, match.draws, match.losses, match.voids) == (4, 2, 2, 0)
    assert (match.side_wins, match.side_draws, match.side_losses) == (2, 1, 1)
    # pair by pair, A's two games: win and loss, win and win, draw and draw, loss and win
    assert match.pairs == PairCounts(ll=0, ld=0, dd_wl=3, dw=0, ww=1)
    assert match.steps == 8 * 7


def test_a_void_game_counts_for_nobody_and_breaks_its_pair(referee):
    played = games([1, 1, 1, 1, 0, 0, 0, 0] + [0] * 8, void=(0, 6))
    match = referee._count(played, 0, A, B, seats(referee, (A, B), (A, C)), TASK, None)
    assert (match.wins, match.losses, match.voids) == (6, 0, 2)
    assert match.pairs == PairCounts(ww=2)


def test_a_void_game_is_put_down_to_the_side_whose_robots_alone_went_bad(referee):
    # in worlds 0-3 A plays team 0, in 4-7 team 1
    culprits = {0: [0], 1: [1], 2: [0, 1], 4: [1], 5: [0]}
    played = games([1.0] * 16, void=(0, 1, 2, 4, 5, 6), culprits=culprits)
    match = referee._count(played, 0, A, B, seats(referee, (A, B), (A, C)), TASK, None)
    assert (match.voids, match.voids_a, match.voids_b) == (6, 2, 2)


def test_scripts_really_play_and_a_batch_with_one_pair_fills_all_its_places(referee, tmp_path):
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ""))
        add_scripts(store, "tiny", referee.arena, ("idle", "centre-holder"))
        task = RatingMatch((("centre-holder", "idle"),), 3)
        matches = referee.play(store, task)
        assert [m.wins + m.draws + m.losses + m.voids for m in matches] == [8, 8]
        assert sum(m.wins for m in matches) >= 14  # the ring shrinks until idle rovers stand outside
        assert referee.seconds > 0.0
        assert matches == referee.play(store, task)
        assert all(isinstance(m, Match) and m.arena == referee.key for m in matches)


def test_a_referee_keeps_no_more_policies_in_memory_than_it_may(tmp_path):
    config = presets.duel()
    config = replace(
        config, rating=replace(config.rating, worlds=16, pairings=2, record=False),
        storage=replace(config.storage, policies=2),
    )  # fmt: skip
    arena = config.arena.build(engine="c", threads=1)
    referee = Referee(config, arena, "tiny")
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ""))
        add_scripts(store, "tiny", arena, None)
        for snapshot in store.snapshots("tiny"):
            referee._thawed(store, snapshot)
        assert len(store.snapshots("tiny")) > 2
        assert len(referee._policies) == 2
