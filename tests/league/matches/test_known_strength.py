"""Scripts of known strength are recovered: real matches, pairs as the league chooses them, and its fit."""

from dataclasses import replace

import numpy as np
import pytest

from league.config import experiment as configuration
from league.matches.evaluator import MatchEvaluator
from league.snapshots.codec import add_scripts
from league.state.jobs import RatingMatch
from matchmaking.match_selection import pairings
from matchmaking.ratings.ladder import ANCHOR_ELO, Ladder, Pool
from storage.records import League
from storage.store import Store
from tests.arenas.odds import STRENGTHS, OddsSettings


@pytest.fixture(scope="module")
def evaluator():
    config = configuration.default("rock-paper-scissors")
    config = replace(config, rating=replace(config.rating, worlds=512, pairings=2, record=False))
    return MatchEvaluator(config, OddsSettings().build(), "cup")


def rated(evaluator: MatchEvaluator, store: Store, seed: int) -> Ladder:
    """A league of the scripts: eight batches, each chosen by what is known after the one before."""
    pool, log = Pool(tuple(STRENGTHS), anchors=("peer",)), []
    for batch in range(8):
        pairs = pairings(Ladder(pool, log), list(STRENGTHS), quota=1024, per_batch=2)
        log += evaluator.play(store, RatingMatch(tuple(pairs), 1000 * seed + batch, record=False))
    return Ladder(pool, log)


def test_scripts_of_known_strength_are_recovered_within_their_intervals(evaluator, tmp_path):
    with Store.open(tmp_path, create=True) as store:
        store.create_league(League("cup", ""))
        add_scripts(store, "cup", evaluator.arena, None)
        ladders = [rated(evaluator, store, seed) for seed in range(20)]
    true = {name: ANCHOR_ELO + elo for name, elo in STRENGTHS.items() if name != "peer"}
    gaps = {n: [la.ratings.elo[la.ratings.index(n)] - elo for la in ladders] for n, elo in true.items()}
    held = [
        bool(la.ratings.low[i] <= elo <= la.ratings.high[i])
        for la in ladders
        for n, elo in true.items()
        for i in (la.ratings.index(n),)
    ]
    assert np.mean(held) >= 0.88  # of 80 intervals of 95 %
    assert all(np.mean(la.ratings.stderr) < 15 for la in ladders)  # Elo: they are not so wide as to say nothing
    assert all(abs(np.mean(each)) < 12 for each in gaps.values())  # and the estimates do not lean to one side
    assert {la.names[int(np.argmax(la.ratings.elo))] for la in ladders} == {"master"}
