"""PostgreSQL under a foreign transaction that stays open, and under many workers. Prints JSON.

    python -m benchmarks.server_load --out benchmarks/results/server-load-cpu.json

`held`: four processes claim jobs and finish each at once or after `--pause`, in windows; before the second phase
another client opens a transaction, reads the jobs in it and stays idle, as a dump or a forgotten session does; in the
third it has ended. `crowd`: 200 processes, each with a job of one second at a time, which all start at the same moment;
directly and through PgBouncer with 20 sessions of the server. `turn`: a process far from the server ends turns of two
players, with checkpoints, snapshots, curves of 16 iterations and games; another one near it locks the league's row
again and again, and the longest that it waits is how long the turn's end held the row. Each uses a private server,
whose disk is not waited for.
"""

import argparse
import gc
import multiprocessing
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from league.system import environment

environment.prepare()

import numpy as np
import psycopg

from benchmarks.store import LEAGUE, load
from scripts.record import make_parser, report, run_info
from storage.records import ArenaKey, Checkpoint, CurvePoint, Job, League, Meeting, Player, Snapshot
from storage.store import Store
from tests.faults.servers import Bouncer, Line, Server

ITERATIONS = 16  # of a turn
KEY = ArenaKey("sumo-1v1", "0", "c")
FORK = multiprocessing.get_context("fork")


def work(place: tuple[str, str], number: int, start: Any, seconds: float, pause: float, done: Any) -> None:
    """Claim jobs and finish each after `pause` seconds, for `seconds`; put the ms of every claim and finish."""
    with Store.open(place[0], blobs=place[1]) as store:
        store.now()  # connects
        start.wait()
        until, took = time.monotonic() + seconds, ([], [])
        while time.monotonic() < until:
            begun = time.perf_counter()
            claimed = store.claim(LEAGUE, ["any"], f"here:{number}:any", 60)
            took[0].append(1000 * (time.perf_counter() - begun))
            assert claimed is not None, "the queue is too short"
            time.sleep(pause)
            begun = time.perf_counter()
            store.finish(claimed[0])
            took[1].append(1000 * (time.perf_counter() - begun))
    done.put(took)


def fill(place: tuple[str, str], jobs: int) -> None:
    """Make a store with a league and so many queued jobs."""
    with Store.open(place[0], create=True, blobs=place[1]) as store:
        store.create_league(League(LEAGUE, ""))
        for first in range(0, jobs, 1000):
            store.queue([Job(LEAGUE, "any", str(i)) for i in range(first, min(jobs, first + 1000))])


def window(place: tuple[str, str], direct: str, workers: int, seconds: float, pause: float) -> dict:
    """Return jobs per second, latencies, and what the server counts, of so many processes on a full queue.

    `direct` is the URL of the store without a pooler.
    """
    before = counted(direct)
    gc.collect()
    gc.freeze()  # else each forked process copies the memory of this one when it collects garbage
    start, done = FORK.Barrier(workers), FORK.Queue()
    processes = [FORK.Process(target=work, args=(place, i, start, seconds, pause, done)) for i in range(workers)]
    for process in processes:
        process.start()
    took = [done.get(timeout=seconds + 240) for _ in processes]
    for process in processes:
        process.join()
    after = counted(direct)
    claims, finishes = ([ms for each in took for ms in each[i]] for i in (0, 1))
    return {
        "jobs_per_second": round(len(finishes) / seconds, 1),
        "claims_per_second": round(len(claims) / seconds, 1), "claim_ms": quantiles(claims),
        "finish_ms": quantiles(finishes),
        "pages_per_job": round((after["pages"] - before["pages"]) / len(finishes), 1),
        "dead_rows": {name: after[name] for name in ("jobs", "leagues")}, "load_average": load(),
    }  # fmt: skip


def quantiles(values: list[float]) -> dict[str, float]:
    """Return the median, the 95 % and the 99 % quantile, and the maximum."""
    of = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
    return {name: round(float(np.quantile(values, q)), 1) for name, q in of.items()}


def counted(url: str) -> dict[str, int]:
    """Return the dead rows of the tables with many updates, and the pages that the server has touched so far."""
    with psycopg.connect(url, autocommit=True) as db:
        time.sleep(1.5)  # statistics are reported with a delay
        names = "SELECT relname, n_dead_tup FROM pg_stat_user_tables WHERE relname IN ('jobs', 'leagues')"
        pages = "SELECT 'pages', blks_hit + blks_read FROM pg_stat_database WHERE datname = current_database()"
        return dict(db.execute(f"{names} UNION ALL {pages}").fetchall())


def held(server: Server, args: argparse.Namespace, folder: Path) -> dict:
    """Measure claims before, while and after another client's transaction is open."""
    url = server.url("held")
    place = (url, str(folder))
    fill(place, args.jobs)
    phases: dict[str, Any] = {}

    def phase(name: str, windows: int) -> None:
        phases[name] = []
        for _ in range(windows):
            phases[name].append(window(place, url, 4, args.seconds, args.pause))

    phase("before", 2)
    with psycopg.connect(url, application_name="pg_dump") as other:
        other.isolation_level = psycopg.IsolationLevel.REPEATABLE_READ
        other.execute("SELECT count(*) FROM jobs")
        phase("open", args.windows)
    with psycopg.connect(url, autocommit=True) as db:
        db.execute("VACUUM jobs, leagues")
    phase("ended", 2)
    return {"workers": 4, "seconds_of_a_window": args.seconds, "seconds_of_a_job": args.pause, "phases": phases}


