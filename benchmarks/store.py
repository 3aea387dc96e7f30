"""A store under load: jobs per second, queries, size, and the resources of a manager. Prints JSON.

    python -m benchmarks.store [--server postgresql://...] [--out benchmarks/results/store-cpu.json]

The store has ten leagues of a thousand snapshots each; one has 100,000 matches and 10,000,000 episodes. Jobs are
claimed and finished, each with one match row, by 1, 8 and 32 processes at once. A query is timed from the start of its
process to its end. The manager is a real one; its workers are simulated here, with a turn about every two seconds and
every rating batch that it queues. CPU time, of all threads, stands beside wall-clock time: on a machine with other work
it is the more reliable one.
"""

import argparse
import multiprocessing
import os
import resource
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from league.system import environment

environment.prepare()  # as every command does, before NumPy is loaded: one BLAS thread

import numpy as np
import sqlalchemy as sa

from benchmarks.ratings import KEY, name, simulate
from league.config import experiment as configuration
from league.runtime.manager import Manager
from league.state.jobs import RatingMatch, TrainingTurn, decode, encode
from scripts.record import make_parser, report, run_info, spread
from storage.database.rows import row_of
from storage.records import Checkpoint, CurvePoint, Job, League, Match, PairCounts, Player, Snapshot
from storage.store import Store

LEAGUE, PLAYERS = "bench", ("blue", "red")
EPISODES, PAIRS = 100, 8  # of a match, of a rating job
WORKERS = (1, 8, 32)
PARTS = ("queries", "manager", "jobs")
ASKED = {"sqlite": 200, "postgresql": 500}  # targets: jobs per second with 8 workers
QUERIES = {"matches": 1.0, "ratings": 1.0, "status": 0.6}  # targets in seconds
SHARE, RESIDENT = 0.02, 300  # targets of the manager: share of a core, MB
CONFIG = configuration.loads(f'league = "{LEAGUE}"\n[arena]\nname = "sumo-1v1"\n[training]\nworlds = 64\n')
SPAWN, FORK = multiprocessing.get_context("spawn"), multiprocessing.get_context("fork")


class Place(NamedTuple):
    """URL or folder of a store, and the folder of its blobs."""

    where: str
    blobs: str


def leagues(each: int, number: int) -> list[tuple[str, list[Snapshot]]]:
    """Return leagues with their snapshots; the snapshots' blobs do not exist."""
    text = configuration.dumps(CONFIG)
    return [
        (league, [
            Snapshot(league, name(i), f"{i:064x}", "rover", PLAYERS[i % 2], initial=i < 2, iteration=i // 2, arena=KEY,
                     parent=name(i - 2) if i > 1 else None, settings=text, created=1.0 + i)
            for i in range(each)
        ])
        for league in (LEAGUE, *(f"other-{i}" for i in range(1, number)))
    ]  # fmt: skip


