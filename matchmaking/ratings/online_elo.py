"""Online Elo over the match log: a running display, not a rating. It depends on the order of the games."""

import math
from collections.abc import Iterable, Mapping

from storage.records import Match

K = 16.0
"""Maximum Elo change per game, for each of the two players."""
START = 1000.0
ELO = 400 / math.log(10)


def online_elo(log: Iterable[Match], parents: Mapping[str, str] | None = None, k: float = K) -> dict[str, float]:
    """Return sequential Elo (Elo 1978) of all players with games: R += K (S - E), E = 1/(1 + 10^(-(R - R')/400)).

    A match's games are played one after the other, each with the match's mean score S (a draw is ½), because the log
    does not tell their order. A snapshot starts with its parent's current Elo, others with START.
    """
    elo: dict[str, float] = {}
    parents = parents or {}
    for m in log:
        if m.b is None or m.a == m.b or not (games := m.wins + m.draws + m.losses):
            continue
        for name in (m.a, m.b):
            elo.setdefault(name, elo.get(parents.get(name, ""), START))
        a, b = elo[m.a], elo[m.b]
        gap, score, step = (a - b) / ELO, (m.wins + m.draws / 2) / games, 2 * k / ELO
        for _ in range(games):
            moved = step * (score - 1 / (1 + math.exp(-gap)))
            gap += moved
            if abs(moved) < 1e-12:
                break
        change = (gap * ELO - (a - b)) / 2
        elo[m.a], elo[m.b] = a + change, b - change
    return elo
