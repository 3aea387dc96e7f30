"""Warnings about fits with parameters that the games alone do not bound, and about players that no games connect."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.payoff import Payoff
from matchmaking.ratings.separation import Separation, examined

LISTED = 5
"""Most names in a sentence: JSON and CSV have all."""


def as_object(found: Separation, names: Sequence[str]) -> dict[str, Any]:
    """Return the parameters without a finite value, for programs: `side`, `draw`, and `ratings` by name."""
    ratings = {name: bound for name, bound in zip(names, found.ratings, strict=True) if bound}
    return {"side": found.side, "draw": "above" if found.draw else None, "ratings": ratings}


def of_ladder(ladder: Ladder) -> list[str]:
    """Return the sentences of `warnings` for a league's ladder, only about known ratings: no others are shown."""
    return warnings(ladder.separation, ladder.payoff, "the first side", "the prior", shown=ladder.known)


def several_ranked(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether known ratings are on several islands, so that each island has ranks of its own."""
    return len({row["island"] for row in rows if row["known"]}) > 1


def warnings(
    found: Separation,
    payoff: Payoff,
    first: str,
    held: str,
    without_side: str = "",
    own: bool = False,
    shown: Callable[[str], bool] = lambda name: True,
) -> list[str]:
    """Return sentences on what the games do not bound and what to do; none if all is finite and connected.

    Args:
        found: the result of `examined`.
        payoff: the games.
        first: the name of team 0's side, such as "side A".
        held: the cause that bounds the figures nevertheless, such as "the prior (--prior 4)"; empty without a prior.
        without_side: the option that fits without a side advantage, such as "--no-side"; empty if there is none.
        own: whether the games are a log of the user's, whose rows can be changed.
        shown: whether a player's rating is shown.
    """
    left = examined(payoff, False) if found.side and without_side else None
    lines = [_islands(found)] if found.islands > 1 else []
    if found.side:
        lines.append(_side(found, payoff, first, held, without_side, left))
    if found.draw:
        lines.append(_draw(payoff, held, own, cured=left is not None and not left.draw))
    if found.unknown.any():
        lines.append(
            f"The ratings of {int(found.unknown.sum())} of {int((found.island > 0).sum())} players are not known (–):"
            f" {'sides' if found.side else 'draws'} alone can explain their results."
        )
    return [*lines, *_ratings(found, payoff.names, held, shown)]


def _islands(found: Separation) -> str:
    sizes = np.bincount(found.island)[1:]
    shown = ", ".join(map(str, sizes[:LISTED].tolist())) + (", ..." if len(sizes) > LISTED else "")
    return (
        f"No game connects {len(sizes)} islands of players (of {shown} players): a rating compares only within its own"
        " island. Games between players of two islands would connect them."
    )


def _side(found: Separation, payoff: Payoff, first: str, held: str, without_side: str, left: Separation | None) -> str:
    won, drawn, lost = (payoff.home.sum(0) + payoff.away.sum(0)[::-1]).tolist()
    games = f"{won + drawn + lost:,} games"
    if not lost:
        why = f"{first} lost none of {games}"
    elif not won:
        why = f"{first} won none of {games}"
    else:
        why = f"strengths explain each game that {first} did not {'lose' if found.side == 'below' else 'win'}"
    said = f"What {first} is worth has no finite value: {why}."
    if held:
        said += f" Only {held} bounds it, so it is not shown."
    cure = "games that end otherwise would tell"
    if left is not None:
        slip = f"If the log names the winner first, its order says nothing of sides: use {without_side}"
        also = "" if left.finite else " (not all ratings and draws have a finite value then either)"
        return f"{said} {slip}{also}. Else {cure}."
    return f"{said} {cure[0].upper()}{cure[1:]}."


def _draw(payoff: Payoff, held: str, own: bool, cured: bool) -> str:
    games = np.concatenate([payoff.home, payoff.away])
    drawn, decided = games[:, 1] > 0, games[:, [0, 2]].any(1)
    if payoff.rankings and decided.any():
        why = "strengths explain which players were tied"
    elif not decided.any():
        why = "every game was drawn"
    elif not (drawn & decided).any():
        why = "in each pairing every game was drawn, or none"
    else:
        why = "no pairing was won, drawn and lost, and strengths or sides explain which games were drawn"
    said = f"The chance of a draw has no finite value: {why}."
    if held:
        said += f" Only {held} bounds it, so it is not shown."
    if cured:
        return f"{said} Without a side advantage it has one."
    return f"{said} Further games of the same pairings would tell" + (
        ", or rate the decided games alone (draws as 0)." if own and not payoff.rankings else "."
    )


def _ratings(found: Separation, names: Sequence[str], held: str, shown: Callable[[str], bool]) -> list[str]:
    """Name the undefeated players, the winless players, and the players that the games bound in neither direction."""
    lines = []
    for bound, what in (
        ("above", "upper bound (nobody who compares with the others took points from them)"),
        ("below", "lower bound (they took no points from anybody who compares with the others)"),
        ("both", "bound"),
    ):
        of = zip(names, found.ratings, found.unknown, strict=True)
        own = [name for name, one, unknown in of if one == bound and not unknown and shown(name)]
        if own:
            more = f" and {len(own) - LISTED} more" if len(own) > LISTED else ""
            lines.append(f"No {what} by the games alone: {', '.join(own[:LISTED])}{more}.")
    if lines and held:
        lines.append(f"Only {held} keeps these ratings finite; games against players of like strength would tell.")
    return lines
