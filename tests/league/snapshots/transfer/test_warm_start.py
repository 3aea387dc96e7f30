"""Which agent of earlier leagues each player goes on from, where sides are unlike and where they are not."""

from dataclasses import replace

from league.snapshots.transfer.warm_start import Source, warm_starts
from storage.records import Player

RUNNER, BLOCKER, PLAIN = "human:9:2@runner", "human:9:2@blocker", "human:9:2"


def players(league: str, *rosters: str) -> list[Player]:
    return [Player(league, f"p{n}", n, "main", roster) for n, roster in enumerate(rosters)]


def sources(here: list[Player], *before: list[Player]) -> list[tuple[Source | None, ...]]:
    return [start.actors for start in warm_starts(here, before).values()]


def test_each_side_goes_on_from_its_own_among_policies_that_are_leagues_of_one():
    runner, blocker = players("runner.safetensors", RUNNER), players("blocker.safetensors", BLOCKER)
    here = players("cup", RUNNER, BLOCKER, BLOCKER)
    own = [(Source("runner.safetensors", "p0", 0),), *[(Source("blocker.safetensors", "p0", 0),)] * 2]
    assert sources(here, runner, blocker) == own
    assert sources(here, blocker, runner) == own


def test_each_side_of_several_players_goes_on_from_its_own_in_turn():
    before, here = players("old", RUNNER, BLOCKER, BLOCKER), players("new", *[RUNNER] * 2, *[BLOCKER] * 3)
    assert [found[0].player for found in sources(here, before) if found[0]] == ["p0", "p0", "p1", "p2", "p1"]


def test_a_player_that_never_learns_hands_on_only_where_nobody_else_can():
    kicker, keeper = players("drill", RUNNER, BLOCKER)
    fixed, here = replace(keeper, role="fixed"), players("game", PLAIN, PLAIN)
    assert sources(here, [kicker, fixed]) == [(Source("drill", "p0", 0),)] * 2
    assert sources(here, [fixed]) == [(Source("drill", "p1", 0),)] * 2


def test_a_player_with_a_start_of_its_own_leaves_the_others_theirs():
    before, mine, here = players("old", RUNNER, RUNNER), players("mine", RUNNER), players("new", *[RUNNER] * 4)
    found = warm_starts(here, [before], own={"p1": [mine], "p2": []})
    assert [start.actors[0] for start in found.values()] == [
        Source("old", "p0", 0), Source("mine", "p0", 0), None, Source("old", "p1", 0),
    ]  # fmt: skip
    assert [start.critic for start in found.values()] == [("old", "p0"), ("mine", "p0"), None, ("old", "p1")]


def test_a_side_that_nobody_played_goes_on_from_another():
    assert sources(players("cup", BLOCKER), players("old", RUNNER)) == [(Source("old", "p0", 0),)]
    nearer, farther = players("near", RUNNER), players("far", BLOCKER)
    assert sources(players("cup", BLOCKER), nearer, farther) == [(Source("far", "p0", 0),)]


def test_sides_that_are_named_on_one_end_alone_keep_the_order_of_players():
    named, unnamed = (RUNNER, BLOCKER), (PLAIN, PLAIN)
    for here, before in ((named, unnamed), (unnamed, named), (unnamed, unnamed)):
        found = sources(players("new", *here), players("old", *before))
        assert found == [(Source("old", "p0", 0),), (Source("old", "p1", 0),)]
