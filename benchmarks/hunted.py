"""A league to do harm to: run by the real command, its processes found from outside, its end compared to the byte."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from league.jobs import RatingMatch, decode
from storage.errors import StorageError
from storage.store import Store

ROOT = Path(__file__).resolve().parents[1]
LEAGUE = "hunted"
LEASE = 5  # seconds
PAIRINGS = 2  # in a batch
# Nothing in it hangs on a clock: matches begin when training has ended, and end when all have met often enough.
FLAGS = (
    "--arena.name", "rock-paper-scissors", "--league", LEAGUE, "--seed", "3", "--deterministic",
    "--training.worlds", "64", "--training.rollout", "8", "--training.turn", "2",
    "--learner.architecture.hidden", "8", "--budget.rate", "10h", "--rating.worlds", "64",
    "--rating.pairings", str(PAIRINGS), "--rating.quota", "32", "--rating.final-quota", "32",
    "--rating.trained", "false", "--rating.scripts", "rock,random", "--workers.nice", "0",
    "--workers.lease", str(LEASE), "--workers.tries", "100",
)  # fmt: skip


class Lost(Exception):  # noqa: N818
    """Something that must never happen has happened."""


@dataclass
class Hunted:
    """A league, and the process that runs it; whoever kills that one starts it again."""

    folder: Path
    where: str  # the store, as its processes reach it
    steps: int
    direct: str = ""  # the same store, past whatever the harm is done to
    process: subprocess.Popen[bytes] | None = None
    seen: set[int] = field(default_factory=set)  # every process of it that was ever seen

    def __post_init__(self) -> None:
        """Make the folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.direct = self.direct or self.where

    @property
    def blobs(self) -> Path:
        """Where its blobs are."""
        return self.folder / "blobs"

    @property
    def log(self) -> Path:
        """What its processes say."""
        return self.folder / "out.txt"

    def command(self, *args: str) -> list[str]:
        """A command line about it."""
        return [sys.executable, "-m", "league", *args, "--store", self.where, "--blobs", str(self.blobs)]

    def call(self, *args: str) -> subprocess.CompletedProcess[str]:
        """A command about it, run to its end."""
        return subprocess.run(self.command(*args), capture_output=True, text=True, timeout=600, env=environment())

    def start(self, command: str = "run", **also: str) -> subprocess.Popen[bytes]:
        """Run it, or work for it, in a session of its own; `also` goes into the environment."""
        call = self.command(command, *((*FLAGS, "--budget.steps", str(self.steps)) if command == "run" else ()))
        with self.log.open("ab") as out:
            return subprocess.Popen(call, stdout=out, stderr=out, env=environment() | also, start_new_session=True)

    def keep_running(self) -> bool:
        """Start it where it does not run; whether it has come to its end."""
        if self.process is not None and self.process.poll() == 0:
            return True
        if self.process is None or self.process.poll() is not None:
            self.process = self.start()
        return False

    def processes(self) -> dict[int, str]:
        """Its processes by number: manager, train, match, or starting for one that has not said yet what it is."""
        if self.process is None or self.process.poll() is not None:
            return {}
        said = self.look(lambda store: {w.pid: w.kinds for w in store.workers(LEAGUE, 3600)}) or {}
        found = {pid: said.get(pid, "starting") for pid in children(self.process.pid)}
        self.seen |= {self.process.pid, *found}
        return {self.process.pid: "manager", **found}

    def look(self, what: Callable[[Store], Any]) -> Any:
        """Something about its store; None while there is none, or it cannot be reached."""
        try:
            with Store.open(self.direct, blobs=self.blobs) as store:
                return what(store)
        except StorageError:
            return None

    def revision(self) -> int:
        """How far it has come, as a number that grows."""
        return self.look(lambda store: store.revision(LEAGUE)) or 0

    def wait(self, until: Callable[[], Any], seconds: float) -> bool:
        """Keep it running until that is so, or it has come to its end, or the time is over; whether it was so."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if until():
                return True
            if self.keep_running():
                return False
            time.sleep(0.1)
        return False

    def finish(self, seconds: float = 1200) -> None:
        """Let it come to its end. Raises Lost where it does not, or where a process of it lives on."""
        deadline = time.monotonic() + seconds
        while not self.keep_running():
            if time.monotonic() > deadline:
                raise Lost(f"it has not come to its end within {seconds:.0f} s")
            time.sleep(0.1)
        while left := [pid for pid in self.seen if is_alive(pid)]:
            if time.monotonic() > deadline:
                raise Lost(f"processes live on: {left}")
            time.sleep(0.1)

    def end(self) -> None:
        """Kill all that is left of it."""
        for pid in {*self.processes(), *self.seen}:
            if is_alive(pid):
                os.kill(pid, signal.SIGKILL)
        if self.process is not None:
            self.process.wait()


def environment() -> dict[str, str]:
    """Of its processes: this tree's code, and little noise."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "NPROC": "4"}


