"""Rating of a store by request: which batches are filed, as what they count, and what is told of those that are not."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from league.config import presets
from league.config.experiment import Config
from league.matches.store_rating import Done, Limits, chosen, rate
from league.queries.query import Open
from league.scheduling.match_scheduler import rating_job
from league.state.jobs import RatingMatch, decode
from league.state.league_state import LeagueState
from storage.records import RATED_PURPOSES, ArenaKey, Match
from storage.store import Store
from tests.league.leagues import WARP, C, filled, finish, match

CONFIG = replace(presets.preset("quickstart"), league="cup")


@dataclass
class Evaluator:
    """Files of batches without play: each lineup has eight games under a key, which are the same for equal seeds."""

    key: ArenaKey
    meanwhile: Callable[[Store, RatingMatch], object] | None = None  # what happens while the batch is played
    pairings: int = 4

    def play(self, store: Store, task: RatingMatch) -> list[Match]:
        if self.meanwhile is not None:
            self.meanwhile(store, task)
        return rows(task, self.key)


def rows(task: RatingMatch, key: ArenaKey) -> list[Match]:
    return [
        replace(match(str(a), b, 4, 4, arena=key, purpose=task.purpose), seed=task.seed, due=task.due)
        for a, b in task.lineups
    ]


def request(store: Store, evaluator: Evaluator, episodes: int, config: Config = CONFIG) -> Done:
    opened = Open(store, "cup")
    *_, done = rate(opened, config, evaluator, chosen(opened, ()), Limits(20.0, episodes))
    return done


def first_batch(store: Store) -> RatingMatch:
    """The batch with which a request begins, as a value."""
    found: list[RatingMatch] = []
    with pytest.raises(InterruptedError):
        request(store, Evaluator(C, lambda _, task: found.append(task) or interrupt()), 1)
    return found[0]


def interrupt() -> None:
    raise InterruptedError


def test_a_store_that_one_engine_has_rated_is_rated_from_nothing_under_another(tmp_path):
    with filled(tmp_path) as store:
        for key in (C, WARP, C):
            before = len(store.matches("cup"))
            done = request(store, Evaluator(key), 320)
            assert (done.episodes, done.repeated) == (320, 0)
            filed = store.matches("cup")[before:]
            assert {m.arena for m in filed} == {key}
            assert sum(m.episodes for m in filed) == 320
        played = [(m.arena, m.a, m.b, m.seed) for m in store.matches("cup")]
        assert len(set(played)) == len(played)  # the same games never count twice


def test_a_batch_that_an_interrupted_league_has_queued_is_no_obstacle_and_is_played_later(tmp_path):
    with filled(tmp_path, match("blue@4", "red@4", 10, 10)) as store:
        wanted = first_batch(store)
        left = rating_job(CONFIG, LeagueState.of(store, "cup"), wanted.lineups, None)
        assert store.queue([left]) == 1
        assert request(store, Evaluator(C), 64).episodes == 64
        assert sum(m.episodes for m in store.matches("cup", "request")) == 64
        claimed = store.claim("cup", [RatingMatch.kind], "somewhere:1:0", 60)
        assert claimed is not None
        task = decode(claimed[1])
        assert isinstance(task, RatingMatch)
        store.finish(claimed[0], matches=rows(task, C))
        seeds = [(m.a, m.b, m.seed) for m in store.matches("cup", RATED_PURPOSES)]
        assert len(set(seeds)) == len(seeds)


def test_what_another_process_has_filed_meanwhile_counts_once_and_is_told(tmp_path):
    def first_files(store: Store, task: RatingMatch) -> None:
        evaluator.meanwhile = None  # the first batch alone
        request(store, Evaluator(C), 1)

    with filled(tmp_path) as store:
        evaluator = Evaluator(C, first_files)
        done = request(store, evaluator, 64)
        assert (done.episodes, done.repeated) == (64, 32)
        assert done.repetition.startswith("32 more were not kept: another process")
        assert sum(m.episodes for m in store.matches("cup")) == 96
        assert Done(64, None, done.ladder).repetition == ""


def test_a_request_takes_nothing_of_the_leagues_own_time_for_rating(tmp_path: Path):
    with filled(tmp_path) as store:
        finish(store, "own", matches=[match("blue@4", "red@4", 10, 10)])
        before = LeagueState.of(store, "cup")
        request(store, Evaluator(C), 64)
        for state in (LeagueState.of(store, "cup"), LeagueState.of(store, "cup", before)):
            assert state.played == before.played > 0.0
            assert state.ladder.payoff.valid_episodes == 20 + 64  # they count for ratings