def tables(snapshots: int, number: int, matches: int) -> Iterator[tuple[str, Iterator[dict]]]:
    """Yield the rows of a store, table by table, in the form that `Store.restore` takes."""
    filled = leagues(snapshots, number)
    log = simulate(snapshots, matches * EPISODES, np.random.default_rng(0), EPISODES)[0]
    jobs = [
        encode(LEAGUE, RatingMatch(tuple((m.a, m.b) for m in log[i : i + PAIRS]), i), i)
        for i in range(0, len(log), PAIRS)
    ]
    text, away = configuration.dumps(CONFIG), ("id", "holder", "lease_until")
    yield "leagues", ({**row_of(League(n, text)), "revision": 0, "matches": matches * (n == LEAGUE)} for n, _ in filled)
    yield "players", (row_of(Player(n, p, i, "main", "rover")) for n, _ in filled for i, p in enumerate(PLAYERS))
    yield "checkpoints", (row_of(c) for c in checkpoints(snapshots // 2, "0" * 64))
    yield "snapshots", (row_of(s) for _, some in filled for s in some)
    yield "matches", (row_of(replace(m, id=i, seconds=0.5, created=float(i))) for i, m in enumerate(log, 1))
    yield "curves", (row_of(p) for i in range(1, snapshots // 2 + 1) for p in curves(i))
    yield "jobs", (row_of(replace(job, state="done"), *away) for job in jobs)


def checkpoints(iteration: int, digest: str) -> list[Checkpoint]:
    """Return a checkpoint of each player."""
    return [Checkpoint(LEAGUE, p, digest, 1000 * iteration, iteration, float(iteration), KEY) for p in PLAYERS]


def curves(iteration: int) -> list[CurvePoint]:
    """Return a point of each player's learning curve."""
    values = {"score": 0.5, "reward": 0.1, "length": 200.0, "episodes": 64.0, "entropy": 1.0}
    return [CurvePoint(LEAGUE, p, iteration, 1000 * iteration, float(iteration), values) for p in PLAYERS]


# Jobs per second


def work(place: Place, holder: str, gates: tuple[Any, Any], seconds: float, done: Any) -> None:
    """Claim and finish jobs for `seconds`; put (number finished, seconds, CPU seconds) into the queue `done`."""
    with Store.open(place.where, blobs=place.blobs) as store:
        store.now()  # connects
        ready, go = gates
        ready.release()
        go.wait()
        start, count = time.monotonic(), 0
        before = processor(resource.RUSAGE_SELF)
        while time.monotonic() - start < seconds and (claimed := store.claim(LEAGUE, ["any"], holder, 60)):
            store.finish(claimed[0], matches=[match(claimed[1].id)])
            count += 1
        done.put((count, time.monotonic() - start, processor(resource.RUSAGE_SELF) - before))


def match(seed: int) -> Match:
    """Return a match row whose pair depends on the seed."""
    names = name(2 * (seed % 40)), name(2 * (seed % 30) + 1)
    return Match(LEAGUE, KEY, *names, 1, 0, 1, 0, 1, 0, 0, PairCounts(), seed)


def throughput(store: Store, place: Place, workers: int, seconds: float) -> dict:
    """Return jobs/s claimed and finished by this number of processes on a full queue."""
    run = secrets.token_hex(4)
    store.queue([Job(LEAGUE, "any", f"{run}:{i}") for i in range(int(1000 * seconds))])
    gates, done = (FORK.Semaphore(0), FORK.Event()), FORK.Queue()
    arguments = [(place, f"here:{i}:any", gates, seconds, done) for i in range(workers)]
    store.close()
    processes = [FORK.Process(target=work, args=each) for each in arguments]
    for process in processes:
        process.start()
    for _ in processes:
        gates[0].acquire()
    disk = fsync_ms(place)
    gates[1].set()
    found = np.array([done.get() for _ in processes])
    for process in processes:
        process.join()
    return {
        "workers": workers, "jobs_per_second": round(float(found[:, 0].sum() / found[:, 1].max()), 1),
        "jobs": int(found[:, 0].sum()),
        "workers_processor_ms_per_job": round(float(1000 * found[:, 2].sum() / max(1, found[:, 0].sum())), 2),
        "fsync_ms_just_before": disk, "load_average": load(),
    }  # fmt: skip


def fsync_ms(place: Place) -> dict:
    """Return the time of writing and syncing a page of 4 kB, in ms."""
    took = []
    with tempfile.TemporaryFile(dir=place.blobs) as file:
        for _ in range(20):
            start = time.perf_counter()
            os.pwrite(file.fileno(), b"x" * 4096, 4096 * len(took))
            os.fsync(file.fileno())
            took.append(1000 * (time.perf_counter() - start))
    return spread(took, 2)


def load() -> float:
    """Return the load average of the last minute."""
    return round(os.getloadavg()[0], 1)


def processor(whose: int) -> float:
    """Return CPU seconds of this process or its children, see `resource.getrusage`."""
    used = resource.getrusage(whose)
    return used.ru_utime + used.ru_stime


# Queries and the manager


WATCHED = """
import resource, subprocess, sys, time
start = time.perf_counter()
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
took, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
print(took, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""  # in a process of its own: the memory of a child includes what its parent had when it forked


def query(place: Place, command: str, asked: float, repeats: int) -> dict:
    """Time a command from the start of its process to its end."""
    line = [sys.executable, "-m", "league", command, "--store", place.where, "--blobs", place.blobs, "--league", LEAGUE]
    found = []
    for _ in range(repeats + 1):  # the first compiles byte code and fills the caches
        done = subprocess.run([sys.executable, "-c", WATCHED, *line], check=True, capture_output=True, text=True)
        found.append([float(word) for word in done.stdout.split()])
    walls, processors, resident = zip(*found[1:], strict=True)
    return {
        "asked_seconds": asked, "seconds": spread(walls), "processor_seconds": spread(processors),
        "resident_mb": round(max(resident)), "load_average": load(),
    }  # fmt: skip


def manage(place: Place) -> None:
    """Run a manager that starts no workers."""
    with Store.open(place.where, blobs=place.blobs) as store:
        manager = Manager(store, place.where, CONFIG)
        manager._slots.clear()
        manager.run(lambda *_: None)


def managed(store: Store, place: Place, seconds: float) -> dict:
    """Measure a manager's CPU share and memory while a turn ends every two seconds and every rating batch is played."""
    process = SPAWN.Process(target=manage, args=(place,))
    process.start()
    simulate_workers(store, time.monotonic() + 10)
    used, since = seconds_of(process.pid), time.monotonic()
    turns, batches = simulate_workers(store, since + seconds)
    share = (seconds_of(process.pid) - used) / (time.monotonic() - since)
    status = Path(f"/proc/{process.pid}/status").read_text()
    resident = {key: round(int(status.split(f"{key}:")[1].split()[0]) / 1024) for key in ("VmRSS", "VmHWM")}
    store.ask_stop(LEAGUE)
    process.join()
    return {
        "asked": {"share_of_a_core": SHARE, "resident_mb": RESIDENT}, "share_of_a_core": round(share, 4),
        "resident_mb": resident["VmRSS"], "resident_at_most_mb": resident["VmHWM"], "seconds": seconds,
        "turns": turns, "rating_batches": batches, "load_average": load(),
    }  # fmt: skip


def simulate_workers(store: Store, until: float) -> tuple[int, int]:
    """Finish jobs as workers would, until that monotonic time; return the numbers of turns and of rating batches."""
    turns = batches = 0
    while time.monotonic() < until:
        time.sleep(1.5)
        if claimed := store.claim(LEAGUE, ["train"], "here:1:train", 60):
            at = store.newest_checkpoints(LEAGUE)["blue"].iteration + 1
            blob, task = store.blobs.put(f"state {at}".encode()), decode(claimed[1])
            assert isinstance(task, TrainingTurn)
            kept = {"checkpoints": checkpoints(at, blob), "curves": curves(at), "keep": 8}
            store.finish(claimed[0], bases=task.bases, **kept)
            turns += 1
        if claimed := store.claim(LEAGUE, ["match"], "here:2:match", 60):
            task = decode(claimed[1])
            assert isinstance(task, RatingMatch)
            log = [replace(match(i), a=a, b=b, due=task.due, seconds=1.0) for i, (a, b) in enumerate(task.lineups)]
            store.finish(claimed[0], matches=log)
            batches += 1
    return turns, batches


def seconds_of(pid: int | None) -> float:
    """Return the CPU seconds of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# Main


def size(store: Store, place: Place) -> int:
    """Return the size of the database in bytes, without blobs."""
    if "://" not in place.where:
        return sum(path.stat().st_size for path in Path(place.where).glob("league.db*"))
    engine = sa.create_engine(sa.make_url(place.where).set(drivername="postgresql+psycopg"))
    with engine.connect() as db:
        schema = "SELECT sum(pg_total_relation_size(c.oid)) FROM pg_class c WHERE relkind = 'r' AND relnamespace ="
        return int(db.execute(sa.text(f"{schema} current_schema()::regnamespace")).scalar_one())


def measured(place: Place, backend: str, args: argparse.Namespace) -> dict:
    """Fill a store and measure the parts that were asked for."""
    with Store.open(place.where, create=True, blobs=place.blobs) as store:
        store.blobs.put(b"creates the folder")
        start = time.perf_counter()
        store.restore(tables(args.snapshots // args.leagues, args.leagues, args.matches))
        found: dict[str, Any] = {"filled_in_seconds": round(time.perf_counter() - start, 1)}
        found["database_mb"] = round(size(store, place) / 1e6)
        if "queries" in args.parts:
            found["queries"] = {c: query(place, c, asked, args.repeats) for c, asked in QUERIES.items()}
        if "manager" in args.parts:
            found["manager"] = managed(store, place, args.seconds * 4)
        if "jobs" in args.parts:
            found["asked_jobs_per_second_with_8_workers"] = ASKED[backend]
            found["jobs"] = [throughput(store, place, workers, args.seconds) for workers in WORKERS]
        return found


def main() -> None:
    """Measure and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--server", help="URL of a PostgreSQL server; a new schema is used and dropped")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--snapshots", type=int, default=10_000)
    parser.add_argument("--leagues", type=int, default=10)
    parser.add_argument("--matches", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    result: dict[str, Any] = {
        "load_average_at_start": load(),
        "snapshots": args.snapshots, "leagues": args.leagues, "matches": args.matches,
        "episodes": args.matches * EPISODES,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        result["sqlite"] = measured(Place(f"{folder}/store", f"{folder}/store/blobs"), "sqlite", args)
    if args.server:
        with tempfile.TemporaryDirectory() as folder:
            for url in schema(args.server):
                result["postgresql"] = measured(Place(url, folder), "postgresql", args)
    report({**run_info(args.commit), **result}, args.out)


def schema(server: str) -> Iterator[str]:
    """Yield a URL that uses a new schema, which is dropped at the end."""
    url, new = sa.make_url(server).set(drivername="postgresql+psycopg"), f"bench_{secrets.token_hex(4)}"
    engine = sa.create_engine(url)
    with engine.begin() as db:
        db.execute(sa.schema.CreateSchema(new))
    try:
        yield url.update_query_dict({"options": f"-csearch_path={new}"}).render_as_string(hide_password=False)
    finally:
        with engine.begin() as db:
            db.execute(sa.schema.DropSchema(new, cascade=True))


if __name__ == "__main__":
    main()
