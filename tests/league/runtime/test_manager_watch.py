"""Detection of a manager's end by workers on other hosts, where the store may have been away for all of them."""

import pytest

from league.runtime.heartbeat import LEASE, ManagerWatch
from storage.records import League
from storage.store import Store

LEAGUE, MANAGER = "small", "elsewhere:7:manager"


class Watched:
    """A store with a league, its worker's watch, and a clock that stands still."""

    def __init__(self, store: Store):
        self.store, self.now = store, 0.0
        store.create_league(League(LEAGUE, ""))
        store.acquire_leadership(LEAGUE, MANAGER, 1e6)
        self.watch = ManagerWatch(store, LEAGUE, MANAGER, lambda: self.now)

    def after(self, seconds: float) -> bool:
        self.now += seconds
        return self.watch.is_gone()

    def beats(self, seconds: float) -> list[bool]:
        return [self.after(1.0) for _ in range(int(seconds))]


@pytest.fixture
def watched(tmp_path):
    with Store.open(tmp_path / "store", create=True) as store:
        yield Watched(store)


def test_a_manager_that_leads_is_there_and_one_that_has_given_up_is_gone_at_once(watched):
    assert not any(watched.beats(2 * LEASE))
    watched.store.release_leadership(LEAGUE, MANAGER)
    assert watched.after(1.0)


def test_a_lease_that_ended_while_the_store_was_away_leaves_the_manager_time_to_return(watched):
    watched.store.acquire_leadership(LEAGUE, MANAGER, -1.0)
    for _ in range(3):
        assert not any(watched.beats(LEASE))
        watched.store.acquire_leadership(LEAGUE, MANAGER, 1e6)
        assert not watched.after(1.0)
        watched.store.acquire_leadership(LEAGUE, MANAGER, -1.0)


def test_a_manager_that_does_not_return_is_gone_after_the_time_of_another_lease(watched):
    watched.store.acquire_leadership(LEAGUE, MANAGER, -1.0)
    assert watched.beats(LEASE + 2) == [False] * int(LEASE + 1) + [True]


def test_another_manager_is_noticed_at_once(watched):
    watched.store.release_leadership(LEAGUE, MANAGER)
    watched.store.acquire_leadership(LEAGUE, "elsewhere:8:manager", 1e6)
    assert watched.after(1.0)
