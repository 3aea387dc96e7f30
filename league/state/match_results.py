"""Results of one snapshot in a match of any number of teams."""

from collections import Counter

from storage.records import Match, RankedMatch


def results_of(match: Match | RankedMatch, name: str) -> tuple[int, int, int]:
    """Return wins, draws and losses of a snapshot in a match; of more than two teams, against each other snapshot."""
    if isinstance(match, Match):
        wins, losses = (match.wins, match.losses) if match.a == name else (match.losses, match.wins)
        return wins, match.draws, losses
    found = Counter[int]()
    for ranks, episodes in match.rankings.items():
        for own, mine in zip(match.snapshots, ranks, strict=True):
            for other, theirs in zip(match.snapshots, ranks, strict=True):
                if own == name and other != name:
                    found[(theirs > mine) - (theirs < mine)] += episodes
    return found[1], found[0], found[-1]
