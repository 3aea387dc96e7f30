"""Campaign of random faults in running leagues: nothing may be lost, doubled or changed. Counts add up over runs.

    python -m tests.faults.faults --minutes 60 --at-once 3 --out tests/faults/results/faults-cpu.json
    python -m tests.faults.faults --rounds 1 --strikes 6 --databases sqlite --harm kill_one kill_all
    python -m tests.faults.faults --rounds 1 --databases pgbouncer asynchronous synchronous --out postgresql.json

In a round, the real command runs a new league on SQLite or on a PostgreSQL server of its own; faults are injected
repeatedly, and the league is run to its end. Then every scheduled match must be in the log exactly once and nothing
else, every row must have its blob, and parameters, curves, log and ratings must equal those of an undisturbed league of
the same seed. A round counts in the file when it ends; an interrupted round does not count, and the same command
continues. A league that violates a condition is kept, and its folder is printed. Exit code 1 if anything was lost.
"""

import argparse
import json
import random
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from scripts.record import commit, machine, make_parser
from tests.faults import harm
from tests.faults.harm import Scene
from tests.faults.hunted import LEAGUE, Hunted, Lost, examine
from tests.faults.servers import Bouncer, Line, Pair, Server, programs, small_disk

# Faults and their relative frequencies. Some need a certain database or disk.
OFTEN = {
    harm.kill_one: 10, harm.kill_all: 10, harm.kill_starting: 10, harm.freeze: 1, harm.second_manager: 1,
    harm.fill_disk: 3, harm.restart_server: 2, harm.cut_line: 2, harm.fail_over: 10,
    harm.skewed_worker: 2, harm.unmount: 2, harm.broken_worker: 1,
}  # fmt: skip
DISK = 8  # MB; a league needs about 2
# PostgreSQL alone, behind PgBouncer, or with a standby: an asynchronous one by a URL of both hosts, a synchronous one
# behind PgBouncer. A campaign chooses the first two unless it is told.
DATABASES = ("sqlite", "postgresql", "pgbouncer", "asynchronous", "synchronous")
Harm = Callable[[Scene], Counter[str]]


@contextmanager
def scene(folder: Path, database: str, steps: int, rng: random.Random, disk: bool) -> Iterator[Scene]:
    """Yield a league that has not begun, on its database and perhaps on a small disk; delete everything afterwards."""
    with ExitStack() as stack:
        place = stack.enter_context(small_disk(folder / "disk", DISK)) if disk else folder / "store"
        on = Scene(Hunted(place, str(place), steps), rng, disk=place if disk else None)
        if database != "sqlite":
            _serve(on, folder, database, stack)
        stack.callback(on.hunted.end)
        yield on


def _serve(on: Scene, folder: Path, database: str, stack: ExitStack) -> None:
    """Give a league that has not begun its servers, which stop with the stack."""
    hunted = on.hunted
    if database in ("asynchronous", "synchronous"):
        on.pair = Pair(folder / "servers", database == "synchronous")
        stack.callback(on.pair.stop)
        server, ports = on.pair.primary, (on.pair.primary.port, on.pair.standby.port)
        hunted.where = f"postgresql://league@{','.join(f'127.0.0.1:{port}' for port in ports)}/{LEAGUE}"
    else:
        server = on.server = Server(folder / "server")
        stack.callback(server.stop)
    hunted.direct = server.url(LEAGUE)
    if database in ("pgbouncer", "synchronous"):
        on.pool = Bouncer(folder / "pool", server.port)
        stack.callback(on.pool.stop)
    if database != "asynchronous":
        on.line = Line(on.pool.port if on.pool else server.port)
        stack.callback(on.line.cut)
        hunted.where = server.url(LEAGUE, on.line.port)


def possible(scene: Scene, chosen: list[str]) -> dict[Harm, int]:
    """Return the faults among the chosen ones that this league allows, with their frequencies."""
    clock = scene.server and harm.faketime()  # SQLite uses the clock of the asking process
    needs = {harm.fill_disk: scene.disk, harm.restart_server: scene.server, harm.cut_line: scene.line}
    needs[harm.skewed_worker], needs[harm.fail_over] = clock, scene.pair
    needs[harm.unmount] = scene.disk is None  # a small disk is a mount point already
    return {do: n for do, n in OFTEN.items() if needs.get(do, True) and (not chosen or do.__name__ in chosen)}


def strike(scene: Scene, strikes: int, chosen: list[str]) -> Counter[str]:
    """Inject faults at random moments: some immediately, some after the league has progressed since the last one."""
    counts, rng, can = Counter[str](), scene.rng, possible(scene, chosen)
    for _ in range(strikes):
        since, progressed = scene.hunted.revision(), rng.random() < 0.5
        waited = scene.hunted.wait(lambda a=since, b=progressed: not b or scene.hunted.revision() >= a + 2, 180)
        pause = time.monotonic() + rng.uniform(0, 3 if progressed else 6)
        if not waited or not scene.hunted.wait(lambda until=pause: time.monotonic() > until, 60):
            continue  # it has ended
        counts += rng.choices(list(can), list(can.values()))[0](scene)
    return counts