def crowd(server: Server, args: argparse.Namespace, folder: Path) -> dict:
    """Measure workers that start at once, directly and through PgBouncer."""
    found: dict[str, Any] = {"workers": args.workers, "job_seconds": 1.0, "seconds": args.crowd_seconds}
    server.connections = args.workers + 50
    server.stop("fast")
    server.start()
    pool = Bouncer(folder / "pool", server.port, default_pool_size="20")
    try:
        for name, port in (("direct", server.port), ("pgbouncer", pool.port)):
            place, direct = (server.url(f"crowd_{name}", port), str(folder)), server.url(f"crowd_{name}")
            fill(place, int(args.workers * (args.crowd_seconds + 2)))
            found[name] = window(place, direct, args.workers, args.crowd_seconds, 1.0)
    finally:
        pool.stop()
    return found


def turn(server: Server, args: argparse.Namespace, folder: Path) -> dict:
    """Measure how long the end of a turn takes and holds the league's row, by the round trip to the server."""
    return {f"round_trip_{ms:g}_ms": _turns(server, ms, args.turns, folder) for ms in args.round_trips}


def _turns(server: Server, round_trip: float, turns: int, folder: Path) -> dict:
    name = f"turn_{round_trip:g}".replace(".", "_")
    place = (server.url(name), str(folder / name))
    fill(place, turns)
    line, took, held, bases = Line(server.port, round_trip / 2000), [], [], {}
    try:
        with Store.open(server.url(name, line.port), blobs=place[1]) as store:
            store.add_players([Player(LEAGUE, p, side, "main", "rover") for side, p in enumerate(("blue", "red"))])
            for number in range(turns):
                claimed = store.claim(LEAGUE, ["any"], "here:1:any", 60)
                assert claimed is not None
                results = _results(store, number)
                with _locking(place[0]) as waits:
                    begun = time.perf_counter()
                    store.finish(claimed[0], bases=bases, **results)
                    took.append(1000 * (time.perf_counter() - begun))
                held.append(max(waits))
                bases = {each.player: each.digest for each in results["checkpoints"]}
    finally:
        line.cut()
    return {"turns": turns, "took_ms": quantiles(took), "held_ms": quantiles(held), "load_average": load()}


def _results(store: Store, number: int) -> dict[str, Any]:
    """Return the results of a turn of blue and red."""
    last, values = ITERATIONS * (number + 1), {"score": 0.5, "reward": 0.1, "length": 200.0, "entropy": 1.0}
    digests = {p: store.blobs.put(f"{p} {number}".encode()) for p in ("blue", "red")}
    counts = {"step": 1000 * last, "iteration": last, "seconds": float(last), "arena": KEY}
    return {
        "checkpoints": [Checkpoint(LEAGUE, p, digest, **counts) for p, digest in digests.items()],
        "snapshots": [Snapshot(LEAGUE, f"{p}@{last}", d, "rover", p, **counts) for p, d in digests.items()],
        "curves": [
            CurvePoint(LEAGUE, p, i, 1000 * i, float(i), values)
            for p in digests for i in range(last - ITERATIONS + 1, last + 1)
        ],
        "meetings": [Meeting(LEAGUE, p, last, "nobody", 40, 10, 14, chance=0.1, pool=1) for p in digests] * 4,
        "keep": 3,
    }  # fmt: skip


@contextmanager
def _locking(url: str) -> Iterator[list[float]]:
    """Lock the league's row without a pause during the block; yield the ms that each lock took."""
    waits, begun, ended = list[float](), threading.Event(), threading.Event()

    def lock() -> None:
        with psycopg.connect(url, autocommit=True) as db:
            while not (waits and ended.is_set()):
                start = time.perf_counter()
                db.execute("SELECT 1 FROM leagues FOR NO KEY UPDATE")
                waits.append(1000 * (time.perf_counter() - start))
                begun.set()
                time.sleep(0.0002)

    thread = threading.Thread(target=lock)
    thread.start()
    begun.wait()
    waits.clear()
    try:
        yield waits
    finally:
        ended.set()
        thread.join()


def measured(parts: dict[str, Callable[..., dict]], args: argparse.Namespace, connections: int = 0) -> dict[str, Any]:
    """Return the results of the parts that are asked for, each on a server of its own.

    `connections` is the number that the server admits; 0: its default.
    """
    result: dict[str, Any] = {}
    for name in args.parts:
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made)
            folder.chmod(0o755)  # PostgreSQL's user needs access
            Server.connections = connections or Server.connections  # it starts at once
            server = Server(folder / "server")
            server.settle(fsync="off")
            try:
                result[name] = parts[name](server, args, folder)
            finally:
                server.stop()
    return result


def main() -> None:
    """Measure and print the JSON."""
    parts: dict[str, Callable[..., dict]] = {"held": held, "crowd": crowd, "turn": turn}
    parser = make_parser(__doc__)
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--seconds", type=float, default=10.0, help="of a window with or without the transaction")
    parser.add_argument("--windows", type=int, default=12, help="while the transaction is open")
    parser.add_argument("--pause", type=float, default=0.0, help="seconds that a job of `held` takes")
    parser.add_argument("--jobs", type=int, default=30_000, help="queued at the start of `held`")
    parser.add_argument("--workers", type=int, default=200)
    parser.add_argument("--crowd-seconds", type=float, default=30.0)
    parser.add_argument("--turns", type=int, default=30)
    parser.add_argument("--round-trips", type=float, nargs="+", default=[1.0, 20.0], help="ms")
    args = parser.parse_args()
    found = measured(parts, args)  # before run_info, which loads JAX into this process
    report({**run_info(args.commit), **found}, args.out)


if __name__ == "__main__":
    main()
