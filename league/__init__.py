"""Robot League: self-play leagues for teams of robots.

import league
with league.open("league-data") as quickstart:
    print(quickstart.ratings())
    print(league.Policy.from_onnx("mine.onnx").play(quickstart, "blue"))
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.learner.interface import Learner as Learner
    from league.matches.own_policy import Policy as Policy
    from league.queries.query import Open
    from league.snapshots.frozen_opponent import FrozenOpponent, ProgramOpponent


def open(where: str = "league-data", league: str | None = None) -> "Open":
    """Open a league for reading. `where` is a store, a folder or a URL; without a name, take the league run last.

    Raises storage.errors.StorageError with a message of one line for the user.
    """
    from league.queries.query import Open
    from storage.store import Store

    return Open(Store.open(where), league)


def opponent(named: str, league: str | None = None) -> "FrozenOpponent | ProgramOpponent":
    """Return a frozen policy as the opponent of an environment: `arenas.vector(name, team, league.opponent(...))`.

    Args:
        named: `STORE#SNAPSHOT`, such as league-data#blue@64, or STORE#PLAYER for its newest; else a policy's file, the
            name of a policy that comes with the league, such as leatherbacks-sumo, or a program as for `league import`:
            rover.onnx, rover.pt, rover.py:act; one for each agent, with commas.
        league: the league in the store, if it has several.

    Raises storage.errors.StorageError, one line for the user.
    """
    from league.snapshots import frozen_opponent

    return frozen_opponent.opponent(named, league)


def __getattr__(name: str) -> Any:
    """Import `Policy` and `Learner` at their first use: they load jax."""
    if name == "Policy":
        from league.matches.own_policy import Policy

        return Policy
    if name == "Learner":
        from agents.learner.interface import Learner

        return Learner
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
