"""The wheel of this checkout, built from a copy of its sources."""

import shutil
import subprocess
import sys
from pathlib import Path

from tests.league.conftest import ENVIRONMENT, ROOT

SOURCES = (
    "league",
    "arenas",
    "agents",
    "matchmaking",
    "storage",
    "dashboards",
    "pyproject.toml",
    "README.md",
    "LICENSE",
)


def run(*words: str | Path, cwd: Path) -> str:
    """Run a command without this process's import path; fail with what it said."""
    found = {name: value for name, value in ENVIRONMENT.items() if not name.startswith("PYTHON")}
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, timeout=300, env=found)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build_wheel(folder: Path) -> Path:
    """Build it in an empty folder; return its file."""
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, source / name)
    build = (sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, source)
    run(*build, cwd=folder)
    (found,) = folder.glob("robot_league-*.whl")
    return found
