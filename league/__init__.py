"""Robot League: self-play leagues for teams of robots.

import league
with league.open("league-data") as quickstart:
    print(quickstart.ratings())
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from league.query import Open


def open(where: str = "league-data", league: str | None = None) -> "Open":
    """Open a store's league for reading: a folder or a URL, and a league's name unless it is the one last run.

    Raises storage.errors.StorageError, one line for the user.
    """
    from league.query import Open
    from storage.store import Store

    return Open(Store.open(where), league)
