import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TypeVar

import pytest
from filelock import FileLock

from arenas.arena import Arena
from league.config import presets
from storage.errors import StorageError
from storage.records import Worker
from storage.store import Store

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
T = TypeVar("T")

# A league as small as can be that still learns, rates and records: 64 worlds, 16 episodes per pair and side.
SMALL = (
    "--league", "tiny", "--seed", "3", "--training.worlds", "64", "--rating.worlds", "64",
    "--rating.episodes_per_pair", "32", "--rating.final-episodes-per-pair", "32", "--rating.pairings", "2",
    "--rating.milestones", "1s", "--workers.nice", "0",
)  # fmt: skip
TINY = ("--arena.name", "sumo-1v1", *SMALL)
PUCKS = ("--arena.name", f"{ROOT / 'tests' / 'arenas' / 'race.py'}:race", *SMALL)  # compiles in half the time
BODILESS = ("--arena.name", "rock-paper-scissors", *SMALL)  # no physics: compiled in a second, and only once
SMALLER = (
    "--league", "small", "--training.worlds", "32", "--training.rollout_length", "16", "--rating.worlds", "16",
    "--rating.pairings", "2", "--rating.episodes_per_pair", "8", "--rating.final-episodes-per-pair", "8",
    "--rating.milestones", "1s", "--workers.nice", "0",
)  # fmt: skip


def command(*args: str) -> list[str]:
    """The command line as a user's shell would start it."""
    return [sys.executable, "-m", "league", *args]


def call(*args: str, cwd: Path, timeout: float = 540) -> subprocess.CompletedProcess:
    """Run a command to its end."""
    return subprocess.run(command(*args), cwd=cwd, capture_output=True, text=True, timeout=timeout, env=ENVIRONMENT)


def said(capsys: pytest.CaptureFixture[str], *args: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a command in this process: it has imported all that a new one would import."""
    from league.commands import cli

    with pytest.raises(SystemExit) as ended:
        cli.main(list(args))
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def start(*args: str, cwd: Path) -> subprocess.Popen:
    """Start a command; what it says is added to out.txt in its folder. It hears Ctrl-C, whoever started these tests."""
    kept = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it, and so inherits
    try:
        with (cwd / "out.txt").open("ab") as out:
            return subprocess.Popen(command(*args), cwd=cwd, stdout=out, stderr=out, env=ENVIRONMENT)
    finally:
        signal.signal(signal.SIGINT, kept)


def wait_for(folder: Path, what: Callable[[Store], T], seconds: float = 300) -> T:
    """Look into the store in a folder until `what(store)` is true, and return that."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            with Store.open(folder / "league-data") as store:
                if store.leagues() and (found := what(store)):
                    return found
        except StorageError:
            pass  # not made yet
        time.sleep(0.1)
    pytest.fail(f"waited {seconds} s in vain; the league said:\n{(folder / 'out.txt').read_text()}")


def hold(folder: Path, pid: int) -> None:
    """SIGSTOP between two transactions: who is stopped within one keeps all others from writing, for ever."""
    while True:
        os.kill(pid, signal.SIGSTOP)
        with closing(sqlite3.connect(folder / "league-data" / "league.db", timeout=0.5)) as database:
            try:
                database.execute("BEGIN IMMEDIATE")
                return
            except sqlite3.OperationalError:
                os.kill(pid, signal.SIGCONT)
        time.sleep(0.05)


def held_amid_a_turn(folder: Path, at_least: int) -> Worker:
    """The train worker of the league `tiny`, stopped while it does a turn that begins at this iteration or later."""

    def turn(store):
        iteration = max((c.iteration for c in store.checkpoints("tiny")), default=-1)
        return iteration >= at_least and store.jobs("tiny", "leased", "train")

    def holder(store):
        """Return the worker that holds the turn; one that was killed is listed for some seconds more."""
        held = {int(job.holder.split(":")[1]) for job in turn(store) or () if job.holder}
        return next((w for w in store.workers("tiny", 5) if w.pid in held), None)

    while True:
        learner = wait_for(folder, holder)
        try:
            hold(folder, learner.pid)
        except ProcessLookupError:  # it has just been killed
            continue
        with Store.open(folder / "league-data") as store:
            if turn(store):
                return learner
        os.kill(learner.pid, signal.SIGCONT)


def ran_once(factory: pytest.TempPathFactory, name: str, *args: str) -> Path:
    """A new folder with the league that `league run ARGS` makes there, and its output in out.txt.

    All processes of a session share the run, and fixtures of a module too, which pytest-xdist may build again.
    """
    base = factory.getbasetemp()
    made = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / f"{name}-made"
    with FileLock(made.with_suffix(".lock")):
        if not (made / "out.txt").exists():
            made.mkdir()
            done = call("run", *args, cwd=made)
            assert done.returncode == 0, done.stderr
            (made / "out.txt").write_text(done.stdout)
    return shutil.copytree(made, factory.mktemp(name), dirs_exist_ok=True)


@pytest.fixture(scope="session")
def tiny_league(tmp_path_factory):
    """The folder in which a tiny league has been run to the end of its budget, and what it printed."""
    folder = ran_once(tmp_path_factory, "tiny", *TINY, "--steps", "33000", "--budget.rating_time", "12s")
    return folder, (folder / "out.txt").read_text()


@pytest.fixture(scope="session")
def bodiless_league(tmp_path_factory) -> Path:
    """The folder of a league without bodies that has had its budget of four iterations and plays no matches."""
    without = ("--budget.rating_time", "0s", "--workers.match", "0")
    return ran_once(tmp_path_factory, "bodiless", *BODILESS, "--steps", "8192", *without)


@pytest.fixture(scope="session")
def rated_league(tmp_path_factory) -> Path:
    """The folder of a small league without bodies that was trained and rated until all had met."""
    until_all_met = ("--steps", "1500", "--budget.rating_time", "5m")
    return ran_once(tmp_path_factory, "rated", "--arena.name", "rock-paper-scissors", *SMALLER, *until_all_met)


@pytest.fixture
def optimised_runs(monkeypatch) -> None:
    """Let XLA optimise fully what leagues compile that a test starts, as theirs does that a user starts."""
    monkeypatch.delitem(ENVIRONMENT, "JAX_DISABLE_MOST_OPTIMIZATIONS", raising=False)
    monkeypatch.delitem(ENVIRONMENT, "XLA_FLAGS", raising=False)


@pytest.fixture
def copied_league(bodiless_league, tmp_path) -> None:
    """Put a copy of that league into the test's folder, to go on with."""
    shutil.copytree(bodiless_league, tmp_path, dirs_exist_ok=True)


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


def free_port() -> int:
    """Return a port on which nothing listens."""
    with socket.socket() as asked:
        asked.bind(("127.0.0.1", 0))
        return asked.getsockname()[1]


@pytest.fixture(scope="session")
def duel() -> Arena:
    """The arena of the preset duel on the C engine, built once."""
    return presets.preset("duel").arena.build(engine="c")


@pytest.fixture
def duel_store(tmp_path, duel) -> Iterator[Store]:
    """A store with a league in that arena whose players have yet to take their first turn."""
    from tests.league.turns import new_store

    with new_store(tmp_path / "store", duel) as store:
        yield store


@pytest.fixture
def packed(tmp_path) -> Path:
    """The archive of a league with something in every table, beside the store that it came from."""
    from league.snapshots import archive
    from tests.league.packs import league_of

    with league_of(tmp_path / "source") as store:
        archive.pack(store, tmp_path / "cup.zip")
    return tmp_path / "cup.zip"
