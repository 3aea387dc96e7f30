"""Choice of the players that are shown of a long table."""

import numpy as np

from league.queries.ratings.shown_players import prominent
from matchmaking.ratings.ladder import Ladder, Pool
from tests.league.leagues import BLUE, RED, match, snapshot


def test_the_newest_come_first_then_the_best_the_first_and_scripts():
    frozen = [snapshot(p, i) for i in (0, 8, 16, 24) for p in (BLUE, RED)] + [snapshot(None, 0, name="idle")]
    log = [
        match("blue@8", "red@0", 90, 10), match("blue@16", "red@8", 60, 40), match("red@8", "red@0", 60, 40),
        match("blue@16", "red@16", 45, 55), match("blue@24", "red@16", 5, 15), match("blue@16", "blue@0", 60, 40),
        match("red@24", "blue@16", 20, 20), match("idle", "red@0", 10, 60),
    ]  # fmt: skip
    ladder = Ladder(Pool.of(frozen, [BLUE, RED]), log)
    names = [s.name for s in frozen]
    place = [ladder.payoff.index(name) for name in names]
    games = ladder.payoff.games[np.ix_(place, place)]
    order = [names[i] for i in prominent(names, (games > 0).sum(1), ladder, frozen)]
    assert order[:2] == ["blue@24", "red@24"]
    assert order[2:4] == ["blue@8", "red@16"]  # by 90 % against red@0; and the best of red
    assert order[4:7] == ["blue@0", "red@0", "idle"]
    assert order[7:] == ["blue@16", "red@8"]
    few = ["blue@8", "red@0", "blue@0"]
    assert sorted(prominent(few, np.zeros(3), ladder, frozen)[:2]) == [0, 1]  # the newest of those that are there
    assert prominent(few, np.zeros(3), ladder, frozen)[2:] == [2]
