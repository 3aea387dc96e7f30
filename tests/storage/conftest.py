import os
import secrets
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.records import ArenaKey, League, Player, Snapshot
from storage.store import Store

SERVER = os.environ.get("TEST_DB_URL")  # e.g. postgresql+psycopg://user@host/database: runs every test there as well


@pytest.fixture(params=["sqlite", "server"] if SERVER else ["sqlite"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, str]]:
    """Where a store may be made and where its blobs go: a new folder, or a schema of its own on the server."""
    blobs = str(tmp_path / "store" / "blobs")
    if request.param == "sqlite":
        yield str(tmp_path / "store"), blobs
        return
    assert SERVER is not None
    schema = f"league_test_{secrets.token_hex(6)}"
    server = sa.create_engine(SERVER)
    with server.begin() as db:
        db.execute(sa.schema.CreateSchema(schema))
    own = sa.make_url(SERVER).update_query_dict({"options": f"-csearch_path={schema}"})
    yield own.render_as_string(hide_password=False), blobs
    with server.begin() as db:
        db.execute(sa.schema.DropSchema(schema, cascade=True))
    server.dispose()


@pytest.fixture
def store(place: tuple[str, str]) -> Iterator[Store]:
    """A store with league `cup`, its players blue and red, and their first snapshots, whose bytes are their names."""
    with Store.open(place[0], create=True, blobs=place[1]) as store:
        store.create_league(League("cup", ArenaKey("sumo", "c0ffee", "c"), "seed = 1"))
        store.add_players([Player("cup", "blue", 0, "main", "ant"), Player("cup", "red", 1, "main", "ant")])
        store.add_snapshots(
            [Snapshot(store.blobs.put(name.encode()), "cup", name, "ant", name[:-2]) for name in ("blue@0", "red@0")]
        )
        yield store
