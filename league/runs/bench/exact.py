"""Entries of the exact tasks: policies of small games of turns, as tables whose exploitability anybody can compute."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from league.config.schema import ConfigError
from league.matches.exact_exploitability import KnownGame
from league.runs.bench.entrants import Entrant
from league.runs.bench.partial_rows import Row
from league.runs.bench.tasks import Task
from league.snapshots.policy_file import Policy
from matchmaking.extensive_games import best_response

DIGITS = 6
LARGEST = 1000
"""Information states up to which an entry's file holds the whole table, to be computed again."""


def rows(task: Task, entrants: Sequence[Entrant]) -> list[Row]:
    """Return a row for each policy: its table if the game is small, and its exploitability.

    Raises ConfigError, one line, for a program, whose probabilities cannot be read, and for a recurrent policy.
    """
    from agents.policy.jax_policy import policy_params

    game, found = KnownGame(task.arena), []
    for entrant in entrants:
        if not isinstance(entrant.content, Policy):
            raise ConfigError(
                ("entry",), f"{entrant.files[0]} is a program, whose probabilities cannot be read: {task.name} takes"
                " policies that `league export` wrote",
            )  # fmt: skip
        arrays = {name.removeprefix("0/"): array for name, array in entrant.content.arrays.items()}
        table = game.table(policy_params(arrays), entrant.files[0])
        rounded = np.round(np.array([table[key] for key in game.known]), DIGITS)
        small = len(rounded) <= LARGEST
        found.append({
            "a": entrant.name, "table": rounded.tolist() if small else None, **exploitability(game, rounded)
        })  # fmt: skip
    return found


def exploitability(game: KnownGame, table: np.ndarray) -> dict[str, Any]:
    """Return the exact exploitability of a table (information states, actions), in the order of the game's own."""
    scaled = table / table.sum(1, keepdims=True)
    found = best_response.exploitability(game.rules, dict(zip(game.known, scaled, strict=True)))
    values = [round(float(value), DIGITS) for value in found.best_response_values]
    return {
        "exploitability": round(found.exploitability, DIGITS), "nash_conv": round(found.nash_conv, DIGITS),
        "best_response_values": values,
    }  # fmt: skip


def metrics(task: Task, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the metrics of an exact task; tables are solved again, larger games are taken as they are."""
    game, found = KnownGame(task.arena) if any(row["table"] for row in rows) else None, []
    for row in rows:
        own = {key: row[key] for key in ("exploitability", "nash_conv", "best_response_values")}
        if game is not None and row["table"]:
            own = exploitability(game, np.array(row["table"], float))
        found.append({"name": row["a"], **own, "ranked": True})
    return {"policies": found}
