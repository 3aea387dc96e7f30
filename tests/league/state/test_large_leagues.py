"""Counts of what a manager reads and computes for one change: they must not grow with the size of the league."""

from dataclasses import replace

import numpy as np
import pytest
import sqlalchemy as sa

from league.scheduling import match_scheduler, turn_scheduler
from league.state.league_state import LeagueState
from matchmaking.match_design import RequiredOpponents, missing_pairs
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.payoff import sum_matches
from storage.records import Checkpoint, CurvePoint, League, Meeting, Snapshot
from storage.store import Store
from tests.league.leagues import finish, match, player
from tests.league.plans import PLAYERS, checkpoints, league_state, snapshots, training


class Counted(tuple):
    """Rows that count how often somebody goes through all of them."""

    passes = 0

    def __iter__(self):
        self.passes += 1
        return super().__iter__()


class Weighed(np.ndarray):
    """An array that counts the numbers which are computed from it and from its parts."""

    work = 0

    def __array_ufunc__(self, ufunc, method, *inputs, **given):
        plain = [np.asarray(x) if isinstance(x, Weighed) else x for x in inputs]
        Weighed.work += max(np.size(x) for x in plain)
        return getattr(ufunc, method)(*plain, **given)


def groups(number):
    return tuple(replace(p, name=f"{p.name}-{i}", group=str(i)) for i in range(number) for p in PLAYERS)


@pytest.fixture
def large(tmp_path):
    """A store of a league of some groups, whose queries and curve rows are counted."""
    stores = []

    def make(number):
        store = Store.open(tmp_path / str(number), create=True)
        stores.append(store)
        store.create_league(League("cup", ""))
        teams = list(enumerate(("blue", "red")))
        players = [player(f"{name}-{i}", team, group=str(i)) for i in range(number) for team, name in teams]
        store.add_players(players)
        blob = store.blobs.put(b"bytes")
        frozen = [
            Snapshot("cup", f"{p.name}@{i}", blob, p.roster, p.name, iteration=i) for p in players for i in (0, 1)
        ]
        store.add_snapshots(frozen)
        finish(store, **went_on(store, players, 1))
        return store, players

    yield make
    for store in stores:
        store.close()


def went_on(store, players, iteration):
    state = store.blobs.put(f"state {iteration}".encode())
    return {
        "checkpoints": [Checkpoint("cup", p.name, state, iteration, iteration, 1.0) for p in players],
        "curves": [CurvePoint("cup", p.name, iteration, iteration, 1.0, {"episodes": 100.0}) for p in players],
    }


def queries_of_a_change(store, before):
    told = []
    engine = store._db.engine
    sa.event.listen(engine, "before_cursor_execute", lambda *args: told.append(args[2]))
    return LeagueState.of(store, "cup", before), told


def test_after_a_turn_only_the_curves_of_its_players_are_read(large):
    counts = []
    for number in (2, 20):
        store, players = large(number)
        before = LeagueState.of(store, "cup")
        finish(store, **went_on(store, players[:2], 2))
        after, told = queries_of_a_change(store, before)
        assert sum("FROM curves" in text for text in told) == 2
        assert after.curves["blue-0"].at.iteration == 2
        assert after.curves["blue-1"] is before.curves["blue-1"]
        counts.append(len(told))
    assert counts[0] == counts[1]


def test_a_new_snapshot_is_read_without_the_others_and_has_its_place(large):
    store, _ = large(3)
    before = LeagueState.of(store, "cup")
    new = replace(before.by_name["red-1@1"], name="red-1@2", iteration=2, settings="text")
    store.add_snapshots([new])
    after, _ = queries_of_a_change(store, before)
    assert [s.name for s in after.snapshots] == [s.name for s in store.snapshots("cup")]
    assert all(after.by_name[s.name] is s for s in before.snapshots)
    assert store.snapshots("cup", named=["red-1@2", "nobody"], brief=True)[0].settings == ""


def test_a_thinned_snapshot_is_noticed_though_the_number_is_the_same(large):
    store, _ = large(2)
    before = LeagueState.of(store, "cup")
    with store._db.changing(["cup"]) as db:
        db.execute(sa.text("UPDATE snapshots SET thinned = 1.0 WHERE name = 'red-1@0'"))
    after = LeagueState.of(store, "cup", before)
    assert after.by_name["red-1@0"].thinned == 1.0


def test_a_plan_goes_through_snapshots_and_games_as_often_for_many_players_as_for_few():
    passes = []
    for number in (2, 12):
        players = groups(number)
        frozen = Counted(snapshots(0, 1, 2, 4, players=players))
        met = Counted(Meeting("quickstart", p.name, 4, f"{PLAYERS[1 - p.team].name}-0@1", 3, 1, 2) for p in players)
        state = league_state(players=players, snapshots=frozen, checkpoints=checkpoints(4, 10.0, players), meetings=met)
        frozen.passes = met.passes = 0
        config = training()
        assert len(turn_scheduler.next_turns(config, state).jobs) == number
        assert match_scheduler.next_matches(config, state).jobs
        passes.append((frozen.passes, met.passes))
    assert passes[0] == passes[1]


def test_pairs_that_have_to_meet_are_looked_up_whatever_else_was_played():
    work = []
    for number in (10, 200):
        names = [f"s{i:03}" for i in range(number)]
        payoff = sum_matches([match(a, b, 10, 8) for a in names for b in names[:5] if a != b])
        columns = ("home", "away", "pairs", "voids")
        weighed = replace(payoff, **{key: getattr(payoff, key).view(Weighed) for key in columns})
        Weighed.work = 0
        required = {"s000": RequiredOpponents(["s001", "s002"]), "s001": RequiredOpponents(["s003"])}
        assert missing_pairs(weighed, required, quota=40) == [("s000", "s001"), ("s001", "s003"), ("s000", "s002")]
        work.append(Weighed.work)
    assert work[0] == work[1] > 0


def test_rows_added_to_a_log_are_those_of_the_whole_log():
    rng = np.random.default_rng(4)
    names = [f"s{i}" for i in range(9)]
    log = [match(*rng.choice(names, 2, replace=False).tolist(), 10, 8, voids=int(rng.integers(3))) for _ in range(60)]
    ladder = Ladder(names[:4], log[:20])
    for at in range(20, 60, 8):
        ladder = ladder.extended(log[at : at + 8], names[: at // 6])
    whole = Ladder(ladder.names, log)
    for key in ("names", "first", "second", "home", "away", "pairs", "voids", "at_fault", "trials", "last"):
        assert np.array_equal(getattr(ladder.payoff, key), getattr(whole.payoff, key)), key