def children(parent: int) -> Iterator[int]:
    """The worker processes of a manager."""
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, above = status.read_text().rpartition(")")[2].split()[:2]
            command = status.with_name("cmdline").read_bytes()
        except OSError:
            continue  # it has ended meanwhile
        if int(above) == parent and state != "Z" and b"spawn_main" in command:
            yield int(status.parent.name)


def is_alive(pid: int) -> bool:
    """Whether a process that was ours still is, and is no zombie."""
    try:
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
    return b"spawn_main" in command or b"league" in command


def ending(store: Store) -> dict[str, Any]:
    """All that a league has come to and that its seed alone decides, in plain values."""
    mine = store.players(LEAGUE)
    newest = {player.name: store.checkpoint(LEAGUE, player.name) for player in mine}
    clocks = ("created", "seconds", "due", "steps_per_second")
    return {
        "parameters": {name: (at.digest, at.iteration, at.step) for name, at in newest.items() if at},
        "snapshots": sorted((s.name, s.digest) for s in store.snapshots(LEAGUE)),
        "meetings": sorted(tuple(asdict(m).values())[:-1] for m in store.meetings(LEAGUE)),
        "curves": [
            (c.player, c.iteration, c.step, {k: v for k, v in c.values.items() if k not in clocks})
            for c in store.curves(LEAGUE)
        ],
        "matches": [{k: v for k, v in asdict(m).items() if k not in clocks} for m in store.matches(LEAGUE)],
    }


def examine(hunted: Hunted, expected: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, int]]:
    """What the league has come to, and how much was done for that.

    Raises Lost, with what is wrong, where anything was lost, doubled or changed.
    """
    with Store.open(hunted.direct, blobs=hunted.blobs) as store:
        found, jobs = ending(store), store.jobs(LEAGUE)
    told = json.loads(ok(hunted.call("ratings", "--format", "json")))
    found["ratings"] = [[row[name] for name in ("name", "elo", "low", "high", "games", "wins")] for row in told]
    if bad := [job.key for job in jobs if job.state != "done"]:
        raise Lost(f"jobs that were not done: {bad}")
    scheduled = sorted(pair for task in map(decode, jobs) if isinstance(task, RatingMatch) for pair in _batch(task))
    played = sorted((m["a"], m["b"], m["seed"]) for m in found["matches"])
    if played != scheduled:
        raise Lost(f"{len(scheduled)} matches were scheduled, {len(played)} are in the log")
    iterations = [(c[0], c[1]) for c in found["curves"]]
    if len(set(iterations)) != len(iterations):
        raise Lost("an iteration is there twice")
    verified = [each for each in findings(hunted) if each["kind"] != "orphaned"]
    if verified:
        raise Lost(f"league verify: {verified[:3]}")
    for name, value in (expected or {}).items():
        if found[name] != value:
            raise Lost(f"{name} differ from those of the undisturbed league")
    done = {"jobs": len(jobs), "attempts in vain": sum(job.attempt - 1 for job in jobs), "matches": len(played)}
    return found, done


def _batch(task: RatingMatch) -> list[tuple[str, str | None, int]]:
    """What the log must have of a batch: a pair that is alone in it has all of its worlds, as two rows."""
    return [(*task.pairs[i % len(task.pairs)], task.seed) for i in range(PAIRINGS)]


def findings(hunted: Hunted) -> list[dict[str, Any]]:
    """What `league verify` finds."""
    told = hunted.call("verify", "--age", "0s", "--format", "json")
    if told.returncode not in (0, 1):
        raise Lost(f"league verify: {told.stderr}")
    return json.loads(told.stdout)["findings"]


def ok(done: subprocess.CompletedProcess[str]) -> str:
    """What a command printed; raises Lost where it failed."""
    if done.returncode != 0:
        raise Lost(f"{' '.join(map(str, done.args[2:5]))}: {done.stderr}")
    return done.stdout
