"""Keys and seeds of rating batches: each batch has its own, on every ladder of a league."""

from dataclasses import replace
from zlib import crc32

from league.config import presets
from league.scheduling.match_scheduler import rating_job
from league.state.jobs import RatingMatch, decode, encode
from league.state.league_state import LeagueState
from storage.records import Job, Purpose
from storage.store import Store
from tests.league.leagues import WARP, C, filled, finish, match

CONFIG = replace(presets.preset("quickstart"), league="cup")
PAIR = ("blue@4", "red@4")


def planned(store: Store, purpose: Purpose = "rating") -> Job:
    return rating_job(CONFIG, LeagueState.of(store, "cup"), [PAIR], None, purpose)


def seed(job: Job) -> int:
    task = decode(job)
    assert isinstance(task, RatingMatch)
    return task.seed


def test_on_its_only_ladder_a_league_has_the_keys_and_seeds_of_earlier_versions(tmp_path):
    with filled(tmp_path) as store:
        for episodes in (0, 20):
            job, about = planned(store), [[*PAIR, episodes]]
            assert seed(job) == crc32(f"{CONFIG.seed}/[['blue@4', 'red@4', {episodes}]]".encode())
            assert job.key == encode("cup", decode(job), about).key
            finish(store, matches=[match(*PAIR, 10, 10)])


def test_a_batch_on_another_ladder_is_another_one(tmp_path):
    """The pair has met for 0 episodes under C and under WARP, and twice for 20 under C."""
    with filled(tmp_path) as store:
        jobs, state = [planned(store)], LeagueState.of(store, "cup")
        for arena, pair in ((C, PAIR), (WARP, ("blue@1", "red@1")), (C, ("blue@1", "red@1")), (WARP, PAIR)):
            finish(store, matches=[match(*pair, 10, 10, arena=arena)])
            jobs.append(planned(store))
            state, whole = LeagueState.of(store, "cup", state), LeagueState.of(store, "cup")
            assert (state.arena, state.last_elsewhere) == (whole.arena, whole.last_elsewhere)
        assert state.last_elsewhere == 3
        assert len({job.key for job in jobs}) == len({seed(job) for job in jobs}) == 5


def test_what_a_person_requests_differs_from_what_the_league_plans(tmp_path):
    with filled(tmp_path) as store:
        own, requested = planned(store), planned(store, "request")
        assert own.key != requested.key
        assert seed(own) != seed(requested)


def test_a_batch_planned_twice_from_the_same_league_is_the_same(tmp_path):
    with filled(tmp_path, match(*PAIR, 10, 10), match(*PAIR, 10, 10, arena=WARP)) as store:
        assert store.queue([planned(store)]) == 1
        assert store.queue([planned(store)]) == 0
