import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# A league as small as can be that still learns, rates and records: 1v1, 64 worlds, 16 episodes per pair and side.
TINY = (
    "--arena.name", "sumo-1v1", "--league", "tiny", "--seed", "3", "--training.worlds", "64", "--rating.worlds", "64",
    "--rating.quota", "32", "--rating.final-quota", "32", "--rating.pairings", "2", "--rating.milestones", "1s",
)  # fmt: skip


def command(*args: str) -> list[str]:
    """The command line as a user's shell would start it."""
    return [sys.executable, "-m", "league", *args]


def call(*args: str, cwd: Path, timeout: float = 240) -> subprocess.CompletedProcess:
    """Run a command to its end."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(command(*args), cwd=cwd, capture_output=True, text=True, timeout=timeout, env=environment)


@pytest.fixture(scope="session")
def tiny_league(tmp_path_factory):
    """The folder in which a tiny league has been run to the end of its budget, and what it printed."""
    folder = tmp_path_factory.mktemp("tiny")
    done = call("run", *TINY, "--steps", "33000", "--budget.rate", "60s", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout
