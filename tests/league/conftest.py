import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from arenas.arena import Arena
from league.config import presets
from storage.errors import StorageError
from storage.store import Store

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
T = TypeVar("T")

# A league as small as can be that still learns, rates and records: 64 worlds, 16 episodes per pair and side.
SMALL = (
    "--league", "tiny", "--seed", "3", "--training.worlds", "64", "--rating.worlds", "64",
    "--rating.quota", "32", "--rating.final-quota", "32", "--rating.pairings", "2", "--rating.milestones", "1s",
    "--workers.nice", "0",
)  # fmt: skip
TINY = ("--arena.name", "sumo-1v1", *SMALL)
PUCKS = ("--arena.name", f"{ROOT / 'tests' / 'arenas' / 'race.py'}:race", *SMALL)  # compiles in half the time


def command(*args: str) -> list[str]:
    """The command line as a user's shell would start it."""
    return [sys.executable, "-m", "league", *args]


def call(*args: str, cwd: Path, timeout: float = 540) -> subprocess.CompletedProcess:
    """Run a command to its end."""
    return subprocess.run(command(*args), cwd=cwd, capture_output=True, text=True, timeout=timeout, env=ENVIRONMENT)


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


@pytest.fixture(scope="session")
def tiny_league(tmp_path_factory):
    """The folder in which a tiny league has been run to the end of its budget, and what it printed."""
    folder = tmp_path_factory.mktemp("tiny")
    done = call("run", *TINY, "--steps", "33000", "--budget.rate", "30s", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


@pytest.fixture(scope="module")
def port() -> int:
    """One that is free."""
    with socket.socket() as asked:
        asked.bind(("127.0.0.1", 0))
        return asked.getsockname()[1]


@pytest.fixture(scope="session")
def duel() -> Arena:
    """The arena of the preset duel on the C engine, built once."""
    return presets.duel().arena.build(engine="c")


@pytest.fixture
def duel_store(tmp_path, duel) -> Iterator[Store]:
    """A store with a league in that arena whose players have yet to take their first turn."""
    from tests.league.turns import new_store

    with new_store(tmp_path / "store", duel) as store:
        yield store


@pytest.fixture
def packed(tmp_path) -> Path:
    """The archive of a league with something in every table, beside the store that it came from."""
    from league import moving
    from tests.league.packs import league_of

    with league_of(tmp_path / "source") as store:
        moving.pack(store, tmp_path / "cup.zip")
    return tmp_path / "cup.zip"
