"""How a store bears load: jobs per second, queries, size, and what a manager takes beside it. Prints JSON.

    python benchmarks/store.py [--server postgresql://...] [--out benchmarks/results/store-cpu.json]

A store is filled with ten leagues of a thousand snapshots each; one has 100,000 matches and 10,000,000 episodes. Jobs
are claimed and finished, each with one match row, by 1, 8 and 32 processes at once; a query is timed from the start of
its process to its end; the manager is a real one, whose workers are played here: a turn about every two seconds, and
every rating batch that it asks for. Beside wall time stands processor time, of all threads: on a machine with other
work it tells more.
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

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder has an arenas.py too

from league import environment  # noqa: E402

environment.prepare()  # as every command does, before NumPy is loaded: one BLAS thread

import numpy as np  # noqa: E402
import sqlalchemy as sa  # noqa: E402

from benchmarks.ratings import KEY, name, simulate  # noqa: E402
from benchmarks.record import commit, machine, spread, tell  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.daemon import Manager  # noqa: E402
from league.jobs import RatingMatch, TrainingTurn, decode, encode  # noqa: E402
from storage.records import Checkpoint, CurvePoint, Job, League, Match, PairCounts, Player, Snapshot  # noqa: E402
from storage.rows import row_of  # noqa: E402
from storage.store import Store  # noqa: E402

LEAGUE, PLAYERS = "bench", ("blue", "red")
EPISODES, PAIRS = 100, 8  # of a match, of a rating job
WORKERS = (1, 8, 32)
PARTS = ("queries", "manager", "jobs")
ASKED = {"sqlite": 200, "postgresql": 500}  # jobs per second with 8 workers
QUERIES = {"matches": 1.0, "ratings": 1.0, "status": 0.6}  # seconds asked
SHARE, RESIDENT = 0.02, 300  # of a core, MB: asked of the manager
CONFIG = configuration.loads(f'league = "{LEAGUE}"\n[arena]\nname = "sumo-1v1"\n[training]\nworlds = 64\n')
SPAWN, FORK = multiprocessing.get_context("spawn"), multiprocessing.get_context("fork")


class Place(NamedTuple):
    """Where a store is, and its blobs."""

    where: str
    blobs: str


def leagues(each: int, number: int) -> list[tuple[str, list[Snapshot]]]:
    """Leagues with their snapshots, whose bytes nobody reads here."""
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
    """The rows of a store, table by table, as they travel from store to store."""
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
    return [Checkpoint(LEAGUE, p, digest, 1000 * iteration, iteration, float(iteration), KEY) for p in PLAYERS]


def curves(iteration: int) -> list[CurvePoint]:
    values = {"score": 0.5, "reward": 0.1, "length": 200.0, "episodes": 64.0, "entropy": 1.0}
    return [CurvePoint(LEAGUE, p, iteration, 1000 * iteration, float(iteration), values) for p in PLAYERS]


# Jobs per second


def work(place: Place, holder: str, gates: tuple[Any, Any], seconds: float, done: Any) -> None:
    """Claim and finish for that time; tells when how many were finished, and the seconds of the processor."""
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
    names = name(2 * (seed % 40)), name(2 * (seed % 30) + 1)
    return Match(LEAGUE, KEY, *names, 1, 0, 1, 0, 1, 0, 0, PairCounts(), seed)


def throughput(store: Store, place: Place, workers: int, seconds: float) -> dict:
    """Jobs claimed and finished in that time by so many processes, on a full queue."""
    run = secrets.token_hex(4)
    store.queue([Job(LEAGUE, "any", f"{run}:{i}") for i in range(int(1000 * seconds))])
    gates, done = (FORK.Semaphore(0), FORK.Event()), FORK.Queue()
    told = [(place, f"here:{i}:any", gates, seconds, done) for i in range(workers)]
    store.close()
    processes = [FORK.Process(target=work, args=each) for each in told]
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
    """What the disk takes until a page is on it."""
    took = []
    with tempfile.TemporaryFile(dir=place.blobs) as file:
        for _ in range(20):
            start = time.perf_counter()
            os.pwrite(file.fileno(), b"x" * 4096, 4096 * len(took))
            os.fsync(file.fileno())
            took.append(1000 * (time.perf_counter() - start))
    return spread(took, 2)


def load() -> float:
    return round(os.getloadavg()[0], 1)


def processor(whose: int) -> float:
    used = resource.getrusage(whose)
    return used.ru_utime + used.ru_stime


# Queries and the manager


WATCHED = """
import resource, subprocess, sys, time
start = time.perf_counter()
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
took, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
print(took, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""  # in a process of its own: a child's memory is counted from what its parent had


def query(place: Place, command: str, asked: float, repeats: int) -> dict:
    """A command from the start of its process to its end."""
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
    """A manager without processes of its own."""
    with Store.open(place.where, blobs=place.blobs) as store:
        manager = Manager(store, place.where, CONFIG)
        manager._slots.clear()
        manager.run(lambda *_: None)


def managed(store: Store, place: Place, seconds: float) -> dict:
    """A manager's share of a core and its memory while turns end every two seconds, and rating batches when asked."""
    process = SPAWN.Process(target=manage, args=(place,))
    process.start()
    played(store, time.monotonic() + 10)
    used, since = seconds_of(process.pid), time.monotonic()
    turns, batches = played(store, since + seconds)
    share = (seconds_of(process.pid) - used) / (time.monotonic() - since)
    told = Path(f"/proc/{process.pid}/status").read_text()
    resident = {key: round(int(told.split(f"{key}:")[1].split()[0]) / 1024) for key in ("VmRSS", "VmHWM")}
    store.ask_stop(LEAGUE)
    process.join()
    return {
        "asked": {"share_of_a_core": SHARE, "resident_mb": RESIDENT}, "share_of_a_core": round(share, 4),
        "resident_mb": resident["VmRSS"], "resident_at_most_mb": resident["VmHWM"], "seconds": seconds,
        "turns": turns, "rating_batches": batches, "load_average": load(),
    }  # fmt: skip


def played(store: Store, until: float) -> tuple[int, int]:
    """What workers would do until then; turns and rating batches."""
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
            log = [replace(match(i), a=a, b=b, due=task.due, seconds=1.0) for i, (a, b) in enumerate(task.pairs)]
            store.finish(claimed[0], matches=log)
            batches += 1
    return turns, batches


def seconds_of(pid: int | None) -> float:
    """Seconds of the processor that a process has had."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# All of it


def size(store: Store, place: Place) -> int:
    """Bytes of the database, without blobs."""
    if "://" not in place.where:
        return sum(path.stat().st_size for path in Path(place.where).glob("league.db*"))
    engine = sa.create_engine(sa.make_url(place.where).set(drivername="postgresql+psycopg"))
    with engine.connect() as db:
        schema = "SELECT sum(pg_total_relation_size(c.oid)) FROM pg_class c WHERE relkind = 'r' AND relnamespace ="
        return int(db.execute(sa.text(f"{schema} current_schema()::regnamespace")).scalar_one())


def measured(place: Place, backend: str, args: argparse.Namespace) -> dict:
    with Store.open(place.where, create=True, blobs=place.blobs) as store:
        store.blobs.put(b"so that the folder is there")
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", help="a PostgreSQL server's URL; everything goes into a schema that is dropped")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--snapshots", type=int, default=10_000)
    parser.add_argument("--leagues", type=int, default=10)
    parser.add_argument("--matches", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    told: dict[str, Any] = {
        "benchmark": "store", "commit": commit(), "load_average_at_start": load(),
        "snapshots": args.snapshots, "leagues": args.leagues, "matches": args.matches,
        "episodes": args.matches * EPISODES,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        told["sqlite"] = measured(Place(f"{folder}/store", f"{folder}/store/blobs"), "sqlite", args)
    if args.server:
        with tempfile.TemporaryDirectory() as folder:
            for url in schema(args.server):
                told["postgresql"] = measured(Place(url, folder), "postgresql", args)
    tell({**told, "machine": machine()}, args.out)


def schema(server: str) -> Iterator[str]:
    """A URL under which everything goes into a new schema, dropped at the end."""
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
