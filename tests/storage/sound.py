"""A store with something sound in every table, and ways to damage it."""

import json
import os
import sqlite3
from pathlib import Path

import numpy as np

from storage.blobs import arrays
from storage.recordings.recording import Recording, RecordingHeader
from storage.recordings.recording import to_bytes as recorded
from storage.records import Checkpoint, CurvePoint, Job, League, Match, Meeting, PairCounts, Phase, Player, Snapshot
from storage.store import Store
from tests.storage.conftest import KEY, finish_a_job

CONFIG = 'league = "cup"\n[storage]\ncheckpoints = 8\n'
DAY = 86400.0


def policy(seed: int) -> bytes:
    """Arrays as a snapshot's or a checkpoint's bytes."""
    return arrays.to_bytes({"0/weight": np.full((3, 2), float(seed), np.float32)})


def episode(a: str, b: str, seed: int = 0) -> bytes:
    """A recording of two steps."""
    header = RecordingHeader(
        "cup", 0, seed, 0, KEY, (a, b), ("ab" * 32, "cd" * 32), ("blue", "red"), (("blue/0",), ("red/0",)),
        (1.0, 0.0), f"{a} wins as blue", 0.02,
    )  # fmt: skip
    still = np.zeros((2, 2))
    return recorded(
        Recording(header, "", np.array([0.02, 0.04]), still, {"blue/0": still, "red/0": still}, still, still)
    )


def match(seed: int, recording: str | None = None, **changes: object) -> Match:
    values = {"wins": 5, "draws": 1, "losses": 2, "voids": 1, "side_wins": 3, "side_draws": 0, "side_losses": 1}
    pairs = PairCounts(ll=1, dw=1, ww=2)
    sides = {"a": "blue@1", "b": "red@1"}
    return Match("cup", KEY, **(sides | values | changes), pairs=pairs, seed=seed, recording=recording)  # type: ignore[arg-type]


def fill(store: Store) -> None:
    """League cup: two players, five snapshots, four checkpoints, three matches of which two were recorded, ..."""
    put = store.blobs.put
    store.create_league(League("cup", CONFIG))
    store.start_run("cup", CONFIG, "here", {"jax": "0.11"})
    store.add_players([Player("cup", "blue", 0, "main", "ant:3:2"), Player("cup", "red", 1, "main", "ant:3:2")])
    store.add_snapshots([
        *(
            Snapshot("cup", f"{name}@{i}", put(policy(i + 10 * team)), "ant:3:2", name, initial=not i, iteration=i)
            for team, name in enumerate(("blue", "red"))
            for i in (0, 1)
        ),
        Snapshot("cup", "idle", put(json.dumps({"script": "idle"}).encode()), "ant:3:2", script="idle",
                 origin="scripted"),
    ])  # fmt: skip
    for i in (1, 2):
        finish_a_job(
            store,
            checkpoints=[
                Checkpoint("cup", p, put(policy(100 * i + n)), 10 * i, i, 0.5 * i, KEY)
                for n, p in enumerate(("blue", "red"))
            ],
            curves=[CurvePoint("cup", "blue", i, 10 * i, 0.5 * i, {"reward": 0.25})],
            meetings=[Meeting("cup", "blue", i, "red", 3, 1, 2)],
        )
    finish_a_job(
        store, matches=[match(1, put(episode("blue@1", "red@1"))), match(2), match(3, put(episode("red@1", "blue@1")))]
    )
    store.queue([Job("cup", "any", "waits"), Job("cup", "other", "leased")], [
        Phase("cup", "1", 0, ("blue",), {"blue": 0, "red": 0}, {"iterations": 50})
    ])  # fmt: skip
    assert store.claim("cup", ["other"], "host:1:x", 60) is not None
    store.heartbeat("host:1:x", "cup", "other", 1, "host", {"doing": "it"})


def contents(folder: Path) -> dict[str, bytes]:
    """All files, less what readers leave behind: the index that SQLite keeps of its log, and a log that is empty."""
    files = {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    return {
        name: data for name, data in files.items() if not name.endswith("-shm") and (data or not name.endswith("-wal"))
    }


def blob(folder: Path, digest: str) -> Path:
    return folder / "blobs" / digest[:2] / digest[2:]


def older(path: Path, seconds: float = 2 * DAY) -> None:
    """Let a file have been written before."""
    when = path.stat().st_mtime - seconds
    os.utime(path, (when, when))


def change(folder: Path, statement: str) -> None:
    """Change the rows behind the program's back."""
    db = sqlite3.connect(folder / "league.db")
    with db:
        db.executescript(statement)
    db.close()
