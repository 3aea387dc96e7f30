"""`league browse`: a table of the newest recorded matches, each of which opens in 3D."""

import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from dashboards.errors import ViewerError
from league.commands.options import Where, parse
from league.commands.progress_bar import Progress
from league.queries.match_players import players_of
from league.queries.query import Open
from league.queries.recordings import load, recorded

MOST = 100
"""Most matches at once: rerun holds all of them in memory, with some megabytes each."""


@dataclass(frozen=True)
class BrowseOptions(Where):
    """The matches, and the window or browser that shows them."""

    last: int = field(default=20, metadata={"low": 1, "high": MOST})
    """Number of matches, the newest ones."""
    web: bool = False
    """In a browser on this machine instead of a window."""
    port: int = field(default=9090, metadata={"low": 1, "high": 65_535})
    """Port of the viewer in a browser, at 127.0.0.1."""


def browse(args: list[str]) -> int:
    """Show a table of matches until its window is closed, or until Ctrl-C."""
    options = parse(BrowseOptions, args, "browse", "The newest recorded matches as a table; a click opens one in 3D.")
    from dashboards import viewer
    from dashboards.system.temporary_folders import temporary_folder
    from dashboards.viewer.headless import NO_WINDOW, start_window

    otherwise = "--web for a browser on this machine, or league watch --save match.rrd for a file"
    if not options.web:
        viewer.require_display(otherwise)
    with temporary_folder("robot-league-matches-") as folder, suppress(KeyboardInterrupt):
        with options.open() as opened:
            _write(opened, folder, options.last)
        with viewer.catalog(folder, options.port if options.web else None) as address:
            if not options.web:
                opened_window = start_window(address)
                try:
                    if opened_window.wait() != 0:
                        raise ViewerError(f"{NO_WINDOW}; use {otherwise}")
                    return 0
                finally:
                    opened_window.kill()  # there is no other table
            print(f"{address}\nshows them in a browser on this machine: click on league. Ctrl-C ends that.", flush=True)
            while True:
                time.sleep(1)
    return 0


def _write(opened: Open, folder: Path, last: int) -> None:
    """Write the newest matches as files for rerun."""
    from dashboards import viewer

    matches = recorded(opened)[-last:]
    with Progress("league browse") as progress:
        for number, match in enumerate(matches):
            progress.tell("matches", number, len(matches))
            recording, _ = load(opened, match)
            viewer.write_rrd(recording, folder / f"{match.id}.rrd", players_of(opened, match, recording.header.sides))
