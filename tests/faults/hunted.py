"""A league under fault injection: run by the real command, observed from outside, its result compared exactly."""

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

from league.state.jobs import RatingMatch, decode
from storage.errors import StorageError
from storage.store import Store

ROOT = Path(__file__).resolve().parents[2]
LEAGUE = "hunted"
LEASE = 5  # seconds
PAIRINGS = 2  # in a batch
# Nothing depends on a clock: matches begin when training has ended, and end when all quotas are met.
FLAGS = (
    "--arena.name", "rock-paper-scissors", "--league", LEAGUE, "--seed", "3", "--deterministic",
    "--training.worlds", "64", "--training.rollout_length", "8", "--training.iterations_per_turn", "2",
    "--learner.architecture.hidden", "8", "--budget.rating_time", "10h", "--rating.worlds", "64",
    "--rating.pairings", str(PAIRINGS), "--rating.episodes_per_pair", "32", "--rating.final-episodes-per-pair", "32",
    "--rating.trained", "false", "--rating.scripts", "rock,random", "--workers.nice", "0",
    "--workers.lease", str(LEASE), "--workers.max_attempts", "100",
)  # fmt: skip


class Lost(Exception):  # noqa: N818
    """Something was lost, doubled or changed, which must never happen."""


@dataclass
class Hunted:
    """A league and the process that runs it, which is started again after it was killed."""

    folder: Path
    where: str  # the store, as its processes reach it
    steps: int
    direct: str = ""  # the same store by a connection that the faults do not affect
    process: subprocess.Popen[bytes] | None = None
    seen: set[int] = field(default_factory=set)  # all its processes so far

    def __post_init__(self) -> None:
        """Make the folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.direct = self.direct or self.where

    @property
    def blobs(self) -> Path:
        """The folder of its blobs."""
        return self.folder / "blobs"

    @property
    def log(self) -> Path:
        """The file with the output of its processes."""
        return self.folder / "out.txt"

    def command(self, *args: str) -> list[str]:
        """Return the command line of a `league` command on its store."""
        return [sys.executable, "-m", "league", *args, "--store", self.where, "--blobs", str(self.blobs)]

    def call(self, *args: str) -> subprocess.CompletedProcess[str]:
        """Run a `league` command on its store to its end."""
        return subprocess.run(self.command(*args), capture_output=True, text=True, timeout=600, env=environment())

    def start(self, command: str = "run", **also: str) -> subprocess.Popen[bytes]:
        """Start `league run` or another command in a session of its own; `also` are environment variables."""
        call = self.command(command, *((*FLAGS, "--budget.steps", str(self.steps)) if command == "run" else ()))
        with self.log.open("ab") as out:
            return subprocess.Popen(call, stdout=out, stderr=out, env=environment() | also, start_new_session=True)

    def keep_running(self) -> bool:
        """Start it unless it runs; return true if it has ended successfully."""
        if self.process is not None and self.process.poll() == 0:
            return True
        if self.process is None or self.process.poll() is not None:
            self.process = self.start()
        return False

    def processes(self) -> dict[int, str]:
        """Return its processes by pid: manager, train, match, or starting for one that has not registered yet."""
        if self.process is None or self.process.poll() is not None:
            return {}
        kinds = self.look(lambda store: {w.pid: w.kinds for w in store.workers(LEAGUE, 3600)}) or {}
        found = {pid: kinds.get(pid, "starting") for pid in children(self.process.pid)}
        self.seen |= {self.process.pid, *found}
        return {self.process.pid: "manager", **found}

    def look(self, what: Callable[[Store], Any]) -> Any:
        """Return `what(store)`; None while there is no store or it cannot be reached."""
        try:
            with Store.open(self.direct, blobs=self.blobs) as store:
                return what(store)
        except StorageError:
            return None

    def revision(self) -> int:
        """Return the league's revision, which grows with its progress."""
        return self.look(lambda store: store.revision(LEAGUE)) or 0

    def wait(self, until: Callable[[], Any], seconds: float) -> bool:
        """Keep it running until `until()` is true; return false if it ends before, or after `seconds`."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if until():
                return True
            if self.keep_running():
                return False
            time.sleep(0.1)
        return False

    def finish(self, seconds: float = 1200) -> None:
        """Run it to its end. Raises Lost if it does not end in time, or if one of its processes survives."""
        deadline = time.monotonic() + seconds
        while not self.keep_running():
            if time.monotonic() > deadline:
                raise Lost(f"it has not ended within {seconds:.0f} s")
            time.sleep(0.1)
        while left := [pid for pid in self.seen if is_alive(pid)]:
            if time.monotonic() > deadline:
                raise Lost(f"processes survive: {left}")
            time.sleep(0.1)

    def end(self) -> None:
        """Kill its remaining processes."""
        for pid in {*self.processes(), *self.seen}:
            if is_alive(pid):
                os.kill(pid, signal.SIGKILL)
        if self.process is not None:
            self.process.wait()


def environment() -> dict[str, str]:
    """Return the environment of its processes, which run the code of this tree."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "NPROC": "4"}


def children(parent: int) -> Iterator[int]:
    """Yield the pids of a manager's worker processes."""
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, above = status.read_text().rpartition(")")[2].split()[:2]
            command = status.with_name("cmdline").read_bytes()
        except OSError:
            continue  # it has ended meanwhile
        if int(above) == parent and state != "Z" and b"spawn_main" in command:
            yield int(status.parent.name)


def is_alive(pid: int) -> bool:
    """Return true if a process of a league still runs and is no zombie."""
    try:
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
    return b"spawn_main" in command or b"league" in command


def ending(store: Store) -> dict[str, Any]:
    """Return everything in a league's result that its seed alone determines, as plain values."""
    players = store.players(LEAGUE)
    newest = {player.name: store.checkpoint(LEAGUE, player.name) for player in players}
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
    """Return the league's result, and the numbers of jobs, vain attempts and matches.

    Raises Lost, with a description, if anything was lost, doubled or changed.
    """
    with Store.open(hunted.direct, blobs=hunted.blobs) as store:
        found, jobs = ending(store), store.jobs(LEAGUE)
    ratings = json.loads(ok(hunted.call("ratings", "--format", "json")))
    found["ratings"] = [[row[name] for name in ("name", "elo", "low", "high", "games", "wins")] for row in ratings]
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
    """Return the log's rows of a batch; a single pair in a batch has all worlds, as two rows."""
    return [(*task.lineups[i % len(task.lineups)], task.seed) for i in range(PAIRINGS)]


def findings(hunted: Hunted) -> list[dict[str, Any]]:
    """Return the findings of `league verify`."""
    done = hunted.call("verify", "--age", "0s", "--format", "json")
    if done.returncode not in (0, 1):
        raise Lost(f"league verify: {done.stderr}")
    return json.loads(done.stdout)["findings"]


def ok(done: subprocess.CompletedProcess[str]) -> str:
    """Return the output of a command. Raises Lost if it failed."""
    if done.returncode != 0:
        raise Lost(f"{' '.join(map(str, done.args[2:5]))}: {done.stderr}")
    return done.stdout
