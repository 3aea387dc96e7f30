"""Time and memory of every query on a large store, and of a manager's rounds. Prints JSON.

    python -m benchmarks.large_store [--snapshots 10000] [--out benchmarks/results/large-store-cpu.json]
    python -m benchmarks.large_store --players 100 --turns 5 --iterations 16 --games 100000000 [--server postgresql://...]

The store has one league of two players or more, whose strength grows with the logarithm of their iterations. Every
snapshot has met its parent, its ancestors 3 and 10 back, its player's initial snapshot, the newest snapshots of other
players (one, or as many as `--games` takes), two scripts and `--others` random snapshots, with 128 games each. The
store also has learning curves, training games, checkpoints and finished jobs. A command is timed from the start of its
process to its end; its memory is the largest resident size of the process. `--load N` keeps N further processes busy
meanwhile. `manager` is `benchmarks/manager_rounds.py`. `rate` reads a CSV file of a million rows, and one of 12,000
players.
"""

import argparse
import csv
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from league.system import environment

environment.prepare()  # as every command does, before NumPy is loaded: one BLAS thread

import numpy as np

from league.config import experiment as configuration
from league.config.sections import PlayerSettings
from league.state.jobs import RatingMatch, encode
from matchmaking.ratings.davidson import davidson
from scripts.record import commit, make_parser, report, run_info, write
from storage.database.rows import row_of
from storage.errors import NotAStore
from storage.records import (
    ArenaKey,
    Checkpoint,
    CurvePoint,
    League,
    Match,
    Meeting,
    PairCounts,
    Phase,
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
    "forgetting": ["forgetting"], "explain": ["explain", "{player}"], "curves": ["curves"],
    "curves-csv": ["curves", "--format", "csv"], "snapshots": ["snapshots"], "matches": ["matches"],
    "matches-csv": ["matches", "--format", "csv"], "status": ["status"], "report": ["report", "-o", "{out}"],
    "verify": ["verify"], "thin": ["thin", "--dry-run", "--snapshots", "2"],
}  # fmt: skip
ALONE = ("verify", "thin")  # concern a whole store: take no --league
PART = 10_000  # rows of the log that are drawn at once
WATCHED = """
import resource, subprocess, sys, time
start = time.perf_counter()
done = subprocess.run(sys.argv[2:], stdout=open(sys.argv[1], "wb"), stderr=subprocess.PIPE, text=True)
took, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
print(took, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, done.returncode, *done.stderr.splitlines()[-1:])
"""  # in a process of its own: the memory of a child includes what its parent had when it forked


