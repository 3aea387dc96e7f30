"""Text that `league rate --store` prints about the ratings when it ends."""

from league.commands.analyse.rate_store import least_sure
from league.matches.store_rating import Done
from matchmaking.ratings.ladder import Ladder
from tests.league.leagues import BLUE, RED, match, snapshot


def test_a_rating_that_is_not_known_yet_is_named():
    pool = [snapshot(player, i) for i in (0, 1, 4) for player in (BLUE, RED)]
    names, initial = [s.name for s in pool], [s.name for s in pool if s.initial]
    known = [match("blue@1", "blue@0", 300, 100), match("red@1", "red@0", 300, 100), match("blue@1", "red@1", 50, 50)]
    some = Ladder(names, [*known, match("blue@4", "blue@1", 200, 100)], initial)
    assert least_sure(Done(900, None, some), pool) == "the rating of red@4 is not known yet"
    assert least_sure(Done(800, None, Ladder(names, known, initial)), pool) == (
        "the rating of blue@4 and 1 more is not known yet"
    )
    assert least_sure(Done(900, 80.0, some), pool) == "the widest interval is ±40 Elo"
