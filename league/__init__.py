"""Robot League: self-play leagues for teams of robots.

import league
duel = league.run("duel", learner={"lr": 3e-4}, budget={"steps": 100_000})
print(duel.ratings())
with league.open("league-data") as newest:
    print(league.Policy.from_onnx("mine.onnx").play(newest, "blue"))
"""

from typing import TYPE_CHECKING, Any

from league.system.packages.agents_folder import share as _share_agents

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping

    import pandas as pd

    from agents.learner.interface import Learner as Learner
    from league.config.experiment import Config
    from league.matches.own_policy import Policy as Policy
    from league.runs.open_league import OpenLeague
    from league.snapshots.frozen_opponent import FrozenOpponent, ProgramOpponent

_share_agents()


def open(where: str = "league-data", league: str | None = None) -> "OpenLeague":
    """Open a league for reading: tables, payoffs, recordings, policies; see `league.runs.open_league.OpenLeague`.

    Open a store, a folder or a URL; without a name, take the league run last. Raises storage.errors.StorageError with a
    message of one line for the user.
    """
    from league.runs.open_league import OpenLeague
    from storage.store import Store

    return OpenLeague(Store.open(where), league)


def leagues(where: str = "league-data") -> "pd.DataFrame":
    """Return a row for each league of a store, as `league list`: arena, players, newest snapshot, steps, state, ..."""
    import pandas as pd

    from league.state.league_list import league_rows
    from storage.store import Store

    with Store.open(where) as store:
        rows = league_rows(store)
    return pd.DataFrame([{**row, "active": pd.Timestamp(row["active"], unit="s", tz="UTC")} for row in rows])


def run(
    config: "Config | Mapping[str, Any] | str | os.PathLike[str] | None" = None,
    /,
    *,
    store: "str | os.PathLike[str]" = "league-data",
    progress: "bool | Callable[[OpenLeague], Any]" = True,
    **settings: Any,
) -> "OpenLeague":
    """Run a league until its budget is spent, and return it opened. One that was stopped goes on; a finished one waits.

    The league trains in processes of its own, which import nothing of the calling program: a script needs no
    `if __name__ == "__main__"`. Ctrl-C, or a notebook's stop button, lets it finish its iteration and raises
    KeyboardInterrupt; the same call goes on. It also stops when the calling process ends.

    Args:
        config: a mapping such as a parsed league.toml, a Config, the path of a TOML file, or the name of a preset; None
            for the league of the store that was run last, else the quick start.
        store: a folder, or a URL.
        progress: print a line about the state again and again; or a function that is called about twice a second with
            the opened league; or False.
        settings: settings over `config`, as tables or with dotted names: `learner={"lr": 3e-4}`, `seed=3`,
            `**{"learner.lr": 3e-4}`.

    Raises league.config.schema.ConfigError for settings that cannot be, league.runs.child_run.RunError if the league
    cannot run or ends with a fault; each is one line.
    """
    from league.runs import running

    return running.run(config, store, progress, settings)


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
