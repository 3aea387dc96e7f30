"""Time and memory of every query on a large store. Prints JSON.

    python -m benchmarks.large_store [--snapshots 10000] [--out benchmarks/results/large-store-cpu.json]

The store has one league of two players whose strength grows with the logarithm of their iterations. Every snapshot has
met its parent, its ancestors 3 and 10 back, its player's initial snapshot, the other player's newest snapshot, two
scripts and `--others` random snapshots, with 128 games each. The store also has learning curves, training games,
checkpoints and finished jobs. A command is timed from the start of its process to its end; its memory is the largest
resident size of the process. `--load N` keeps N further processes busy meanwhile. `plan` is the work of the manager: it
reads the state of the league and plans the next rating matches. `rate` reads a CSV file of a million rows, and one of
12,000 players.
"""

import argparse
import csv
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from league.system import environment

environment.prepare()  # as every command does, before NumPy is loaded: one BLAS thread

import numpy as np

from league.config import experiment as configuration
from league.state.jobs import RatingMatch, encode
from matchmaking.ratings.davidson import davidson
from scripts.record import make_parser, report, run_info
from storage.database.rows import row_of
from storage.records import (
    ArenaKey,
    Checkpoint,
    CurvePoint,
    League,
    Match,
    Meeting,
    PairCounts,
    Player,
    Snapshot,
)
from storage.store import Store

LEAGUE, PLAYERS, SCRIPTS = "large", ("blue", "red"), tuple(f"script-{i}" for i in range(8))
KEY = ArenaKey("sumo-1v1", "0", "c")
GAMES = 128  # of a match row
CONFIG = configuration.loads(f'league = "{LEAGUE}"\n[arena]\nname = "sumo-1v1"\n[training]\nworlds = 64\n')
SECONDS, MEMORY = 5.0, 500  # targets of every command: seconds and MB
COMMANDS = {
    "ratings": ["ratings"], "ratings-json": ["ratings", "--format", "json"],
    "ratings-as-of": ["ratings", "--as-of", "2026-11-22", "--ticker"], "payoff": ["payoff"],
    "payoff-csv": ["payoff", "--format", "csv"], "payoff-newest": ["payoff", "--newest"],
    "payoff-json": ["payoff", "--format", "json"], "meta": ["meta"],
    "meta-alpharank": ["meta", "--solver", "alpharank"],
    "forgetting": ["forgetting"], "explain": ["explain", PLAYERS[0]], "curves": ["curves"],
    "curves-csv": ["curves", "--format", "csv"], "snapshots": ["snapshots"], "matches": ["matches"],
    "matches-csv": ["matches", "--format", "csv"], "status": ["status"], "report": ["report", "-o", "{out}"],
    "verify": ["verify"],
}  # fmt: skip
ALONE = ("verify",)  # concerns a whole store: takes no --league
PLAN = """
import sys
from league.system import environment
environment.prepare()
from league.config import experiment as configuration
from league.scheduling.match_scheduler import next_matches
from league.state.league_state import LeagueState
from storage.store import Store
with Store.open(sys.argv[1]) as store:
    config = configuration.loads(store.league(sys.argv[2]).config)
    print(len(next_matches(config, LeagueState.of(store, sys.argv[2])).jobs))
"""
WATCHED = """
import resource, subprocess, sys, time
start = time.perf_counter()
done = subprocess.run(sys.argv[2:], stdout=open(sys.argv[1], "wb"), stderr=subprocess.PIPE, text=True)
took, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
print(took, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, done.returncode, *done.stderr.splitlines()[-1:])
"""  # in a process of its own: the memory of a child includes what its parent had when it forked


def name(snapshot: int) -> str:
    """Return the name of a snapshot; two lineages alternate."""
    return f"{PLAYERS[snapshot % 2]}@{snapshot // 2}"


