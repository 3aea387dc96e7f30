"""Comparisons of snapshots in words: who is stronger, and by which games that is known."""

from league.queries.query import score_text
from matchmaking.ratings.comparison import CYCLIC_ELO, Comparison


def evidence_text(found: Comparison) -> str:
    """Name the stronger of two snapshots and the evidence, or say that it is not known."""
    first, second = found.first, found.second
    if found.direct:
        by = f"{first} scores {score_text(found.score)} against {second}"
    else:
        met = f"after {found.score.games} games between the two" if found.score.games else "the two have not met"
        room = f"± has room for a cyclic term of {CYCLIC_ELO:.0f} Elo"
        by = f"by the ratings {first} is {found.gap:.0f} ± {found.error:.0f} Elo ahead of {second} ({met}; {room})"
    if found.sure:
        return f"{first} is stronger than {second}: {by}."
    return f"It is not known whether {first} or {second} is stronger: {by}."


def short_evidence(found: Comparison) -> str:
    """Return what the first has in a few words, e.g. `scores 81.2 % (75.0-86.1) of 256` or `is 85 ± 40 Elo ahead`."""
    if found.direct:
        return f"scores {score_text(found.score)}"
    return f"is {found.gap:.0f} ± {found.error:.0f} Elo ahead"