def round_of(folder: Path, database: str, asked: argparse.Namespace, seed: int, expected: Any) -> dict[str, Any]:
    """Run a league with faults from its start to its end; return counts of faults and work. Raises Lost."""
    rng = random.Random(seed)
    with scene(folder, database, asked.steps, rng, asked.disk and rng.random() < 0.3) as on:
        try:
            harmed = strike(on, asked.strikes, asked.harm)
            on.hunted.finish()
            _, done = examine(on.hunted, expected)
            harmed += harm.damage(on) if not asked.harm else Counter()
        except Lost:
            if on.disk is not None:  # the disk is deleted with the round
                shutil.copytree(on.disk, folder / "left")
            raise
    return {"harm": dict(harmed), **done}


def undisturbed(folder: Path, steps: int) -> dict[str, Any]:
    """Return the result of the same league without faults."""
    with scene(folder, "sqlite", steps, random.Random(0), False) as on:
        on.hunted.finish()
        return examine(on.hunted)[0]


def add(figures: dict[str, Any], database: str, outcome: dict[str, Any]) -> None:
    """Add a round's counts to the figures."""
    kept = figures["databases"].setdefault(database, {"rounds": 0, "harm": {}})
    kept["rounds"] += 1
    harmed = Counter(kept["harm"]) + Counter(outcome.pop("harm", {}))
    kept["harm"] = dict(sorted(harmed.items()))
    for name, number in outcome.items():
        kept[name] = kept.get(name, 0) + number
    sums = sum((Counter(each["harm"]) for each in figures["databases"].values()), Counter[str]())
    figures["processes killed"] = sum(n for what, n in sums.items() if what.endswith("killed"))


def loaded(out: Path | None) -> dict[str, Any]:
    """Read the counts so far."""
    if out is not None and out.exists():
        return json.loads(out.read_text())
    return {"machine": machine(), "processes killed": 0, "databases": {}, "lost": [], "commits": []}


def written(figures: dict[str, Any], out: Path | None) -> None:
    """Write the counts atomically."""
    if out is not None:
        aside = out.with_suffix(".new")
        aside.write_text(json.dumps(figures, indent=2) + "\n")
        aside.replace(out)


class Campaign:
    """Rounds, several at the same time, whose counts are written to a file as each ends.

    `expected` is the result of an undisturbed league of as many steps, where the caller has it.
    """

    def __init__(self, asked: argparse.Namespace, expected: dict[str, Any] | None = None):
        self.asked, self.expected = asked, expected
        self.figures, self.counting = loaded(asked.out), threading.Lock()
        self.folder = Path(tempfile.mkdtemp(prefix="faults-"))
        self.folder.chmod(0o755)  # PostgreSQL's user needs access
        self.databases = asked.databases or (["sqlite", "postgresql"] if programs() else ["sqlite"])
        self.figures["commits"] = sorted({*self.figures["commits"], asked.commit or commit()})
        before = sum(each["rounds"] for each in self.figures["databases"].values()) + len(self.figures["lost"])
        self.seeds = iter(range(before + asked.seed, before + asked.seed + asked.rounds))

    def run(self) -> dict[str, Any]:
        """Run rounds until the time is over; return the figures."""
        if self.expected is None:
            print(f"{self.folder}: first an undisturbed league", flush=True)
            self.expected = undisturbed(self.folder / "undisturbed", self.asked.steps)
        self.deadline = time.monotonic() + 60 * self.asked.minutes
        with ThreadPoolExecutor(self.asked.at_once) as pool:
            for stream in [pool.submit(self._stream) for _ in range(self.asked.at_once)]:
                stream.result()
        return self.figures

    def _stream(self) -> None:
        while time.monotonic() < self.deadline:
            with self.counting:
                seed = next(self.seeds, None)
            if seed is None:
                return
            self._round(seed, self.databases[seed % len(self.databases)], self.folder / str(seed))

    def _round(self, seed: int, database: str, folder: Path) -> None:
        try:
            outcome = round_of(folder, database, self.asked, seed, self.expected)
            shutil.rmtree(folder, ignore_errors=True)
        except Lost as error:
            outcome = {"lost": str(error)[:500], "kept in": str(folder)}
        with self.counting:
            if "lost" in outcome:
                self.figures["lost"].append({"database": database, "seed": seed, "what": outcome["lost"]})
            else:
                add(self.figures, database, dict(outcome))
            written(self.figures, self.asked.out)
        print(f"{datetime.now(UTC):%H:%M:%S} {database}, seed {seed}: {json.dumps(outcome)}", flush=True)


def main(words: list[str] | None = None, expected: dict[str, Any] | None = None) -> int:
    """Run the campaign; return 1 if anything was lost."""
    figures = Campaign(_asked(words), expected).run()
    print(json.dumps(figures, indent=2))
    return 1 if figures["lost"] else 0


def _asked(words: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=10**6)
    parser.add_argument("--at-once", type=int, default=1, help="rounds at the same time")
    parser.add_argument("--strikes", type=int, default=24, help="faults in a round")
    parser.add_argument("--steps", type=int, default=20_480, help="of training in a round")
    parser.add_argument("--databases", nargs="+", choices=DATABASES)
    parser.add_argument("--harm", nargs="+", default=[], choices=[do.__name__ for do in OFTEN], help="none: all")
    parser.add_argument("--no-disk", dest="disk", action="store_false", help="no small disks, which need root")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args(words)


if __name__ == "__main__":
    sys.exit(main())
