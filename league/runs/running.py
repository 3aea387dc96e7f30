"""`league.run`: a league from a Python program or a notebook, with its progress."""

import os
import shutil
import sys
from collections.abc import Callable, Mapping
from typing import Any

from league.config.experiment import Config
from league.runs.child_run import ChildRun
from league.runs.open_league import OpenLeague
from league.runs.python_settings import config_of
from storage.errors import StorageError
from storage.store import Store

CLEAR = "\r\033[K"  # returns to the beginning of a terminal's line and clears it, as the run prints it
NOTEBOOK_WIDTH = 100  # columns
Progress = bool | Callable[[OpenLeague], Any]


def run(
    config: Config | Mapping[str, Any] | str | os.PathLike[str] | None,
    store: str | os.PathLike[str],
    progress: Progress,
    settings: Mapping[str, Any],
) -> OpenLeague:
    """See `league.run`."""
    where = os.fspath(store)
    chosen = config_of(config, settings, where)
    child, interrupted = ChildRun(where, chosen, _width() if progress is True else None), False
    try:
        while True:
            try:
                _follow(child, where, chosen, progress)
                break
            except KeyboardInterrupt:
                interrupted = True
                child.interrupt()
        child.end()
    finally:
        child.close()
    if interrupted:
        raise KeyboardInterrupt
    return OpenLeague(Store.open(where, blobs=chosen.storage.blobs), chosen.league)


def _follow(child: ChildRun, where: str, config: Config, progress: Progress) -> None:
    """Show the output of a run, or call `progress` with the league, until the run ends."""
    erase = f"\r{' ' * NOTEBOOK_WIDTH}\r" if _in_notebook() else CLEAR  # a notebook knows no codes of terminals
    for text in child.output():
        if progress is True and text:
            print(text.replace(CLEAR, erase), end="", flush=True)
        elif callable(progress) and child.running():
            try:
                with OpenLeague(Store.open(where, blobs=config.storage.blobs), config.league) as opened:
                    progress(opened)
            except StorageError:
                pass  # the league is not made yet, or its store is away


def _width() -> int | None:
    """Return the columns of a status line that is written again and again; None where lines can only follow."""
    if _in_notebook():
        return NOTEBOOK_WIDTH
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def _in_notebook() -> bool:
    return type(sys.stdout).__module__.startswith("ipykernel")
