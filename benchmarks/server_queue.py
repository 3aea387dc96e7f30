"""The queue on PostgreSQL: polling of idle workers, autovacuum, and procrastinate beside it. Prints JSON.

    python -m benchmarks.server_queue --out benchmarks/results/server-queue-cpu.json
    PYTHONPATH=FOLDER python -m benchmarks.server_queue --parts procrastinate      # pip install --target FOLDER

`polling`: 200 processes that start at the same moment, and half as many jobs of one second in each second, so that
others are idle: with equal pauses between two attempts, with random ones, and with random ones that grow. `vacuum`:
four processes that claim and finish without a pause beside many done jobs, with the server's autovacuum and with
settings of the tables. `procrastinate`: equal numbers of jobs by both queues, in 200 processes with jobs of one second
and in four with empty ones. Each part has a private server, whose disk is not waited for.
"""

import argparse
import asyncio
import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from league.system import environment

environment.prepare()

import psycopg

from benchmarks.server_load import FORK, fill, measured, quantiles, window
from benchmarks.store import LEAGUE, load
from scripts.record import make_parser, report, run_info
from storage.records import Job
from storage.store import Store
from tests.faults.servers import Server

IDLE = 0.1  # seconds between two attempts, as in league/runtime/worker.py
PAUSES: dict[str, Callable[[int], float]] = {  # seconds after so many attempts in vain
    "equal": lambda _: IDLE,
    "random": lambda _: IDLE * random.uniform(0.5, 1.5),
    "growing": lambda tries: min(1.0, IDLE * 1.5 ** min(tries, 10)) * random.uniform(0.5, 1.5),
}
TABLES = ("jobs", "leagues", "workers")
VACUUM = "ALTER TABLE {table} SET (autovacuum_vacuum_scale_factor = 0.02, autovacuum_vacuum_cost_delay = 0)"


def poll(place: tuple[str, str], pause: str, number: int, start: Any, seconds: float, done: Any) -> None:
    """Claim jobs of a second for `seconds`, and pause after an attempt in vain; put times and waits."""
    random.seed(number)
    with Store.open(place[0], blobs=place[1]) as store:
        store.now()  # connects
        start.wait()
        until, tries, claims, waits, attempts = time.monotonic() + seconds, 0, [], [], 0
        while time.monotonic() < until:
            begun = time.perf_counter()
            claimed = store.claim(LEAGUE, ["any"], f"here:{number}:any", 60)
            claims.append(1000 * (time.perf_counter() - begun))
            attempts += 1
            if claimed is None:
                time.sleep(PAUSES[pause](tries))
                tries += 1
                continue
            tries = 0
            waits.append(time.time() - claimed[1].payload["queued"])
            time.sleep(1.0)
            store.finish(claimed[0])
    done.put((claims, waits, attempts))


@contextmanager
def sampled(url: str) -> Iterator[list[int]]:
    """Yield a list that grows by the number of sessions that wait for a lock, ten times a second."""
    found: list[int] = []
    ended = threading.Event()

    def sample() -> None:
        with psycopg.connect(url, autocommit=True) as db:
            while not found or not ended.wait(0.1):
                waiting = db.execute("SELECT count(*) FROM pg_stat_activity WHERE wait_event_type = 'Lock'").fetchone()
                found.append(waiting[0] if waiting else 0)

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        yield found
    finally:
        ended.set()
        thread.join()


def polling(server: Server, args: argparse.Namespace, folder: Path) -> dict:
    """Measure idle workers that start at once, by their pauses."""
    found: dict[str, Any] = {"workers": args.workers, "seconds": args.seconds}
    for _ in range(args.rounds):
        for name in PAUSES:
            found.setdefault(name, []).append(_polled(server, args, folder, name, len(found.get(name, []))))
    return found