@dataclass(frozen=True)
class Size:
    """Size of the league: its players learn in groups of two teams, and each has equally many snapshots."""

    snapshots: int = 10_000  # scripts included
    players: int = 2
    rivals: int = 1  # newest snapshots of other players that each snapshot has met
    others: int = 3  # random snapshots that each has met
    turns: int = 1  # of training from one snapshot to the next
    iterations: int = 1  # of a turn

    @property
    def learnt(self) -> int:
        """Number of snapshots of players."""
        return self.snapshots - len(SCRIPTS)

    @property
    def every(self) -> int:
        """Iterations from one snapshot of a player to the next."""
        return self.turns * self.iterations

    @property
    def last(self) -> int:
        """Number of snapshots of a player after its initial one."""
        return self.learnt // self.players

    def for_games(self, games: int) -> "Size":
        """Return this size with as many rivals as give about so many games."""
        fixed = 4 + 2 + self.others  # parent, 3 and 10 back, initial, two scripts and random ones
        return replace(self, rivals=max(1, round(games / GAMES / self.learnt) - fixed))

    def player(self, i: int) -> str:
        """Return the name of the player of snapshot i."""
        return PLAYERS[i] if self.players == len(PLAYERS) else f"{PLAYERS[i % 2]}-{i // 2}"

    def name(self, snapshot: int) -> str:
        """Return the name of a snapshot; the players' snapshots alternate."""
        return f"{self.player(snapshot % self.players)}@{snapshot // self.players * self.every}"

    @property
    def all_players(self) -> list[Player]:
        """The players of the league."""
        return [Player(LEAGUE, self.player(i), i % 2, "main", "rover", str(i // 2 + 1)) for i in range(self.players)]

    @property
    def settings(self) -> str:
        """Settings of the league, as TOML."""
        if self.players == len(PLAYERS):
            return configuration.dumps(CONFIG, comments=False)
        own = (PlayerSettings(PLAYERS[p.team], p.name, group=p.group) for p in self.all_players)
        return configuration.dumps(replace(CONFIG, players=tuple(own)), comments=False)


def snapshots(size: Size, digests: Sequence[str]) -> list[Snapshot]:
    """Return the scripts, then the players' snapshots, with the digest of each."""
    text, players = size.settings, size.players
    scripted = [
        Snapshot(LEAGUE, script, digests[i], "rover", script=script, origin="scripted", created=1.0)
        for i, script in enumerate(SCRIPTS)
    ]
    return scripted + [
        Snapshot(LEAGUE, size.name(i), digests[len(SCRIPTS) + i], "rover", size.player(i % players),
                 initial=i < players, iteration=i // players * size.every,
                 step=1000 * (i // players) * size.every, seconds=float(i), arena=KEY,
                 parent=size.name(i - players) if i >= players else None, settings=text, created=1.0 + i)
        for i in range(size.learnt)
    ]  # fmt: skip


def pairs(size: Size, rng: np.random.Generator) -> np.ndarray:
    """Return (rows, 2) index pairs of opponents; the players' snapshots come first, then the scripts."""
    learnt, players = size.learnt, size.players
    i = np.arange(players, learnt)
    found = [np.stack([i, i - players * back], 1)[i >= players * back] for back in (1, 3, 10)]
    found += [np.stack([i, i % players], 1)]
    found += [np.stack([i, i - back], 1)[i >= back] for back in range(1, size.rivals + 1)]
    found += [np.stack([i, learnt + rng.integers(len(SCRIPTS), size=len(i))], 1) for _ in range(2)]
    found += [np.stack([i, (rng.random(len(i)) * i).astype(int)], 1) for _ in range(size.others)]
    rows = np.concatenate(found)
    return rows[np.argsort(rows[:, 0], kind="stable")]


def log(size: Size, seed: int = 0) -> Iterator[Match]:
    """Yield the rows of a log, in the order of their snapshots."""
    rng, learnt = np.random.default_rng(seed), size.learnt
    names = [*(size.name(i) for i in range(learnt)), *SCRIPTS]
    theta = np.log2(1 + np.arange(learnt) * 2 / size.players) + rng.normal(0, 0.3, learnt)
    theta = np.append(theta, rng.normal(3, 1.0, len(SCRIPTS)))
    met = pairs(size, rng)
    for part in range(0, len(met), PART):  # so that memory does not grow with the log
        for id, row in enumerate(played(theta, met[part : part + PART], rng), part + 1):
            (a, b), home_side, (wins, draws, losses), five = row
            yield Match(LEAGUE, KEY, names[a], names[b], wins, draws, losses, 0, *home_side, PairCounts(*five),
                        seed=id, id=id, seconds=0.5, created=float(id))  # fmt: skip


def played(theta: np.ndarray, met: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[list[int], ...]]:
    """Yield for each pair its two snapshots, results at home, all results, and counts of seed pairs."""
    gap, sides = theta[met[:, 0]] - theta[met[:, 1]], []
    for sign in (1, -1):  # the first on either side
        chance = np.exp(davidson(sign * gap + 0.1, np.log(0.5)).log_likelihood).T[:, ::sign]
        sides.append((rng.random((len(met), GAMES // 2))[..., None] > chance.cumsum(1)[:, None, :]).sum(-1))
    points = 4 - (sides[0] + sides[1])  # of the first in each seed pair, in half points
    home, away, pair = (
        np.stack([(kind == k).sum(1) for k in range(most)], 1)
        for kind, most in ((sides[0], 3), (sides[1], 3), (points, 5))
    )
    yield from zip(met.tolist(), home.tolist(), (home + away).tolist(), pair.tolist(), strict=True)


def tables(size: Size, digests: Sequence[str]) -> Iterator[tuple[str, Iterator[dict]]]:
    """Yield the rows of a store, table by table, as `Store.restore` takes them; `digests` are of existing blobs."""
    away, matches, names = ("id", "holder", "lease_until"), len(pairs(size, np.random.default_rng(0))), size.all_players
    yield "leagues", iter([row_of(League(LEAGUE, size.settings)) | {"revision": 0, "matches": matches}])
    yield "players", (row_of(player) for player in names)
    last = size.last * size.every
    at = [Checkpoint(LEAGUE, p.name, digests[0], 1000 * last, last, float(last), KEY) for p in names]
    yield "checkpoints", (row_of(c) for c in at)
    yield "snapshots", (row_of(s) for s in snapshots(size, digests))
    yield "matches", (row_of(m) for m in log(size))
    values = {"score": 0.5, "reward": 0.1, "length": 200.0, "episodes": 64.0, "entropy": 1.0, "steps_per_second": 1e5}
    yield (
        "curves",
        (row_of(CurvePoint(LEAGUE, p.name, i, 1000 * i, i, values)) for i in range(1, last + 1) for p in names),
    )
    turns = (each for each in enumerate((p, turn) for turn in range(1, size.turns * size.last + 1) for p in names))
    yield "meetings", (row_of(meeting(size, p, turn, 4 * i + k)) for i, (p, turn) in turns for k in range(4))
    yield "phases", (row_of(Phase(LEAGUE, p.group, 0, (p.name, q.name), {p.name: 0, q.name: 0}))
                     for p, q in zip(names[::2], names[1::2], strict=True))  # fmt: skip
    batches = batched(((m.a, m.b) for m in log(size)), 8)
    jobs = (encode(LEAGUE, RatingMatch(tuple(batch), i), i) for i, batch in enumerate(batches))
    yield "jobs", (row_of(job, *away) | {"state": "done"} for job in jobs)


def batched(items: Iterator[Any], number: int) -> Iterator[list[Any]]:
    """Yield lists of so many items."""
    while found := list(islice(items, number)):
        yield found


def meeting(size: Size, player: Player, turn: int, id: int) -> Meeting:
    """Return the training games of a turn against one of four opponents, a recent snapshot of the other team."""
    block, place = (turn - 1) // size.turns - id % 4, (turn + 13 * id) % (size.players // 2)
    against = size.name(max(block, 0) * size.players + 2 * place + 1 - player.team)
    iteration = turn * size.iterations
    return Meeting(LEAGUE, player.name, iteration, against, 40, 10, 14, chance=0.1, pool=10, id=id + 1)


def fill(where: str, blobs: str | None, size: Size) -> None:
    """Create and fill the store."""
    with Store.open(where, create=True, blobs=blobs) as store:
        digests = [store.blobs.put(b"policy %d, which nobody reads" % i) for i in range(size.snapshots)]
        store.restore(tables(size, digests))


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
    watched = [sys.executable, "-c", WATCHED, str(out), *line]
    process = subprocess.Popen(watched, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        printed, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)  # the command too
        process.wait()
        return {"seconds": None, "above": limit}
    took, used, resident, code, *error = printed.split(maxsplit=4)
    found = {"seconds": round(float(took), 2), "processor_seconds": round(float(used), 2),
             "resident_mb": round(float(resident)), "code": int(code)}  # fmt: skip
    return found | ({"said": error[0].strip()[:200]} if int(code) else {})


def is_filled(store: str, blobs: str | None) -> bool:
    """Return whether the league is there already."""
    try:
        with Store.open(store, blobs=blobs) as opened:
            return bool(opened.leagues())
    except NotAStore:
        return False


def size_of(args: argparse.Namespace) -> Size:
    """Return the size that was asked for."""
    size = Size(args.snapshots, args.players, 1, args.others, args.turns, args.iterations)
    return size.for_games(args.games) if args.games else size


def busy() -> None:
    """Compute without end."""
    while True:
        sum(range(100_000))


def measured(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Fill the store, unless the folder has one, and time every command that was asked for."""
    out, size, start = folder / "out", size_of(args), time.perf_counter()
    store, blobs = (args.server, str(folder / "blobs")) if args.server else (str(folder / "store"), None)
    if not is_filled(store, blobs):
        fill(store, blobs, size)
    found: dict[str, Any] = {"filled_in_seconds": round(time.perf_counter() - start, 1)}
    where = ["--store", store, *(["--blobs", blobs] if blobs else [])]
    league = [sys.executable, "-m", "league"]
    asked: dict[str, list[str]] = {}
    for title, words in COMMANDS.items():
        words = [word.format(out=folder / "page.html", player=size.player(0)) for word in words]
        own = [] if title in ALONE else ["--league", LEAGUE]
        asked[title] = [*league, *words, *where, *own]
    asked["manager"] = [sys.executable, "-m", "benchmarks.manager_rounds", *where, "--league", LEAGUE]
    for title, players, rows in (("rate-million", 1000, 1_000_000), ("rate-12000-players", 12_000, 120_000)):
        if title in (args.only or [title]):
            results(folder / f"{title}.csv", players, rows)
        asked[title] = [*league, "rate", str(folder / f"{title}.csv")]
    for title, line in asked.items():
        if args.only and title not in args.only:
            continue
        (folder / "page.html").unlink(missing_ok=True)
        found[title] = timed(line, out, args.limit) | {"load_average": round(os.getloadavg()[0], 1)}
        if title == "manager" and not found[title].get("code", 1):
            found[title] |= json.loads(out.read_text())
        print(title, found[title], file=sys.stderr, flush=True)
        write({"commit": args.commit or commit(), **asdict(size), **found}, args.out)  # in case that it is cut off
    return found


def main() -> None:
    """Measure and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--snapshots", type=int, default=10_000)
    parser.add_argument("--players", type=int, default=2, help="of two teams")
    parser.add_argument("--games", type=int, help="rated games, which the newest snapshots of other players make up")
    parser.add_argument("--turns", type=int, default=1, help="of training between two snapshots of a player")
    parser.add_argument("--iterations", type=int, default=1, help="of a turn")
    parser.add_argument("--server", help="an empty database of PostgreSQL")
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
        **asdict(size_of(args)), "database": "postgresql" if args.server else "sqlite", "busy_processes": args.load,
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
