"""Rows of matches, made of played episodes. Nothing else makes a row of them."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agents.rollout.rollout import PlayedEpisodes
from league.state.jobs import RatingMatch
from matchmaking.ratings.scores import Score, SeedScores, effective_seeds, wilson
from storage.records import ArenaKey, Match, PairCounts, RankedMatch, SeedCluster, competition_ranks


def match_row(
    league: str, key: ArenaKey, names: tuple[str, str | None],
    games: PlayedEpisodes, worlds: np.ndarray, at: np.ndarray,
    task: RatingMatch, seconds: float = 0.0, recording: str | None = None, seed_pairs: bool = False,
) -> Match:  # fmt: skip
    """Return the complete row of a match of one team or two. `ranked_row` returns that of more.

    Args:
        league: the league's name.
        key: the arena under which the match counts.
        names: the snapshots A and B; no B in an arena of one team.
        games: the played episodes.
        worlds: (n,) worlds whose episodes belong to the match.
        at: (n,) the team of A in each of these worlds.
        task: the task of the match, which has its seed, its purpose and the time to which it is booked.
        seconds: device time of the match.
        recording: digest of its recording.
        seed_pairs: whether the second half of `worlds` repeats the first half's seeds with swapped sides.
    """
    tally, pairs = tallied(games, worlds, at), PairCounts()
    if seed_pairs:
        both = tally.valid.reshape(2, -1).all(0)
        points = tally.results.reshape(2, -1).sum(0)[both]  # -2, -1, 0, 1, 2
        pairs = PairCounts(*(int((points == p).sum()) for p in (-2, -1, 0, 1, 2)))
    return Match(
        league, key, *names, *tally.counts, tally.voids, *tally.home, pairs, task.seed, tally.steps, task.purpose,
        recording, *tally.broke, seconds=seconds, due=task.due, causes=tally.causes,
    )  # fmt: skip


def ranked_row(
    league: str, key: ArenaKey, names: Sequence[str], games: PlayedEpisodes, worlds: np.ndarray, task: RatingMatch,
    seconds: float = 0.0, recording: str | None = None,
) -> RankedMatch:  # fmt: skip
    """Return the complete row of a match of three or more teams, whose snapshots `names` has in team order.

    The other arguments are those of `match_row`.
    """
    score, void = np.asarray(games.score)[worlds], np.asarray(games.void)[worlds]
    rankings = Counter(competition_ranks(tuple(places)) for places in (-score[~void]).tolist())
    alone = _alone_at_fault(games, worlds)
    return RankedMatch(
        league, key, tuple(names), dict(sorted(rankings.items())), int(void.sum()), tuple(alone.sum(0).tolist()),
        task.seed, int(games.decisions[worlds].sum()), task.purpose, recording, seconds, task.due,
        _causes(games, worlds[void]),
    )  # fmt: skip


def seed_clusters(
    seatings: Sequence[Sequence[str]], games: PlayedEpisodes, worlds: np.ndarray
) -> dict[SeedCluster, int]:
    """Return the seeds from which all seatings of a lineup ended without a void, counted by their rankings.

    Args:
        seatings: (K,) the names of the snapshots in team order.
        games: the played episodes.
        worlds: (K, n) the world in which each seating was played from each seed.
    """
    score, void = np.asarray(games.score)[worlds], np.asarray(games.void)[worlds]
    by_name = np.argsort(np.array(seatings), axis=1, kind="stable")  # equal names are one snapshot
    place = np.argsort(by_name[0])
    orders = by_name[:, place]  # the team in which each seating has the snapshots of the first seating's teams
    alike = np.take_along_axis(-score, orders[:, None], 2)[:, ~void.any(0)]
    found = Counter(tuple(competition_ranks(tuple(each)) for each in one) for one in alike.swapaxes(0, 1).tolist())
    return dict(sorted(found.items()))


def scores_by_seed(
    games: PlayedEpisodes, worlds: np.ndarray, starts: np.ndarray, names: Sequence[Sequence[str]], seats: np.ndarray
) -> dict[str, Score]:
    """Return each snapshot's score against all others in some episodes, with an interval that takes account of seeds.

    Args:
        games: the played episodes.
        worlds: (n,) the worlds that count.
        starts: (n,) a number for each of them; those with the same one share a seed.
        names: (K,) the names of the snapshots in team order of each seating.
        seats: (n,) the seating in each world, as its index in `names`.
    """
    score, void = np.asarray(games.score)[worlds], np.asarray(games.void)[worlds]
    known, rows = sorted({name for seating in names for name in seating}), []
    for k, seating in enumerate(names):
        at = np.flatnonzero(~void & (seats == k))
        for group, name in enumerate(known):
            own, others = np.flatnonzero([s == name for s in seating]), np.flatnonzero([s != name for s in seating])
            points = (np.sign(score[at][:, own, None] - score[at][:, None, others]) + 1).sum((1, 2)) / 2
            if len(own) and len(others):
                weight = np.full(len(at), len(own) * len(others))
                rows.append(np.stack([np.full(len(at), group), starts[at], weight, points]))
    group, start, weight, points = np.concatenate([np.zeros((4, 0)), *rows], 1)
    _, kind = np.unique(start, return_inverse=True)
    one, group = np.ones(kind.max(initial=-1) + 1, int), group.astype(int)
    s, effective = effective_seeds(SeedScores(group, kind, weight, points, one, one), len(known))
    low, high = wilson(s, effective, 0.95)
    number = np.bincount(group, weight, len(known)).astype(int).tolist()
    found = zip(known, s.tolist(), low.tolist(), high.tolist(), number, strict=True)
    return {name: Score(*score) for name, *score in found if score[-1]}


def _alone_at_fault(games: PlayedEpisodes, worlds: np.ndarray) -> np.ndarray:
    """Return (n, teams) bool: the void episodes in which only that team's robots were at fault."""
    void, at_fault = np.asarray(games.void)[worlds], np.asarray(games.at_fault)[worlds]
    return (void & (at_fault.sum(1) == 1))[:, None] & at_fault


