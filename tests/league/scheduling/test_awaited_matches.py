"""Payoff tables that are complete before a turn begins: which matches are awaited, and when they are not."""

from dataclasses import replace
from itertools import product

import pytest

from league.config.experiment import Config
from league.config.sections import Budget, Workers
from league.scheduling import match_scheduler, turn_scheduler
from league.scheduling.training_progress import measure
from league.state.jobs import RatingMatch, decode
from league.state.league_state import LeagueState
from matchmaking.opponents import Opponents
from storage.store import Store
from tests.league.conftest import BODILESS, call
from tests.league.leagues import BLUE, RED, WARP, C, filled, snapshot
from tests.league.leagues import match as played
from tests.league.plans import checkpoints, league_state, match, pairs_of, snapshots, training, turns, with_matches

WAITING = Opponents("nash", await_matches=True)
TABLE = {frozenset(pair) for pair in product(("blue@0", "blue@1", "blue@2"), ("red@0", "red@1", "red@2"))}


def waiting(share: float = 0.1, **changes):
    config = training(opponents=WAITING, **changes)
    return replace(config, rating=replace(config.rating, share=share))


@pytest.fixture
def state():
    return league_state(checkpoints=checkpoints(2), snapshots=snapshots(0, 1, 2))


def next_matches(config, state) -> turn_scheduler.Plan:
    """As the manager plans them."""
    planned = turn_scheduler.next_turns(config, state)
    return match_scheduler.next_matches(config, state, measure(config, state), planned.awaited)


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_no_turn_begins_until_each_pair_of_the_table_has_met_for_its_episodes(state, share):
    config, played = waiting(share), []
    while not turns(config, with_matches(state, played)):
        jobs = next_matches(config, with_matches(state, played)).jobs
        assert all(getattr(decode(job), "due", 0.0) is None for job in jobs)  # not booked: nobody learns meanwhile
        played += [match(*pair) for pair in pairs_of(turn_scheduler.Plan(jobs))]
    assert len(played) == len(TABLE)
    assert {frozenset((m.a, str(m.b))) for m in played} == TABLE


def test_pairs_of_the_newest_snapshots_are_awaited_first(state):
    first, *_, last = turn_scheduler.next_turns(waiting(), state).awaited
    assert any(str(name).endswith("@2") for name in first)
    assert set(last) == {"blue@0", "red@0"}


def test_a_pair_with_fewer_episodes_meets_again(state):
    played = [match(a, b, 64 if (a, b) == ("blue@1", "red@1") else 128) for a, b in map(sorted, TABLE)]
    assert turn_scheduler.next_turns(waiting(), with_matches(state, played)).awaited == (("blue@1", "red@1"),)


def test_what_cannot_be_played_is_not_awaited(state):
    played = [match(a, b) for a, b in map(sorted, TABLE) if (a, b) != ("blue@0", "red@1")]
    missing = with_matches(state, played)
    (job,) = next_matches(waiting(), missing).jobs
    assert not turns(waiting(), missing)
    assert turns(waiting(), replace(missing, jobs=(replace(job, state="failed"),)))
    thinned = [replace(s, thinned=1.0 if s.name == "blue@0" else None) for s in missing.snapshots]
    assert turns(waiting(), replace(missing, snapshots=thinned))


def test_without_the_setting_turns_begin_and_matches_keep_to_their_share(state):
    config = replace(waiting(0.0), training=replace(waiting().training, opponents=Opponents("nash")))
    assert turns(config, state)
    assert not next_matches(config, state).jobs


def test_alpharank_awaits_the_matches_within_the_other_team():
    state = league_state(checkpoints=checkpoints(1), snapshots=snapshots(0, 1))
    config = training(opponents=Opponents("alpharank", await_matches=True))
    assert {*map(frozenset, turn_scheduler.next_turns(config, state).awaited)} == {
        frozenset(("blue@0", "blue@1")), frozenset(("red@0", "red@1")),
    }  # fmt: skip


def test_settings_that_would_wait_for_ever_or_for_nothing_are_refused():
    with pytest.raises(ValueError, match="await_matches: nobody plays the matches"):
        Config(training=replace(Config().training, opponents=WAITING), workers=Workers(match=0))
    with pytest.raises(ValueError, match="await_matches: does nothing with kind = 'uniform'"):
        Opponents("uniform", await_matches=True)


@pytest.mark.slow
def test_a_league_waits_for_its_table_and_learns_on(tmp_path):
    asked = ("--training.opponents.kind", "nash", "--training.opponents.await_matches", "true", "--rating.share", "0")
    done = call("run", *BODILESS, *asked, "--steps", "8192", "--budget.rating_time", "0s", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with Store.open(tmp_path / "league-data") as store:
        (made,) = store.leagues()
        state = LeagueState.of(store, made.name)
        before = {p: [s.name for s in state.history(p)[:-1]] for p in ("blue", "red")}  # all but the newest
        met = {frozenset((m.a, str(m.b))) for m in store.matches(made.name, "rating")}
    assert len(before["blue"]) > 1
    assert {frozenset(pair) for pair in product(*before.values())} == met


def test_after_a_change_of_rules_or_engine_the_table_is_played_again(tmp_path):
    """Batches that the first ladder has had are planned again for the second, and for the first once more."""
    config = replace(waiting(), league="cup", budget=Budget("9h"))
    config = replace(config, rating=replace(config.rating, pairings=1))
    with filled(tmp_path) as store:
        put = store.blobs.put
        for newest, arena in ((4, C), (8, WARP), (16, C), (32, WARP)):
            if newest > 4:
                store.add_snapshots([snapshot(p, newest, put(f"{p.name}@{newest}".encode())) for p in (BLUE, RED)])
            for _ in range(100):
                jobs = next_matches(config, LeagueState.of(store, "cup")).jobs
                if not (jobs and turn_scheduler.next_turns(config, LeagueState.of(store, "cup")).awaited):
                    break
                assert store.queue(jobs) == len(jobs)
                while claimed := store.claim("cup", ["match"], "somewhere:1:0", 60):
                    task = decode(claimed[1])
                    assert isinstance(task, RatingMatch)
                    filed = [played(str(a), b, 64, 64, arena=arena) for a, b in task.lineups]
                    store.finish(claimed[0], matches=filed)
            state = LeagueState.of(store, "cup")
            assert state.arena == arena
            assert turns(config, state)
