"""Seats, seeds and counting of a rating batch; the games here are invented so that each world tells who it is."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from agents.rollout.rollout import PlayedEpisodes
from arenas.physics.void_causes import Cause
from league.config import presets
from league.matches.evaluator import MatchEvaluator
from league.matches.match_rows import scores_by_seed
from league.snapshots.codec import add_scripts
from league.state.jobs import RatingMatch
from league.state.match_results import results_of
from storage.errors import StorageError
from storage.records import League, Match, PairCounts, Snapshot
from storage.store import Store

A, B, C = (Snapshot("tiny", name, f"digest of {name}", "leatherback:20:2") for name in "abc")
TASK = RatingMatch((("a", "b"), ("a", "c")), 5)


@pytest.fixture(scope="module")
def evaluator():
    config = presets.preset("duel")
    config = replace(config, rating=replace(config.rating, worlds=16, pairings=2, record=False))
    return MatchEvaluator(config, config.arena.build(engine="c", threads=1), "tiny")


def games(
    scores: list[float], void: tuple[int, ...] = (), at_fault: dict[int, list[int]] | None = None
) -> PlayedEpisodes:
    """Games in which team 0 of each world scored as given; `at_fault` are the teams that broke a world."""
    first = np.array(scores)
    broke = np.zeros((len(first), 2), bool)
    for world, teams in (at_fault or {}).items():
        broke[world, teams] = True
    return PlayedEpisodes(
        score=np.stack([first, 1 - first], 1), void=np.isin(np.arange(len(first)), void), at_fault=broke,
        decisions=np.full(len(first), 7), frames=(), actions={}, reward=np.zeros(0), running=np.zeros(0),
    )  # fmt: skip


def seats(evaluator: MatchEvaluator, *pairs):
    return [seating for a, b in pairs for seating in evaluator.side_orders(a, b)]


def test_the_first_episodes_of_each_side_order_are_recorded_by_turns(evaluator):
    assert evaluator.each == 4  # two pairings of two groups
    assert evaluator._first(1) == (0, 8)
    assert evaluator._first(2) == (0, 4, 8, 12)
    assert evaluator._first(3) == (0, 4, 1, 8, 12, 9)
    assert sorted(evaluator._first(100)) == list(range(16))


def test_sides_are_swapped_and_a_seed_pair_starts_and_rolls_alike(evaluator):
    seating = seats(evaluator, (A, B), (C, A))
    assert seating == [(A, B), (B, A), (C, A), (A, C)]
    keys = np.asarray(jax.random.key_data(evaluator._keys(seating, seed=5))).reshape(4, 4, -1)
    assert (keys[0] == keys[1]).all()
    assert (keys[2] == keys[3]).all()
    assert len(np.unique(keys[[0, 2]].reshape(8, -1), axis=0)) == 8


def test_snapshots_of_unlike_rosters_keep_their_sides_and_are_no_seed_pairs(evaluator, monkeypatch):
    teams = (evaluator.arena.teams[0], replace(evaluator.arena.teams[1], agents=evaluator.arena.teams[1].agents * 2))
    monkeypatch.setattr(evaluator.arena, "teams", teams)
    other = replace(B, roster=teams[1].roster)
    assert evaluator.side_orders(other, A) == ((A, other), (A, other))
    keys = np.asarray(jax.random.key_data(evaluator._keys([(A, other)] * 2, seed=5))).reshape(8, -1)
    assert len(np.unique(keys, axis=0)) == 8
    with pytest.raises(StorageError, match="cannot play sumo-1v1"):
        evaluator.side_orders(A, C)


def test_counts_are_for_a_whatever_side_it_played(evaluator):
    #            A at home        A away           the other pair
    played = games([1, 1, 0.5, 0, 1, 0, 0.5, 0] + [0] * 8)
    match = evaluator.pair_match(played, 0, A, B, seats(evaluator, (A, B), (A, C)), TASK, None)
    assert (match.wins, match.draws, match.losses, match.voids) == (4, 2, 2, 0)
    assert (match.side_wins, match.side_draws, match.side_losses) == (2, 1, 1)
    # pair by pair, A's two games: win and loss, win and win, draw and draw, loss and win
    assert match.pairs == PairCounts(ll=0, ld=0, dd_wl=3, dw=0, ww=1)
    assert match.steps == 8 * 7


def test_results_at_home_are_those_of_a_as_the_first_team(evaluator):
    played = games([1, 1, 1, 0.5, 1, 0.5, 0, 0.5] + [0] * 8)  # at home, then away, where its score is the rest
    match = evaluator.pair_match(played, 0, A, B, seats(evaluator, (A, B), (A, C)), TASK, None)
    assert (match.wins, match.draws, match.losses) == (4, 3, 1)
    assert (match.side_wins, match.side_draws, match.side_losses) == (3, 1, 0)


def test_a_void_game_counts_for_nobody_and_breaks_its_pair(evaluator):
    played = games([1, 1, 1, 1, 0, 0, 0, 0] + [0] * 8, void=(0, 6))
    match = evaluator.pair_match(played, 0, A, B, seats(evaluator, (A, B), (A, C)), TASK, None)
    assert (match.wins, match.losses, match.voids) == (6, 0, 2)
    assert match.pairs == PairCounts(ww=2)


def test_a_void_game_is_put_down_to_the_side_whose_robots_alone_went_bad(evaluator):
    # in worlds 0-3 A plays team 0, in 4-7 team 1
    at_fault = {0: [0], 1: [1], 2: [0, 1], 4: [1], 5: [0]}
    played = games([1.0] * 16, void=(0, 1, 2, 4, 5, 6), at_fault=at_fault)
    match = evaluator.pair_match(played, 0, A, B, seats(evaluator, (A, B), (A, C)), TASK, None)
    assert (match.voids, match.voids_a, match.voids_b) == (6, 2, 2)


def test_why_games_were_void_goes_into_the_row_and_of_its_own_worlds_alone(evaluator):
    causes = np.zeros(16, np.uint8)
    causes[[1, 4]] = Cause.PAIRS, Cause.PAIRS | Cause.ROWS
    causes[9] = Cause.NUMBERS
    played = games([1.0] * 16, void=(1, 4, 9))._replace(causes=causes)
    both = seats(evaluator, (A, B), (A, C))
    rows = [evaluator.pair_match(played, i, A, B, both, TASK, None) for i in (0, 1)]
    assert [row.causes for row in rows] == [Cause.PAIRS | Cause.ROWS, Cause.NUMBERS]


@pytest.mark.slow
def test_scripts_really_play_and_a_batch_with_one_pair_fills_all_its_places(evaluator, tmp_path):
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ""))
        add_scripts(store, "tiny", evaluator.arena, ("idle", "centre-holder"))
        task = RatingMatch((("centre-holder", "idle"),), 3)
        matches = evaluator.play(store, task)
        assert [m.wins + m.draws + m.losses + m.voids for m in matches] == [8, 8]
        assert sum(m.wins for m in matches) >= 14  # the ring shrinks until idle rovers stand outside
        assert evaluator.seconds > 0.0
        assert sum(m.seconds for m in matches) == pytest.approx(evaluator.seconds)
        assert [m.due for m in matches] == [None, None]
        again = evaluator.play(store, replace(task, due=12.5))  # the same games at another time
        assert [replace(m, seconds=0.0) for m in matches] == [replace(m, seconds=0.0, due=None) for m in again]
        assert [m.due for m in again] == [12.5, 12.5]
        assert all(isinstance(m, Match) and m.arena == evaluator.key for m in matches)


def test_pairs_of_a_manager_whose_device_has_more_places_are_all_played(evaluator, tmp_path):
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ""))
        add_scripts(store, "tiny", evaluator.arena, ("idle", "centre-holder", "pusher"))
        pairs = (("centre-holder", "idle"), ("pusher", "idle"), ("centre-holder", "pusher"))
        matches = evaluator.play(store, RatingMatch(pairs, 3, record=False))
        assert [(m.a, m.b) for m in matches] == [*pairs, pairs[2]]
        assert all(m.wins + m.draws + m.losses + m.voids == 8 for m in matches)


def test_a_referee_keeps_no_more_policies_in_memory_than_it_may(tmp_path):
    config = presets.preset("duel")
    config = replace(
        config, rating=replace(config.rating, worlds=16, pairings=2, record=False),
        storage=replace(config.storage, cached_policies=2),
    )  # fmt: skip
    arena = config.arena.build(engine="c", threads=1)
    evaluator = MatchEvaluator(config, arena, "tiny")
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ""))
        add_scripts(store, "tiny", arena, None)
        for snapshot in store.snapshots("tiny"):
            evaluator._load(store, snapshot)
        assert len(store.snapshots("tiny")) > 2
        assert len(evaluator._policies) == 2


# Three teams ----------------------------------------------------------------------------------------------------------

P, Q, R = (Snapshot("tiny", name, f"digest of {name}", "puck:22:2") for name in "pqr")


@pytest.fixture(scope="module")
def three():
    config = presets.preset("tag")
    config = replace(config, rating=replace(config.rating, worlds=12, pairings=2, record=False))
    return MatchEvaluator(config, config.arena.build(engine="c", threads=1), "tiny")


def test_a_lineup_of_three_plays_in_its_three_rotations_from_the_same_seeds(three):
    assert (three.groups, three.each) == (3, 2)
    seating = three.side_orders(P, Q, R)
    assert seating == ((P, Q, R), (Q, R, P), (R, P, Q))
    twice = [*seating, *three.side_orders(P, P, P)]
    keys = np.asarray(jax.random.key_data(three._keys(twice, seed=5))).reshape(6, 2, -1)
    assert (keys[0] == keys[1]).all()
    assert (keys[0] == keys[2]).all()
    assert len(np.unique(keys[[0, 3, 4, 5]].reshape(8, -1), axis=0)) == 8  # equal seatings repeat no seed
    with pytest.raises(StorageError, match=r"p \(puck:22:2\) and q \(puck:22:2\) and a \(leatherback:20:2\) cannot"):
        three.side_orders(P, Q, A)


def test_worlds_have_the_same_start_where_they_have_the_same_key(three):
    seats = [*three.side_orders(P, Q, R), *three.side_orders(P, P, P), *three.side_orders(P, Q, Q)]
    keys = np.asarray(jax.random.key_data(three._keys(seats, seed=5))).reshape(18, -1)
    starts = three.starts(seats)
    same = (keys[:, None] == keys).all(-1)
    assert (same == (starts[:, None] == starts)).all()
    assert same.sum() == 2 * 9 + 6 + 2 * 9  # two seeds in three rotations, and six of a lineup that has one


def test_scores_of_played_episodes_count_what_shares_a_seed_once(three):
    score = np.zeros((12, 3))
    score[:6] = [[3, 0, 0]] * 2 + [[0, 0, 3]] * 2 + [[0, 3, 0]] * 2  # p is ahead of both in all three rotations
    played = PlayedEpisodes(
        score=score, void=np.zeros(12, bool), at_fault=np.zeros((12, 3), bool), decisions=np.arange(12), frames=(),
        actions={}, reward=np.zeros(0), running=np.zeros(0),
    )  # fmt: skip
    seats = three.side_orders(P, Q, R)
    worlds, names, starts = np.arange(6), [[s.name for s in each] for each in seats], three.starts([*seats, *seats])

    def found(*chosen: int) -> dict:
        at = np.array(chosen)
        return scores_by_seed(played, at, starts[at], names, at // three.each)

    z2 = 1.959964**2
    assert {name: (each.score, each.games) for name, each in found(*worlds).items()} == {
        "p": (1.0, 12), "q": (0.25, 12), "r": (0.25, 12),
    }  # fmt: skip
    assert found(*worlds)["p"].low == pytest.approx(2 / (2 + z2))  # two seeds, all won
    assert found(0, 2, 4)["p"].low == pytest.approx(1 / (1 + z2))
    assert found(0, 3)["p"].low == pytest.approx(2 / (2 + z2))  # of different seeds
    played.void[[0, 2, 4]] = True
    assert (found(*worlds)["p"].games, found(*worlds)["p"].low) == (6, pytest.approx(1 / (1 + z2)))
    assert found(0, 2, 4) == {}


def test_snapshots_of_unlike_rosters_take_the_teams_that_they_fit(three, monkeypatch):
    own = three.arena.teams
    tank = replace(own[2], agents=own[2].agents * 2)
    monkeypatch.setattr(three.arena, "teams", (own[0], tank, own[2]))
    big = replace(R, roster=tank.roster)
    assert three.side_orders(P, Q, big) == ((Q, big, P),) * 3


def test_each_seating_is_a_row_of_its_own_with_the_ranks_of_its_teams(three, tmp_path):
    score = np.zeros((12, 3))
    score[:6] = [[-1, -2, -3], [0, 0, -9], [-3, -1, -2], [-5, -5, -5], [-2, -7, -2], [-1, -2, -3]]
    void, at_fault = np.zeros(12, bool), np.zeros((12, 3), bool)
    void[[2, 5]], at_fault[2, 1], at_fault[5, :2] = True, True, True
    played = PlayedEpisodes(
        score=score, void=void, at_fault=at_fault, decisions=np.arange(12), frames=(), actions={},
        reward=np.zeros(0), running=np.zeros(0),
    )  # fmt: skip
    seating = [*three.side_orders(P, Q, R), *three.side_orders(P, Q, R)]
    task = RatingMatch((("p", "q", "r"),), 5, due=7.0)
    with Store.open(tmp_path / "store", create=True) as store:
        rows = three.ranked_matches(store, played, 0, seating, task)
    assert [row.snapshots for row in rows] == [("p", "q", "r"), ("q", "r", "p"), ("r", "p", "q")]
    assert [row.rankings for row in rows] == [{(1, 2, 3): 1, (1, 1, 3): 1}, {(1, 1, 1): 1}, {(1, 3, 1): 1}]
    assert [(row.voids, row.voids_by_team) for row in rows] == [(0, (0, 0, 0)), (1, (0, 1, 0)), (1, (0, 0, 0))]
    assert [(row.steps, row.seed, row.due) for row in rows] == [(1, 5, 7.0), (5, 5, 7.0), (9, 5, 7.0)]
    assert [row.seed_clusters for row in rows] == [{}, {}, {}]  # each of the two seeds has a void


def test_the_first_seating_has_the_rankings_of_each_seed_as_ranks_of_its_snapshots(three, tmp_path):
    score = np.zeros((12, 3))
    score[6:] = [[0, -1, -2], [0, -1, -2], [0, -1, -2], [-1, -1, 0], [0, -1, -2], [-3, 0, 0]]
    void = np.zeros(12, bool)
    played = PlayedEpisodes(
        score=score, void=void, at_fault=np.zeros((12, 3), bool), decisions=np.arange(12), frames=(), actions={},
        reward=np.zeros(0), running=np.zeros(0),
    )  # fmt: skip
    seating, task = [*three.side_orders(P, P, P), *three.side_orders(P, Q, R)], RatingMatch((("p", "q", "r"),), 5)
    with Store.open(tmp_path / "store", create=True) as store:
        rows = three.ranked_matches(store, played, 1, seating, task)
        (alone,) = three.ranked_matches(store, played, 0, seating, task)
    # Seed 0: 1, 2, 3 in each seating. Seed 1: first 1, 2, 3; then q, r tie behind p; then r behind p, q.
    rotated = ((1, 2, 3), (3, 1, 2), (2, 3, 1))
    assert [row.seed_clusters for row in rows] == [{rotated: 1, ((1, 2, 3), (1, 2, 2), (1, 1, 3)): 1}, {}, {}]
    assert alone.seed_clusters == {}
    void[9] = True
    with Store.open(tmp_path / "store") as store:
        rows = three.ranked_matches(store, played, 1, seating, task)
    assert [row.seed_clusters for row in rows] == [{rotated: 1}, {}, {}]


def test_scripts_of_three_teams_play_and_the_better_one_is_ahead(three, tmp_path):
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ""))
        add_scripts(store, "tiny", three.arena, ("idle", "chaser", "tagger"))
        matches = three.play(store, RatingMatch((("tagger", "idle", "chaser"),), 3))
    assert len(matches) == 6  # a single lineup fills both places, in three rotations each
    assert sum(match.episodes for match in matches) == 12
    wins, draws, losses = np.sum([results_of(match, "tagger") for match in matches], axis=0)
    assert wins + draws + losses == 24
    assert wins > losses
