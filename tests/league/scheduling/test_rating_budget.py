"""The share of the devices that rating matches take while players learn, by the rows of the store."""

from itertools import groupby, pairwise

import pytest

from league.commands.run.status import report
from league.queries.league_status import describe_rating_share
from league.queries.query import Open
from league.scheduling.match_scheduler import CREDIT, next_slot
from league.state.league_state import Batches, LeagueState
from matchmaking.schedule import Schedule
from storage.store import Store
from tests.league.conftest import call
from tests.league.leagues import filled, finish, match

SHARE = 0.0015  # a batch of this game without bodies takes half a millisecond
RUN = (
    "run", "--arena.name", "rock-paper-scissors", "--league", "small", "--training.worlds", "32",
    "--training.rollout_length", "16", "--rating.worlds", "16", "--rating.pairings", "2",
    "--rating.episodes_per_pair", "100000",
    "--rating.final-episodes-per-pair", "8", "--rating.share", str(SHARE), "--steps", "40000",
    "--budget.rating_time", "3s", "--workers.nice", "0",
)  # fmt: skip


@pytest.mark.slow
def test_a_league_plays_no_more_while_it_trains_than_it_may_and_then_all_it_can(tmp_path):
    done = call(*RUN, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with Store.open(tmp_path / "league-data") as store:
        log = store.matches("small", "rating")
        trained = LeagueState.of(store, "small").trained(Schedule())
        rated, first = store.booked("small")
    booked = [m for m in log if m.due is not None]
    batches = [(due, sum(m.seconds for m in each)) for due, each in groupby(booked, key=lambda m: m.due)]
    assert len(batches) > 1
    assert all(took > 0 for _, took in batches)
    for (due, took), (following, _) in pairwise(batches):
        assert following >= due + took / SHARE - 1e-6
    assert batches[0][0] == first == 0.0
    assert batches[-1][0] <= trained
    assert rated - batches[-1][1] <= SHARE * trained
    after = [m for m in log if m.due is None]
    assert len(after) > 2
    assert min(m.id for m in after) > max(m.id for m in booked)
    told = call("status", cwd=tmp_path).stdout
    assert f"Rating: {describe_rating_share(SHARE, trained, rated)}" in told


@pytest.mark.parametrize(
    ("share", "trained", "last", "slot"),
    [
        (0.0, 90.0, None, None),
        (0.1, 0.0, None, 0.0),
        (0.1, 54.9, Batches(45.0, 1.0), None),  # a second costs ten
        (0.1, 55.0, Batches(45.0, 1.0), 55.0),
        (0.1, 58.0, Batches(45.0, 1.0), 55.0),  # two batches may follow in a row
        (0.5, 46.9, Batches(45.0, 1.0), None),
        (0.5, 47.0, Batches(45.0, 1.0), 47.0),
        (1.0, 45.5, Batches(45.0, 1.0), 45.5),  # the next need not wait
        (0.1, 200.0, Batches(45.0, 1.0), 200.0 - CREDIT),
        (0.1, 50.0, Batches(90.0, 9.0), 0.0),  # booked under another schedule
    ],
)
def test_batches_are_booked_when_those_before_are_paid_for(share, trained, last, slot):
    assert next_slot(share, trained, last) == (None if slot is None else pytest.approx(slot))


def test_what_was_queued_together_last_is_read_off_the_log_at_once_or_piece_by_piece(tmp_path):
    def batch(due, seconds):
        return match("blue@4", "blue@0", 3, 1, due=due, seconds=seconds)

    log = [batch(5.0, 1.0), batch(5.0, 2.0), batch(9.0, 4.0), batch(9.0, 8.0), batch(None, 16.0), batch(9.0, 32.0)]
    wanted = [Batches(5.0, 1.0), Batches(5.0, 3.0), Batches(9.0, 4.0), *[Batches(9.0, 12.0)] * 2, Batches(9.0, 44.0)]
    with filled(tmp_path / "store") as store:
        piecewise = LeagueState.of(store, "cup")
        assert piecewise.batches is None
        for played, expected in zip(log, wanted, strict=True):
            finish(store, matches=[played])
            piecewise = LeagueState.of(store, "cup", piecewise)
            assert piecewise.batches == LeagueState.of(store, "cup").batches == expected


@pytest.mark.parametrize(
    ("figures", "told"),
    [
        ((0.1, 200.0, 18.2), "9.1 % of the time of the devices that train (rating.share: 10 %)"),
        ((0.025, 200.0, 0.0), "0 % of the time of the devices that train (rating.share: 2.5 %)"),
        ((0.1, 0.0, 0.0), "nobody has learnt yet (rating.share: 10 %)"),
        (
            (0.1, 200.0, 18.0, 7416),
            "9 % of the time of the devices that train (rating.share: 10 %), 412 games per second of a device",
        ),
        (
            (0.1, 200.0, 18.0, 35568),
            "9 % of the time of the devices that train (rating.share: 10 %), 1,976 games per second of a device",
        ),
        ((0.1, 1.0, 11.8), "1,180 % of the time of the devices that train (rating.share: 10 %)"),
        ((1.0, 10.0, 10.0), "100 % of the time of the devices that train (rating.share: as much as they get)"),
    ],
)
def test_the_share_in_words(figures, told):
    assert describe_rating_share(*figures) == told


def test_games_per_second_are_those_of_the_batches_whose_seconds_are_known(tmp_path):
    with filled(tmp_path / "store") as store:
        assert store.booked_episodes("cup") == 0
        for due, seconds in ((5.0, 2.0), (9.0, 4.0), (9.0, 0.0), (None, 16.0)):
            finish(store, matches=[match("blue@4", "blue@0", 300, 100, voids=200, due=due, seconds=seconds)])
        assert store.booked_episodes("cup") == 1200
        assert ", 200 games per second of a device" in report(Open(store, "cup"))
