"""`league browse`: the newest recorded matches as a table, each of which opens in 3D."""

import subprocess
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from league.cast import cast
from league.commands.options import Where, parse
from league.commands.telling import Progress
from league.query import Open
from league.recorded import load, recorded

MOST = 100
"""Matches at once: rerun holds all of them in memory, with some megabytes each."""


@dataclass(frozen=True)
class BrowseOptions(Where):
    """Which matches, and where they are shown."""

    last: int = field(default=20, metadata={"low": 1, "high": MOST})
    """How many, the newest ones."""
    web: bool = False
    """In a browser on this machine instead of a window."""
    port: int = field(default=9090, metadata={"low": 1, "high": 65_535})
    """Where it is served to a browser, at 127.0.0.1."""


def browse(args: list[str]) -> int:
    """Show a table of matches until its window is closed, or until Ctrl-C."""
    options = parse(BrowseOptions, args, "browse", "The newest recorded matches as a table; a click opens one in 3D.")
    from dashboards import viewer
    from dashboards.headless import executable

    if not options.web:
        viewer.require_display("--web for a browser on this machine, or league watch --save match.rrd for a file")
    with tempfile.TemporaryDirectory(prefix="robot-league-matches-") as folder, suppress(KeyboardInterrupt):
        with options.open() as opened:
            _write(opened, Path(folder), options.last)
        with viewer.catalog(Path(folder), options.port if options.web else None) as address:
            if not options.web:
                return subprocess.run([executable(), address], check=False).returncode
            print(f"{address}\nshows them in a browser on this machine: click on league. Ctrl-C ends that.", flush=True)
            while True:
                time.sleep(1)
    return 0


def _write(opened: Open, folder: Path, last: int) -> None:
    """The newest matches as rerun's files."""
    from dashboards import viewer

    matches = recorded(opened)[-last:]
    with Progress("league browse") as progress:
        for number, match in enumerate(matches):
            progress.tell("matches", number, len(matches))
            recording, _ = load(opened, match)
            viewer.write_rrd(recording, folder / f"{match.id}.rrd", cast(opened, match, recording.header.sides))
