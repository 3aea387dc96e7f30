from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from storage.database.urls import BLOBS_VARIABLE
from storage.records import ArenaKey, Job, League, Match, PairCounts, Player, Snapshot
from storage.store import Store
from tests.conftest import SERVER, server_place

KEY = ArenaKey("sumo", "c0ffee", "c")


@pytest.fixture(autouse=True)
def _no_place_from_outside(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv(BLOBS_VARIABLE, raising=False)


@pytest.fixture(params=["sqlite", "server"] if SERVER else ["sqlite"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, str]]:
    """Where a store may be made and where its blobs go: a new folder, or a schema of its own on the server."""
    blobs = str(tmp_path / "store" / "blobs")
    if request.param == "sqlite":
        yield str(tmp_path / "store"), blobs
    else:
        for url in server_place():
            yield url, blobs


def fill(store: Store) -> None:
    """League `cup`, its players blue and red, and their first snapshots, whose bytes are their names."""
    store.create_league(League("cup", "seed = 1"))
    store.add_players([Player("cup", "blue", 0, "main", "ant"), Player("cup", "red", 1, "main", "ant")])
    store.add_snapshots([snapshot(store, "blue@0", "blue"), snapshot(store, "red@0", "red")])


@pytest.fixture
def store(place: tuple[str, str]) -> Iterator[Store]:
    with Store.open(place[0], create=True, blobs=place[1]) as store:
        fill(store)
        yield store


def snapshot(store: Store, name: str, player: str | None = "blue", **fields: object) -> Snapshot:
    """A snapshot of league cup whose bytes, put into the store, are its name."""
    values = {"league": "cup", "digest": store.blobs.put(name.encode()), "roster": "ant", **fields}
    return Snapshot(name=name, player=player, **values)  # type: ignore[arg-type]


def match(seed: int) -> Match:
    return Match("cup", KEY, "blue@0", "red@0", 1, 0, 0, 0, 1, 0, 0, PairCounts(), seed)


def finish_a_job(store: Store, league: str = "cup", **results: Any) -> None:
    store.queue([Job(league, "any", f"job {len(store.jobs(league))}")])
    claimed = store.claim(league, ["any"], "tester", seconds=60)
    assert claimed
    store.finish(claimed[0], **results)