def _polled(server: Server, args: argparse.Namespace, folder: Path, name: str, number: int) -> dict:
    url = server.url(f"polling_{name}_{number}")
    place = (url, str(folder))
    fill(place, 0)
    start, done = FORK.Barrier(args.workers + 1), FORK.Queue()
    each = [FORK.Process(target=poll, args=(place, name, i, start, args.seconds, done)) for i in range(args.workers)]
    for process in each:
        process.start()
    with Store.open(url, blobs=place[1]) as store, sampled(url) as locks:
        start.wait()
        for second in range(int(args.seconds) - 1):
            begun = time.monotonic()
            payload = {"queued": time.time()}
            store.queue([Job(LEAGUE, "any", f"{second}.{n}", payload) for n in range(args.workers // 2)])
            time.sleep(max(0.0, begun + 1.0 - time.monotonic()))
    took = [done.get(timeout=args.seconds + 240) for _ in each]
    for process in each:
        process.join()
    claims, waits = ([ms for one in took for ms in one[i]] for i in (0, 1))
    return {
        "jobs": len(waits), "attempts_per_second": round(sum(one[2] for one in took) / args.seconds, 1),
        "claim_ms": quantiles(claims),
        "queued_ms": quantiles([1000 * wait for wait in waits]) if waits else "no job was done",
        "waiting_for_a_lock": {"mean": round(sum(locks) / len(locks), 2), "max": max(locks)}, "load_average": load(),
    }  # fmt: skip


def vacuum(server: Server, args: argparse.Namespace, folder: Path) -> dict:
    """Measure the server's autovacuum against settings of the tables, beside many jobs that are done."""
    found: dict[str, Any] = {"done_jobs": args.done, "seconds_of_a_window": args.vacuum_window}
    for name in ("default", "tables"):
        url = server.url(f"vacuum_{name}")
        place = (url, str(folder))
        fill(place, args.jobs)
        with psycopg.connect(url, autocommit=True) as db:
            _add_done(db, args.done)
            if name == "tables":
                for table in TABLES:
                    db.execute(VACUUM.format(table=table))
            db.execute("ANALYZE")
            windows = [window(place, url, 4, args.vacuum_window, 0.0) for _ in range(args.vacuum_windows)]
            names = "relname, autovacuum_count, n_dead_tup, pg_total_relation_size(relid) / 1048576"
            rows = db.execute(f"SELECT {names} FROM pg_stat_user_tables WHERE relname = ANY(%s)", [list(TABLES)])
            tables = {row[0]: {"autovacuums": row[1], "dead_rows": row[2], "MiB": row[3]} for row in rows.fetchall()}
        found[name] = {"windows": windows, "tables": tables}
    return found


def _add_done(db: psycopg.Connection, number: int) -> None:
    """Add jobs that were done long ago, as copies of a queued one."""
    columns = [c for (c,) in db.execute(
        "SELECT column_name FROM information_schema.columns WHERE table_name = 'jobs' AND column_name <> 'id'"
    ).fetchall()]  # fmt: skip
    other = {"key": "'done ' || n", "state": "'done'"}
    values = ", ".join(other.get(name, f'"{name}"') for name in columns)
    names = ", ".join(f'"{name}"' for name in columns)
    db.execute(
        f"INSERT INTO jobs ({names}) SELECT {values} FROM (SELECT * FROM jobs LIMIT 1) AS one,"
        f" generate_series(1, {number}) AS n"
    )


def procrastinate(server: Server, args: argparse.Namespace, folder: Path) -> dict:
    """Measure both queues with equal jobs."""
    from importlib.metadata import version

    found: dict[str, Any] = {"procrastinate": version("procrastinate"), "seconds": args.seconds}
    for workers, pause in ((args.workers, 1.0), (4, 0.0)):
        jobs = int(workers * (args.seconds + 2)) if pause else args.jobs
        for number in range(args.rounds):
            url = server.url(f"ours_{workers}_{number}")
            place = (url, str(folder))
            fill(place, jobs)
            ours = window(place, url, workers, args.seconds, pause)["jobs_per_second"]
            theirs = _theirs(server.url(f"theirs_{workers}_{number}"), jobs, workers, args.seconds, pause)
            found.setdefault(f"{workers} workers, jobs of {pause:g} s", []).append(
                {"ours": ours, "theirs": theirs, "ratio": round(ours / theirs, 2), "load_average": load()}
            )
    return found


def _theirs(url: str, jobs: int, workers: int, seconds: float, pause: float) -> float:
    """Return the jobs per second of procrastinate's workers, one job at a time in each process."""
    with _app(url, pause).open() as app:
        app.schema_manager.apply_schema()
    with psycopg.connect(url, autocommit=True) as db:
        db.execute(
            "INSERT INTO procrastinate_jobs (queue_name, task_name, args) SELECT 'default', 'job', '{}'"
            f" FROM generate_series(1, {jobs})"
        )
    start = FORK.Barrier(workers + 1)
    each = [FORK.Process(target=_run, args=(url, pause, start, seconds)) for _ in range(workers)]
    for process in each:
        process.start()
    start.wait()
    time.sleep(seconds)
    with psycopg.connect(url, autocommit=True) as db:
        done = db.execute("SELECT count(*) FROM procrastinate_jobs WHERE status = 'succeeded'").fetchone()
    for process in each:
        process.join()
    return round((done[0] if done else 0) / seconds, 1)


def _app(url: str, pause: float) -> Any:
    from procrastinate import App, PsycopgConnector

    app = App(connector=PsycopgConnector(conninfo=url, min_size=1, max_size=2))

    @app.task(name="job")
    async def job() -> None:
        if pause:
            await asyncio.sleep(pause)

    return app


def _run(url: str, pause: float, start: Any, seconds: float) -> None:
    """Run a worker of procrastinate for a while."""

    async def work() -> None:
        app = _app(url, pause)
        async with app.open_async():
            start.wait()
            worker = asyncio.create_task(
                app.run_worker_async(concurrency=1, install_signal_handlers=False, shutdown_graceful_timeout=1)
            )
            await asyncio.sleep(seconds + 1)
            worker.cancel()
            await asyncio.gather(worker, return_exceptions=True)

    asyncio.run(work())


def main() -> None:
    """Measure and print the JSON."""
    parts: dict[str, Callable[..., dict]] = {"polling": polling, "vacuum": vacuum, "procrastinate": procrastinate}
    parser = make_parser(__doc__)
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--seconds", type=float, default=10.0, help="of a window")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--workers", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=100_000, help="queued where workers do not pause")
    parser.add_argument("--done", type=int, default=500_000, help="jobs that are done, in `vacuum`")
    parser.add_argument("--vacuum-window", type=float, default=20.0, help="seconds")
    parser.add_argument("--vacuum-windows", type=int, default=10)
    args = parser.parse_args()
    found = measured(parts, args, 3 * args.workers + 50)  # before run_info, which loads JAX into this process
    report({**run_info(args.commit), **found}, args.out)


if __name__ == "__main__":
    main()