def _causes(games: PlayedEpisodes, void_worlds: np.ndarray) -> int:
    """Return the bits of `arenas.physics.void_causes` that occurred in any of these void episodes."""
    return 0 if games.causes is None else int(np.bitwise_or.reduce(np.asarray(games.causes)[void_worlds]))


class Tally(NamedTuple):
    """Results of some episodes for A. In an arena of one team a win is a success."""

    results: np.ndarray  # (n,) 1, 0, -1
    valid: np.ndarray  # (n,) whether the episode is not void
    counts: tuple[int, int, int]  # wins, draws, losses of the valid ones
    home: tuple[int, int, int]  # the same, only episodes in which A played team 0
    voids: int
    broke: tuple[int, int]  # void episodes in which only A's robots were at fault, only B's
    steps: int
    causes: int = 0  # bits of arenas.physics.void_causes that occurred in any void episode


def tallied(games: PlayedEpisodes, worlds: np.ndarray, at: np.ndarray) -> Tally:
    """Count the episodes of these worlds (n,) for A, which played team `at` (n,) of each."""
    score, valid = np.asarray(games.score)[worlds], ~np.asarray(games.void)[worlds]
    each, alone = np.arange(len(worlds)), _alone_at_fault(games, worlds)
    if score.shape[1] == 1:
        results, broke = np.sign(score[:, 0] - 0.5).astype(int), (int(alone.sum()), 0)
    else:
        results = np.sign(score[each, at] - score[each, 1 - at]).astype(int)
        broke = int(alone[each, at].sum()), int(alone[each, 1 - at].sum())

    def counted(which: np.ndarray) -> tuple[int, int, int]:
        wins, draws, losses = (int((which & (results == r)).sum()) for r in (1, 0, -1))
        return wins, draws, losses

    counts, home = counted(valid), counted(valid & (at == 0))
    steps, causes = int(games.decisions[worlds].sum()), _causes(games, worlds[~valid])
    return Tally(results, valid, counts, home, int((~valid).sum()), broke, steps, causes)
