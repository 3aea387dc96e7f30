"""Leagues to be packed, and what is left of them, compared."""

import hashlib
from pathlib import Path

import pandas as pd
import pytest
import sqlalchemy as sa

from league.commands import cli
from league.queries.query import Open
from storage.database import schema as t
from storage.maintenance import row_transfer
from storage.records import Checkpoint, CurvePoint, Job, League, Phase, Player, Snapshot
from storage.store import Store
from tests.league.leagues import C, filled, finish, match

BLOB = hashlib.sha256(b"episode 1").hexdigest()


def league_of(folder: Path) -> Store:
    """A league with something in every table: matches with recordings, two checkpoints, a phase, jobs in all states."""
    store = filled(folder)
    blob = store.blobs.put
    finish(store, matches=[
        match("blue@4", "red@4", 6, 2, recording=blob(b"episode 1")), match("blue@4", "blue@0", 9, 1, 2),
        match("red@4", "pusher", 3, 5), match("red@0", "blue@0", 4, 4), match("pusher", "blue@4", 5, 3),
    ])  # fmt: skip
    later = [Checkpoint("cup", p, blob(f"later {p}".encode()), 800, 8, 5000.125, C) for p in ("blue", "red")]
    finish(store, checkpoints=later, curves=[
        CurvePoint("cup", p, i, 100 * i, 0.1 * i, {"reward": 1 / (i + 2), "score": 0.5})
        for p in ("red", "blue") for i in (1, 2, 10)
    ])  # fmt: skip
    phase = Phase("cup", "1", 0, ("blue",), {"blue": 0, "red": 0}, {"iterations": 50})
    store.queue([Job("cup", "any", "waits", {"a": [1, None]}), Job("cup", "other", "leased")], [phase])
    assert store.claim("cup", ["other"], "host:1:x", 60) is not None
    store.set_paused("cup", "red", "for a reason")
    assert store.acquire_leadership("cup", "host:2:manager", 60)
    store.heartbeat("host:1:x", "cup", "other", 1, "host", {"doing": "it"})
    return store


def rows(store: Store, name: str = "cup") -> dict[str, list]:
    """All that a league's rows say, less what a database gives or a process leaves."""
    found = {}
    for table in row_transfer.TABLES.values():
        chosen = row_transfer.columns(table)
        query = sa.select(*chosen).where((table.c.name if table is t.leagues else table.c.league) == name)
        found[table.name] = sorted(map(repr, store._db.rows(query)))
    return found


def ratings(store: Store, name: str = "cup") -> pd.DataFrame:
    return Open(store, name).ratings()


def assert_rated_alike(a: Store, b: Store, name: str | None = None) -> None:
    one = a.leagues()[0].name
    assert len(ratings(a, one)) > 5
    pd.testing.assert_frame_equal(ratings(a, one), ratings(b, name or one), rtol=0, atol=1e-9)


def ran(capsys, *args: str) -> tuple[int, str, str]:
    """Run a command here: exit code, what it printed, what it complained of."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(args))
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


def refused(capsys, *args: str) -> str:
    """Run a command that is refused: its one line."""
    code, out, err = ran(capsys, *args)
    assert (code, out) == (2, ""), err
    assert err.startswith("league: ")
    assert err.count("\n") == 1
    assert len(err) < 600
    return err


def curriculum(folder: Path) -> Store:
    """League `cup` of two stages, after league `base`, and a league `other` that has to do with none of them."""
    store = Store.open(folder, create=True)
    text = 'league = "cup"\n# of others\nafter = ["base"]\n[storage]\nblobs = "/old/place"\n'
    stages = '[[stages]]\nname = "walk"\n[[stages]]\nname = "push"\n[[stages]]\nname = "match"\n'
    for name, config in {
        "base": 'league = "base"\n', "other": 'league = "other"\n', "cup": text + stages,
        "cup.walk": 'league = "cup.walk"\nafter = ["base"]\n',
        "cup.push": 'league = "cup.push"\nafter = ["cup.walk", "base"]\n',
    }.items():  # fmt: skip
        store.create_league(League(name, config))
    store.add_players([Player("cup.push", "blue", 0, "main", "ant:3:1")])
    digest = store.blobs.put(b"policy")
    store.add_snapshots([Snapshot("cup.push", "blue@0", digest, "ant:3:1", "blue", parent="cup.walk/blue@8")])
    return store