def snapshots(number: int) -> list[Snapshot]:
    """Return the scripts, then the players' snapshots; their blobs do not exist."""
    text = configuration.dumps(CONFIG)
    scripted = [
        Snapshot(LEAGUE, script, f"{i:064x}", "rover", script=script, origin="scripted", created=1.0)
        for i, script in enumerate(SCRIPTS)
    ]
    return scripted + [
        Snapshot(LEAGUE, name(i), f"{i + 100:064x}", "rover", PLAYERS[i % 2], initial=i < 2, iteration=i // 2,
                 step=1000 * (i // 2), seconds=float(i), arena=KEY, parent=name(i - 2) if i > 1 else None,
                 settings=text, created=1.0 + i)
        for i in range(number - len(SCRIPTS))
    ]  # fmt: skip


def pairs(number: int, others: int, rng: np.random.Generator) -> np.ndarray:
    """Return (rows, 2) index pairs of opponents; the players' snapshots come first, then the scripts."""
    learnt = number - len(SCRIPTS)
    i = np.arange(2, learnt)
    found = [np.stack([i, i - 2 * back], 1)[i >= 2 * back] for back in (1, 3, 10)]
    found += [np.stack([i, i % 2], 1), np.stack([i, i - 1], 1)]
    found += [np.stack([i, learnt + rng.integers(len(SCRIPTS), size=len(i))], 1) for _ in range(2)]
    found += [np.stack([i, (rng.random(len(i)) * i).astype(int)], 1) for _ in range(others)]
    rows = np.concatenate(found)
    return rows[np.argsort(rows[:, 0], kind="stable")]


def log(number: int, others: int, seed: int = 0) -> Iterator[Match]:
    """Yield the rows of a log, in the order of their snapshots."""
    rng, learnt = np.random.default_rng(seed), number - len(SCRIPTS)
    names = [*(name(i) for i in range(learnt)), *SCRIPTS]
    theta = np.append(np.log2(1 + np.arange(learnt)) + rng.normal(0, 0.3, learnt), rng.normal(3, 1.0, len(SCRIPTS)))
    met = pairs(number, others, rng)
    gap = theta[met[:, 0]] - theta[met[:, 1]]
    sides = []
    for sign in (1, -1):  # the first on either side
        chance = np.exp(davidson(sign * gap + 0.1, np.log(0.5)).log_likelihood).T[:, ::sign]
        sides.append((rng.random((len(met), GAMES // 2))[..., None] > chance.cumsum(1)[:, None, :]).sum(-1))
    points = 4 - (sides[0] + sides[1])  # of the first in each seed pair, in half points
    home, away, pair = (
        np.stack([(kind == k).sum(1) for k in range(most)], 1)
        for kind, most in ((sides[0], 3), (sides[1], 3), (points, 5))
    )
    both = home + away
    rows = zip(met.tolist(), home.tolist(), both.tolist(), pair.tolist(), strict=True)
    for id, ((a, b), home_side, (wins, draws, losses), five) in enumerate(rows, 1):
        yield Match(LEAGUE, KEY, names[a], names[b], wins, draws, losses, 0, home_side[0], home_side[1], home_side[2],
                    PairCounts(*five), seed=id, id=id, seconds=0.5, created=float(id))  # fmt: skip


def tables(number: int, others: int, digest: str) -> Iterator[tuple[str, Iterator[dict]]]:
    """Yield the rows of a store, table by table, as `Store.restore` takes them; `digest` is of an existing blob."""
    away, last = ("id", "holder", "lease_until"), (number - len(SCRIPTS)) // 2
    matches = list(log(number, others))
    text = configuration.dumps(CONFIG)
    yield "leagues", iter([row_of(League(LEAGUE, text)) | {"revision": 0, "matches": len(matches)}])
    yield "players", (row_of(Player(LEAGUE, p, i, "main", "rover")) for i, p in enumerate(PLAYERS))
    at = [Checkpoint(LEAGUE, p, digest, 1000 * last, last, float(last), KEY) for p in PLAYERS]
    yield "checkpoints", (row_of(c) for c in at)
    yield "snapshots", (row_of(s) for s in snapshots(number))
    yield "matches", (row_of(m) for m in matches)
    values = {"score": 0.5, "reward": 0.1, "length": 200.0, "episodes": 64.0, "entropy": 1.0, "steps_per_second": 1e5}
    yield (
        "curves",
        (row_of(CurvePoint(LEAGUE, p, i, 1000 * i, float(i), values)) for i in range(1, last + 1) for p in PLAYERS),
    )
    yield "meetings", (row_of(meeting(i, k)) for i in range(2, 2 * last) for k in range(4))
    batches = (matches[i : i + 8] for i in range(0, len(matches), 8))
    jobs = (encode(LEAGUE, RatingMatch(tuple((m.a, m.b) for m in b), i), i) for i, b in enumerate(batches))
    yield "jobs", (row_of(job, *away) | {"state": "done"} for job in jobs)


def meeting(i: int, k: int) -> Meeting:
    """Return the training games of a turn against one of four opponents."""
    against = name(max(0, i - 1 - 2 * k))
    return Meeting(LEAGUE, PLAYERS[i % 2], i // 2, against, 40, 10, 14, chance=0.1, pool=10, id=4 * i + k)


def fill(where: Path, number: int, others: int) -> None:
    """Create and fill the store."""
    with Store.open(str(where), create=True) as store:
        store.restore(tables(number, others, store.blobs.put(b"a state that nobody reads")))


def results(file: Path, players: int, rows: int, seed: int = 0) -> None:
    """Write a CSV log for `league rate`: random games between players of known strengths."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(0, 1.0, players)
    a = rng.integers(players, size=rows)
    b = (a + rng.integers(1, players, size=rows)) % players
    chance = np.exp(davidson(theta[a] - theta[b] + 0.1, np.log(0.5)).log_likelihood).T.cumsum(1)
    ends = (rng.random(rows)[:, None] > chance).sum(1)
    with file.open("w", newline="") as out:
        lines = csv.writer(out)
        lines.writerow(["arena", "side_a", "side_b", "wins_a", "draws", "wins_b"])
        lines.writerows(
            ("pit", f"p{i}", f"p{j}", int(e == 0), int(e == 1), int(e == 2))
            for i, j, e in zip(a.tolist(), b.tolist(), ends.tolist(), strict=True)
        )


def timed(line: list[str], out: Path, limit: float) -> dict[str, Any]:
    """Time a process from its start to its end; give it up after `limit` seconds."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", WATCHED, str(out), *line], capture_output=True, text=True, timeout=limit, check=True
        )
    except subprocess.TimeoutExpired:
        return {"seconds": None, "above": limit}
    took, used, resident, code, *error = done.stdout.split(maxsplit=4)
    found = {"seconds": round(float(took), 2), "processor_seconds": round(float(used), 2),
             "resident_mb": round(float(resident)), "code": int(code)}  # fmt: skip
    return found | ({"said": error[0].strip()[:200]} if int(code) else {})


def busy() -> None:
    """Compute without end."""
    while True:
        sum(range(100_000))


def measured(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Fill the store, unless the folder has one, and time every command that was asked for."""
    store, out = folder / "store", folder / "out"
    start = time.perf_counter()
    if not store.exists():
        fill(store, args.snapshots, args.others)
    found: dict[str, Any] = {"filled_in_seconds": round(time.perf_counter() - start, 1)}
    league = [sys.executable, "-m", "league"]
    asked: dict[str, list[str]] = {}
    for title, words in COMMANDS.items():
        words = [word.format(out=folder / "page.html") for word in words]
        own = [] if title in ALONE else ["--league", LEAGUE]
        asked[title] = [*league, *words, "--store", str(store), *own]
    asked["plan"] = [sys.executable, "-c", PLAN, str(store), LEAGUE]
    for title, players, rows in (("rate-million", 1000, 1_000_000), ("rate-12000-players", 12_000, 120_000)):
        if title in (args.only or [title]):
            results(folder / f"{title}.csv", players, rows)
        asked[title] = [*league, "rate", str(folder / f"{title}.csv")]
    for title, line in asked.items():
        if args.only and title not in args.only:
            continue
        (folder / "page.html").unlink(missing_ok=True)
        found[title] = timed(line, out, args.limit) | {"load_average": round(os.getloadavg()[0], 1)}
        print(title, found[title], file=sys.stderr, flush=True)
    return found


def main() -> None:
    """Measure and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--snapshots", type=int, default=10_000)
    parser.add_argument("--others", type=int, default=3, help="random opponents of each snapshot")
    parser.add_argument("--load", type=int, default=0, help="busy processes beside the command")
    parser.add_argument("--limit", type=float, default=180.0, help="seconds after which a command is given up")
    parser.add_argument("--only", nargs="+", help="only these commands")
    parser.add_argument("--folder", type=Path, help="keep the store there, or use the one that is there")
    args = parser.parse_args()
    others = [multiprocessing.Process(target=busy, daemon=True) for _ in range(args.load)]
    for process in others:
        process.start()
    result: dict[str, Any] = {
        "asked": {"seconds": SECONDS, "resident_mb": MEMORY},
        "snapshots": args.snapshots, "others": args.others, "busy_processes": args.load,
    }  # fmt: skip
    try:
        if args.folder:
            args.folder.mkdir(parents=True, exist_ok=True)
            result |= measured(args.folder, args)
        else:
            with tempfile.TemporaryDirectory() as folder:
                result |= measured(Path(folder), args)
    finally:
        for process in others:
            process.kill()
    report({**run_info(args.commit), **result}, args.out)


if __name__ == "__main__":
    main()
