"""Support for leagues that are older than the declaration of exchangeable teams by arenas.

In such a league teams with equal rosters are exchangeable: its teams swap sides and have one ladder, regardless of what
its arena declares today. A new league follows the declaration of the arena (`arenas.rosters`).
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from arenas.rosters import roster_side
from storage.errors import NotAStore
from storage.records import Player
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena


def as_made(arena: "Arena", players: Sequence[Player]) -> "Arena":
    """Return the arena, made exchangeable if the league of these players needs that; a new league has no players."""
    rosters = {player.roster for player in players}
    one_roster = len(rosters) == 1 and not roster_side(*rosters)
    if not arena.exchangeable and one_roster and len({player.team for player in players}) > 1:
        arena.exchange_teams()
    return arena


def players_in(where: str, blobs: str | None, league: str) -> Sequence[Player]:
    """Return the players of a league of the store at `where`; empty if the store or the league does not exist yet."""
    try:
        with Store.open(where, blobs=blobs) as store:
            return store.players(league)
    except NotAStore:
        return ()
