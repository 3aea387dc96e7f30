"""Payoff: wins, draws and losses between snapshots, summed from the match log.

Below P is the number of snapshots and E the number of pairs of snapshots that met.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from matchmaking.ratings.rankings import NO_RANKINGS, PairsBySeed, Rankings, lineups_of, pair_rows
from matchmaking.ratings.scores import SUSPECT, Score, effective_games, effective_seeds, mean_interval, wilson
from storage.errors import StorageError
from storage.records import COUNT_COLUMNS, ArenaKey, LineupTotals, Match, MatchTotals, RankedMatch

MAX_GAMES = 10**15
"""Maximum number of games in a log: above it sums would not be exact, and databases write infinity as such a number."""


class Contradiction(StorageError, ValueError):  # noqa: N818
    """A row of a match log is impossible, whatever was played; the store that has it is damaged."""


@dataclass(frozen=True, eq=False)
class Payoff:
    """Counts of all games between P snapshots, stored per pair that met (`first` < `second`, indices into `names`).

    All counts are from `first`'s point of view. Nothing here depends on the order of matches, nor on which of the two
    snapshots a match called A. In a ranked match each two teams count as one game, at home; `rankings` has the whole
    outcomes, to which ratings are fitted.
    """

    names: tuple[str, ...]  # (P,) of snapshots, sorted
    first: np.ndarray  # (E,) int
    second: np.ndarray  # (E,) int
    home: np.ndarray  # (E, 3) int: wins, draws, losses of first while it played team 0
    away: np.ndarray  # (E, 3) int: the same while second played team 0
    pairs: np.ndarray  # (E, 5) int: seed pairs by first's score: LL, LD, DD or WL, DW, WW
    voids: np.ndarray  # (E,) int: void episodes
    at_fault: np.ndarray  # (E, 2) int: those of them in which only first's robots failed, or only second's
    third_voids: np.ndarray  # (E,) int, in ranked matches: void episodes besides, in which only a third team failed
    trials: np.ndarray  # (P, 4) int, in arenas of one team: successes, failures, voids, voids by its own robots
    last: np.ndarray  # (P,) when its newest match was written, in seconds since the epoch; 0 without one
    arena: ArenaKey | None = None  # of the matches; None without any
    rankings: Rankings = NO_RANKINGS  # of ranked matches

    @cached_property
    def positions(self) -> dict[str, int]:
        """Position of each snapshot in `names`."""
        return {name: i for i, name in enumerate(self.names)}

    def index(self, name: str) -> int:
        """Return the position of a snapshot in `names`; ValueError if it is not there."""
        if name not in self.positions:
            raise ValueError(f"snapshot {name!r} is not among the {len(self.names)} of this payoff; see Payoff.names")
        return self.positions[name]

    @cached_property
    def results(self) -> np.ndarray:
        """Wins, draws and losses (P, 3) of each snapshot, over all its games."""
        both = self.home + self.away
        return self._each(both, both[:, ::-1])

    @cached_property
    def played(self) -> np.ndarray:
        """Valid games (P,) of each snapshot, counted by pair: three of each ranking of four teams."""
        return self.results.sum(1)

    @cached_property
    def ranked_or_played(self) -> np.ndarray:
        """Valid episodes (P,) of each snapshot, in each of which it has one result or one rank."""
        return self.rankings.episodes(len(self.names)) if self.rankings else self.played

    @cached_property
    def valid_episodes(self) -> int:
        """Valid episodes of all matches, each once, whatever its number of teams."""
        of_pairs = 0 if self.rankings else int(self.home.sum() + self.away.sum())
        return sum(int(each.number.sum()) for each in self.rankings.blocks) + of_pairs + int(self.trials[:, :2].sum())

    @cached_property
    def total_episodes(self) -> np.ndarray:
        """Episodes (P,) of each snapshot, void ones included."""
        return self.played + self._each(self.voids[:, None], self.voids[:, None])[:, 0]

    def edges(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return the index of the pair of i and j; -1 if they never met. Arrays of any shapes that broadcast."""
        i, j = np.broadcast_arrays(i, j)
        wanted = np.minimum(i, j) * len(self.names) + np.maximum(i, j)
        if not len(self._keys):
            return np.full(wanted.shape, -1)
        place = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        return np.where(self._keys[place] == wanted, place, -1)

    def between(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return (..., 9) wins, draws and losses of i against j, the five pair counts and voids; 0 without games."""
        edge = self.edges(i, j)
        if not len(self.first):
            return np.zeros((*edge.shape, 9), np.int64)
        turned = np.broadcast_to((np.asarray(i) > np.asarray(j))[..., None], (*edge.shape, 1))
        games, pairs = self.home[edge] + self.away[edge], self.pairs[edge]
        found = np.concatenate([
            np.where(turned, games[..., ::-1], games), np.where(turned, pairs[..., ::-1], pairs),
            self.voids[edge][..., None],
        ], -1)  # fmt: skip
        return np.where((edge >= 0)[..., None], found, 0)

    def episodes_between(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return the episodes that i and j have played together, void ones included; arrays as for `edges`.

        Those that a third team alone made void are included too: a pair that meets only beside it has met nevertheless.
        """
        edge = self.edges(i, j)
        if not len(self.first):
            return np.zeros(edge.shape, np.int64)
        games = self.home[edge].sum(-1) + self.away[edge].sum(-1)
        return np.where(edge >= 0, games + self.voids[edge] + self.third_voids[edge], 0)

    def block(self, rows: Sequence[int] | np.ndarray, columns: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return (4, R, C) wins, draws and losses of the rows against the columns, and voids."""
        found = np.zeros((4, len(rows), len(columns)), np.int64)
        to_row, to_column = (np.full(len(self.names), -1) for _ in range(2))
        to_row[rows], to_column[columns] = np.arange(len(rows)), np.arange(len(columns))
        both = self.home + self.away
        for own, other, games in ((self.first, self.second, both), (self.second, self.first, both[:, ::-1])):
            row, column = to_row[own], to_column[other]
            inside = (row >= 0) & (column >= 0)
            found[:3, row[inside], column[inside]] = games[inside].T
            found[3, row[inside], column[inside]] = self.voids[inside]
        return found

    @cached_property
    def _keys(self) -> np.ndarray:
        """The pairs that met as ascending numbers (E,): `sum_matches` sorts them."""
        return self.first * len(self.names) + self.second

    def _each(self, of_first: np.ndarray, of_second: np.ndarray) -> np.ndarray:
        """Return sums (P, K) over each snapshot's pairs of counts (E, K) for their first and for their second."""
        found = np.zeros((len(self.names), of_first.shape[1]), np.int64)
        for ends, counts in ((self.first, of_first), (self.second, of_second)):
            for k, column in enumerate(counts.T):  # exact: sums of floating-point numbers are, below 2⁵³
                found[:, k] += np.bincount(ends, column, len(self.names)).astype(np.int64)
        return found

    # Tables of all pairs: each takes 800 MB for 10,000 snapshots.

    @cached_property
    def wins(self) -> np.ndarray:
        """Games (P, P) that i won against j; its transpose holds the losses."""
        return self._square(self.home[:, 0] + self.away[:, 0], self.home[:, 2] + self.away[:, 2])

    @cached_property
    def draws(self) -> np.ndarray:
        """Games (P, P) drawn between i and j, symmetric."""
        drawn = self.home[:, 1] + self.away[:, 1]
        return self._square(drawn, drawn)

    @property
    def losses(self) -> np.ndarray:
        """Games (P, P) that i lost against j."""
        return self.wins.T

    @cached_property
    def games(self) -> np.ndarray:
        """Valid games (P, P) between i and j, symmetric."""
        return self.wins + self.draws + self.losses

    @cached_property
    def episodes(self) -> np.ndarray:
        """Episodes (P, P) played between i and j, void ones included, symmetric."""
        return self.games + self._square(self.voids, self.voids)

    def scores(self) -> np.ndarray:
        """Return the mean score (P, P) of i against j, nan if they never met."""
        with np.errstate(invalid="ignore"):
            return (self.wins + 0.5 * self.draws) / self.games

    def score(self, a: str, *others: str, confidence: float = 0.95) -> Score:
        """Return the mean score of a over its games against all of `others`, with the interval of `score_interval`.

        Raises ValueError for an unknown name. Repeated names count once.
        """
        met = np.array([self.index(name) for name in dict.fromkeys(others)], int)
        return self.scores_of(np.array(self.index(a)), met, np.zeros(len(met), int), 1, confidence)[0]

    def mean_score(self, a: str, *others: str) -> Score:
        """Return the mean of the scores of a against each of `others` with games; repeated names count once.

        In contrast to `score`, each of them has the same weight, however many games there are.
        """
        own, met = np.array(self.index(a)), np.array([self.index(name) for name in dict.fromkeys(others)], int)
        counts = self.between(own, met)
        played, voids = counts[:, :3].any(1), int(counts[:, 8].sum())
        if not played.any():
            return Score(float("nan"), 0.0, 1.0, 0, voids)
        wins, draws, losses = counts[played][:, :3].T
        games = wins + draws + losses
        if self.rankings:
            by_seed = self._pairs_by_seed.scores(own, met[played], np.zeros(len(games), int), 1 / games)
            (mean,), effective = effective_seeds(by_seed, 1)
            low, high = wilson(mean, effective.item(), 0.95)
        else:
            mean, low, high = mean_interval(wins, draws, losses, counts[played][:, 3:8])
        return Score(float(mean), float(low), float(high), int(games.sum()), voids)

    def scores_of(
        self, i: np.ndarray, j: np.ndarray, group: np.ndarray, groups: int, confidence: float = 0.95
    ) -> list[Score]:
        """Return the score of i over the games against j, arrays that broadcast, for each group (M,) of pairs."""
        counts, s, effective = self.effective_scores(i, j, group, groups, confidence)
        low, high = wilson(s, effective, confidence)
        games, voids = counts[:, :3].sum(1), counts[:, 8]
        told = (np.where(games > 0, s, np.nan), low, high, games, voids)
        return [Score(*each) for each in zip(*(column.tolist() for column in told), strict=True)]

    def effective_scores(
        self, i: np.ndarray, j: np.ndarray, group: np.ndarray, groups: int, confidence: float = 0.95
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for each group of pairs i, j the counts (G, 9) of `between`, the mean score (G,) of i, and n* (G,).

        n* is the equivalent number of decisive games, see `scores.effective_games` and `scores.effective_seeds`.
        """
        counts = np.zeros((groups, 9), np.int64)
        np.add.at(counts, group, self.between(i, j))
        wins, draws, losses, *pairs = counts[:, :8].T
        s, effective = effective_games(wins, draws, losses, np.stack(pairs, -1), confidence)
        if self.rankings:
            by_seed = self._pairs_by_seed.scores(i, j, group, np.ones(len(group)))
            effective = effective_seeds(by_seed, groups, confidence)[1]
        return counts, s, effective

    @cached_property
    def _pairs_by_seed(self) -> PairsBySeed:
        return self.rankings.by_seed(len(self.names))

    @cached_property
    def suspect(self) -> frozenset[frozenset[str]]:
        """Pairs of snapshots whose score against each other is suspect, by name."""
        games = (self.home + self.away).sum(1)
        found = np.flatnonzero(self.voids > SUSPECT * games)
        return frozenset(frozenset((self.names[self.first[e]], self.names[self.second[e]])) for e in found)

    def against(self, a: str, others: Iterable[str]) -> tuple[int, ...]:
        """Return wins, draws, losses and the five pair counts of a against all of `others`, each name once."""
        met = np.array([self.index(name) for name in dict.fromkeys(others)], int)
        return tuple(self.between(np.array(self.index(a)), met)[:, :8].sum(0).tolist())

    def _square(self, forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
        """Return per-pair counts as a (P, P) matrix: `forward` for (first, second), `backward` for (second, first)."""
        square = np.zeros((len(self.names), len(self.names)), np.int64)
        square[self.first, self.second] = forward
        square[self.second, self.first] = backward
        return square


def sum_matches(
    matches: Sequence[Match | RankedMatch] | MatchTotals, players: Iterable[str] = (), onto: Payoff | None = None
) -> Payoff:
    """Sum a match log into a Payoff.

    Args:
        matches: rows of one ArenaKey, or their sums. A snapshot's matches against itself say nothing about strength and
            are left out; those without an opponent, from an arena of one team, count as `trials`.
        players: names of snapshots that have a place even if they have not played yet.
        onto: sums of earlier rows of the same log; the result is the same as of all rows together.

    Raises:
        ValueError: matches of several ArenaKeys, which cannot be compared, or a row whose counts contradict each other.
    """
    arenas = _arenas(matches) | ({onto.arena} if onto and onto.arena else set())
    if len(arenas) > 1:
        raise ValueError(f"matches of {len(arenas)} arenas cannot be compared; choose one of {sorted(arenas)}")
    of_a, of_b, counts, created, lineups = _columns(matches)
    ranked = {name for snapshots in lineups for name in snapshots}
    names = tuple(sorted({*players, *of_a, *of_b, *ranked, *(onto.names if onto else ())} - {None}))
    place: dict[str | None, int] = {name: i for i, name in enumerate(names)}
    a, b = (np.array([place.get(name, -1) for name in of], np.int64) for of in (of_a, of_b))
    alone, met = b < 0, (b >= 0) & (a != b)
    table = _of_first(a[met], b[met], counts[met])
    trials, last = np.zeros((len(names), 4), np.int64), np.zeros(len(names))
    wins, draws, losses, voids, voids_a = counts[alone][:, [0, 1, 2, 11, 12]].T
    np.add.at(trials, a[alone], np.stack([wins, draws + losses, voids, voids_a], 1))
    for who, when in ((a, created), (b[~alone], created[~alone])):
        np.maximum.at(last, who, when)
    rankings = Rankings.of(lineups, place)
    table = np.concatenate([table, pair_rows(rankings, lineups, place)])
    for snapshots, totals in lineups.items():
        at = [place[name] for name in snapshots]
        last[at] = np.maximum(last[at], totals.created)
    # Pairs are numbered by position, so sums do not depend on the order of rows (and integers add exactly).
    pair = table[:, 0] * len(names) + table[:, 1]
    order = np.argsort(pair, kind="stable")
    starts = np.flatnonzero(np.diff(pair[order], prepend=-1))
    keys, sums = pair[order[starts]], np.zeros((len(starts), 15), np.int64)
    if len(starts):
        np.add.reduceat(table[order, 2:], starts, out=sums)
    columns = np.split(sums, [3, 6, 11, 12, 14], axis=1)
    if onto is not None:
        now = np.array([place[name] for name in onto.names], np.int64)
        trials[now] += onto.trials
        last[now] = np.maximum(last[now], onto.last)
        rankings = rankings.plus(onto.rankings.renumbered(now))
        before = (onto.home, onto.away, onto.pairs, onto.voids[:, None], onto.at_fault, onto.third_voids[:, None])
        keys, columns = _merged(now[onto.first] * len(names) + now[onto.second], before, keys, columns)
    first, second = np.divmod(keys, max(len(names), 1))
    home, away, pairs, void, at_fault, third = columns
    key = next(iter(arenas), None)
    void, third = void[:, 0], third[:, 0]
    return Payoff(names, first, second, home, away, pairs, void, at_fault, third, trials, last, key, rankings)


def _merged(
    keys: np.ndarray, counts: Sequence[np.ndarray], new_keys: np.ndarray, new_counts: Sequence[np.ndarray]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the counts of pairs and those of new games, by ascending pair, as both are given.

    The pairs are not sorted again: a plan adds a few games to very many.
    """
    place = np.searchsorted(keys, new_keys)
    known = np.zeros(len(new_keys), bool)
    known[place < len(keys)] = keys[place[place < len(keys)]] == new_keys[place < len(keys)]
    keys = np.insert(keys, place[~known], new_keys[~known])
    found, at = [], np.searchsorted(keys, new_keys[known])
    for old, new in zip(counts, new_counts, strict=True):
        merged = np.insert(old, place[~known], new[~known], axis=0)  # a copy in any case
        merged[at] += new[known]
        found.append(merged)
    return keys, found


def rankings_payoff(names: tuple[str, ...], rankings: Rankings) -> Payoff:
    """Return the payoff of rankings of players with these names, which are sorted."""
    first, second, games = rankings.pairs(len(names))
    E, P = len(first), len(names)
    shapes = (E, 3), (E, 5), E, (E, 2), E, (P, 4)
    away, pairs, voids, at_fault, third, trials = (np.zeros(shape, int) for shape in shapes)
    return Payoff(names, first, second, games, away, pairs, voids, at_fault, third, trials, np.zeros(P), None, rankings)


def _arenas(matches: Sequence[Match | RankedMatch] | MatchTotals) -> set[ArenaKey]:
    return {matches.arena} if isinstance(matches, MatchTotals) else {match.arena for match in matches}


def _columns(
    matches: Sequence[Match | RankedMatch] | MatchTotals,
) -> tuple[Sequence[str], Sequence[str | None], np.ndarray, np.ndarray, Mapping[tuple[str, ...], LineupTotals]]:
    """Return a log's columns: a, b, counts (rows, 14) in the order of COUNT_COLUMNS, and when each row was written.

    The last value has the sums of ranked matches.
    """
    if not isinstance(matches, MatchTotals):
        pairs = [m for m in matches if isinstance(m, Match)]
        matches = MatchTotals(
            ArenaKey("", "", ""), [m.a for m in pairs], [m.b for m in pairs], [_counts(m) for m in pairs],
            [m.created for m in pairs], 0, lineups_of(m for m in matches if isinstance(m, RankedMatch)),
        )  # fmt: skip
    try:
        counts = np.asarray(matches.counts, np.int64).reshape(-1, len(COUNT_COLUMNS))
        created = np.asarray(matches.created, float)
    except (ValueError, TypeError, OverflowError) as error:
        raise Contradiction(f"the log of matches is damaged: {str(error)[:80]}") from None
    if not np.isfinite(created).all() or (np.abs(counts) > MAX_GAMES).any():
        raise Contradiction("the log of matches is damaged: a time or a count of games is not finite")
    _check(matches.a, matches.b, counts)
    return matches.a, matches.b, counts, created, matches.lineups


def _counts(m: Match) -> tuple[int, ...]:
    sides = (m.side_wins, m.side_draws, m.side_losses)
    return (m.wins, m.draws, m.losses, *sides, *m.pairs, m.voids, m.voids_a, m.voids_b)


def _check(a: Sequence[str], b: Sequence[str | None], counts: np.ndarray) -> None:
    """Raise Contradiction for a row whose counts contradict each other."""
    home, pairs, voids = counts[:, 3:6], counts[:, 6:11], counts[:, 11]
    away = counts[:, :3] - home
    wrong = (counts < 0).any(1) | (away < 0).any(1) | (counts[:, 12:].sum(1) > voids)
    wrong |= pairs.sum(1) > np.minimum(home.sum(1), away.sum(1))
    for i in np.flatnonzero(wrong)[:1]:
        against = f" against {b[i]}" if b[i] else ""
        raise Contradiction(
            f"a match of {a[i]}{against} contradicts itself: side counts must not exceed the totals, each seed pair"
            " needs a valid game on either side, and a void has one culprit at most"
        )


def _of_first(a: np.ndarray, b: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return (rows, 17): first, second, home ×3, away ×3, pairs ×5, voids, culprits ×2 and no voids of a third team.

    They are seen from the first by name.
    """
    home, pairs, voids, at_fault = counts[:, 3:6], counts[:, 6:11], counts[:, 11:12], counts[:, 12:]
    away, turned = counts[:, :3] - home, (a > b)[:, None]
    # B's away games are those in which A played team 0, and A's losses are B's wins.
    return np.column_stack([
        np.minimum(a, b), np.maximum(a, b),
        np.where(turned, away[:, ::-1], home), np.where(turned, home[:, ::-1], away),
        np.where(turned, pairs[:, ::-1], pairs), voids, np.where(turned, at_fault[:, ::-1], at_fault),
        np.zeros_like(a),
    ])  # fmt: skip
