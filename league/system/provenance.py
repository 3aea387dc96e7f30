"""Identity of the running code: the same in every process of a league, and recorded with each snapshot.

A process that `league` starts has the import path of its parent, never the working folder first: else a folder with
files of our names, or another checkout, would run instead.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

from league.system.packages import agents_folder
from league.system.packages.versions import versions

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("agents", "arenas", "dashboards", "league", "matchmaking", "storage")
LINE = 200  # maximum characters of the line with the code that made a snapshot
DIGITS = 12  # of a digest, enough to distinguish any two

_BEGIN = (
    "import json, runpy, sys; *words, path = sys.argv[1:]; sys.path[:], sys.argv[:] = json.loads(path), words;"
    " runpy.run_module(words[0], run_name='__main__', alter_sys=True)"
)
_MADE_BY = "# Made by "
_CODE = re.compile(rf"^{_MADE_BY}.*\bcode ([0-9a-f]{{{DIGITS}}})", re.MULTILINE)


def command(module: str, *args: str) -> list[str]:
    """Return the command line that runs one of our modules as `python -m` would, with this process's code."""
    return [sys.executable, "-P", "-c", _BEGIN, module, *args, json.dumps(import_path())]


def import_path() -> list[str]:
    """Return the import path of this process, for a process that may have another working folder."""
    return [folder or os.getcwd() for folder in sys.path]


@cache
def code() -> dict[str, str]:
    """Return the digest of our sources, and in a checkout the commit: `{"code": ..., "commit": ...}`.

    The digest is that of the files at the first call, which each worker makes at its start.
    """
    found = {"code": _digest()}
    if (ROOT / ".git").exists():
        with suppress(OSError, subprocess.SubprocessError):
            git = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
            done = subprocess.run(git, capture_output=True, text=True, timeout=10, check=True)
            found["commit"] = done.stdout.strip()[:DIGITS]
    return found


def made_by() -> str:
    """Return a line, a TOML comment, that identifies the code of this process."""
    state = ", ".join(f"{name} {value}" for name, value in code().items())
    return f"{_MADE_BY}robot-league {versions().get('robot-league', '?')}, {state}.\n"


def code_of(settings: str) -> str | None:
    """Return the digest of the code that made a snapshot with these settings; None if it was not recorded."""
    found = _CODE.search(settings)
    return found[1] if found else None


def _digest() -> str:
    found = hashlib.sha256()
    for package in PACKAGES:
        files = agents_folder.sources() if package == agents_folder.NAME else (ROOT / package).rglob("*.py")
        for path in sorted(files):
            found.update(f"{path.relative_to(ROOT).as_posix()}\0".encode())
            found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:DIGITS]
