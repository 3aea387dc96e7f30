"""Harm done at random to leagues that run, and whether anything was lost, doubled or changed. Counts add up over runs.

    python benchmarks/faults.py --minutes 60 --out benchmarks/results/faults-cpu.json
    python benchmarks/faults.py --rounds 1 --strikes 6 --databases sqlite --harm kill_one kill_all

In a round a new league is run by the real command on SQLite or PostgreSQL (a server of its own), something is done to
it again and again, and it is run to its end. Then every scheduled match must be in the log once and nothing else, no
row be without its blob, and parameters, curves, log and ratings be those of a league of the same seed that nothing was
done to. A round that ends counts at once in the file; one that is stopped does not count, and the same command goes on.
A league for which something does not hold is kept, and its folder told.
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

sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import harm  # noqa: E402
from benchmarks.harm import Scene  # noqa: E402
from benchmarks.hunted import Hunted, Lost, examine  # noqa: E402
from benchmarks.record import commit, machine  # noqa: E402
from benchmarks.servers import Line, Server, programs, small_disk  # noqa: E402

# What is done, and how often in comparison. Some of it needs a database or a disk of a kind.
OFTEN = {
    harm.kill_one: 10, harm.kill_all: 10, harm.kill_starting: 10, harm.freeze: 1, harm.second_manager: 1,
    harm.fill_disk: 3, harm.restart_server: 2, harm.cut_line: 2,
    harm.skewed_worker: 2,
}  # fmt: skip
DISK = 8  # MB; a league needs about 2
Harm = Callable[[Scene], Counter[str]]


@contextmanager
def scene(folder: Path, database: str, steps: int, dice: random.Random, disk: bool) -> Iterator[Scene]:
    """A league that has not begun, on its database, perhaps on a small disk; all of it is gone afterwards."""
    with ExitStack() as stack:
        place = stack.enter_context(small_disk(folder / "disk", DISK)) if disk else folder / "store"
        server = line = None
        where = direct = str(place)
        if database == "postgresql":
            server = Server(folder / "server")
            stack.callback(server.stop)
            line = Line(server.port)
            stack.callback(line.cut)
            where, direct = server.url("league", line.port), server.url("league")
        hunted = Hunted(place, where, steps, direct)
        stack.callback(hunted.end)
        yield Scene(hunted, dice, server, line, place if disk else None)


def possible(scene: Scene, chosen: list[str]) -> dict[Harm, int]:
    """What can be done there, of what was chosen, and how often."""
    clock = scene.server and harm.faketime()  # SQLite's clock is that of whoever asks
    needs = {harm.fill_disk: scene.disk, harm.restart_server: scene.server, harm.cut_line: scene.line}
    needs[harm.skewed_worker] = clock
    return {do: n for do, n in OFTEN.items() if needs.get(do, True) and (not chosen or do.__name__ in chosen)}


def strike(scene: Scene, strikes: int, chosen: list[str]) -> Counter[str]:
    """Do so many things to the league, at random moments: some at once, some when it has come on since the last."""
    told, dice, can = Counter[str](), scene.dice, possible(scene, chosen)
    for _ in range(strikes):
        since, come_on = scene.hunted.revision(), dice.random() < 0.5
        waited = scene.hunted.wait(lambda a=since, b=come_on: not b or scene.hunted.revision() >= a + 2, 180)
        pause = time.monotonic() + dice.uniform(0, 3 if come_on else 6)
        if not waited or not scene.hunted.wait(lambda until=pause: time.monotonic() > until, 60):
            continue  # it has come to its end
        told += dice.choices(list(can), list(can.values()))[0](scene)
    return told


def round_of(folder: Path, database: str, asked: argparse.Namespace, seed: int, expected: Any) -> dict[str, Any]:
    """A league from its start to its end, and what was done to it. Raises Lost."""
    dice = random.Random(seed)
    with scene(folder, database, asked.steps, dice, asked.disk and dice.random() < 0.3) as on:
        try:
            harmed = strike(on, asked.strikes, asked.harm)
            on.hunted.finish()
            _, done = examine(on.hunted, expected)
            harmed += harm.damage(on) if not asked.harm else Counter()
        except Lost:
            if on.disk is not None:  # it goes with the round
                shutil.copytree(on.disk, folder / "left")
            raise
    return {"harm": dict(harmed), **done}


def undisturbed(folder: Path, steps: int) -> dict[str, Any]:
    """What the same league comes to when nothing is done to it."""
    with scene(folder, "sqlite", steps, random.Random(0), False) as on:
        on.hunted.finish()
        return examine(on.hunted)[0]


def add(figures: dict[str, Any], database: str, outcome: dict[str, Any]) -> None:
    """Count a round in."""
    kept = figures["databases"].setdefault(database, {"rounds": 0, "harm": {}})
    kept["rounds"] += 1
    harmed = Counter(kept["harm"]) + Counter(outcome.pop("harm", {}))
    kept["harm"] = dict(sorted(harmed.items()))
    for name, number in outcome.items():
        kept[name] = kept.get(name, 0) + number
    sums = sum((Counter(each["harm"]) for each in figures["databases"].values()), Counter[str]())
    figures["processes killed"] = sum(n for what, n in sums.items() if what.endswith("killed"))


def loaded(out: Path | None) -> dict[str, Any]:
    """The counts so far."""
    if out is not None and out.exists():
        return json.loads(out.read_text())
    return {"machine": machine(), "processes killed": 0, "databases": {}, "lost": [], "commits": []}


def written(figures: dict[str, Any], out: Path | None) -> None:
    """Keep the counts, whole or not at all."""
    if out is not None:
        aside = out.with_suffix(".new")
        aside.write_text(json.dumps(figures, indent=2) + "\n")
        aside.replace(out)


class Campaign:
    """Rounds, some of them at once, whose counts are kept in a file as each ends."""

    def __init__(self, asked: argparse.Namespace):
        self.asked, self.figures, self.counting = asked, loaded(asked.out), threading.Lock()
        self.folder = Path(tempfile.mkdtemp(prefix="faults-"))
        self.folder.chmod(0o755)  # PostgreSQL's own user goes through it
        self.databases = asked.databases or (["sqlite", "postgresql"] if programs() else ["sqlite"])
        self.figures["commits"] = sorted({*self.figures["commits"], commit()})
        before = sum(each["rounds"] for each in self.figures["databases"].values()) + len(self.figures["lost"])
        self.seeds = iter(range(before + asked.seed, before + asked.seed + asked.rounds))

    def run(self) -> dict[str, Any]:
        """All rounds for which there is time."""
        print(f"{self.folder}: first the league that nothing is done to", flush=True)
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


def main() -> int:
    """Rounds until the time is over; 1 where anything was lost."""
    figures = Campaign(_asked()).run()
    print(json.dumps(figures, indent=2))
    return 1 if figures["lost"] else 0


def _asked() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=10**6)
    parser.add_argument("--at-once", type=int, default=1, help="rounds side by side")
    parser.add_argument("--strikes", type=int, default=24, help="in a round")
    parser.add_argument("--steps", type=int, default=20_480, help="of training in a round")
    parser.add_argument("--databases", nargs="+", choices=["sqlite", "postgresql"])
    parser.add_argument("--harm", nargs="+", default=[], choices=[do.__name__ for do in OFTEN], help="none: all")
    parser.add_argument("--no-disk", dest="disk", action="store_false", help="no small disks, which need root")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
