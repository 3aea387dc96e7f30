"""Rankings of games of several teams, as arrays: what Plackett and Luce's model is fitted to, and their pairs.

Below P is the number of players, R the number of different rankings of n players each.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from matchmaking.ratings.scores import SeedScores
from storage.records import LineupTotals, RankedMatch, SeedCluster

MAX_TABLE = 4_000_000
"""Maximum number P² of pairs that are counted in a table; above, they are sorted."""


class Block(NamedTuple):
    """Rankings of n players each."""

    players: np.ndarray  # (R, n) int: indices of players, from best to worst; tied players by index
    ranks: np.ndarray  # (R, n) int: standard competition ranks from 1, not decreasing along a row
    number: np.ndarray  # (R,) int: how often each occurred


class ClusterBlock(NamedTuple):
    """Kinds of seed clusters: k rankings of the same n players, of games that share a seed. C is their number."""

    players: np.ndarray  # (C, k, n) int: of each ranking from best to worst; tied players by index
    ranks: np.ndarray  # (C, k, n) int, as in Block
    number: np.ndarray  # (C,) int: how often each occurred

    @property
    def rankings(self) -> Block:
        """The rankings (C k) of all clusters, each once."""
        n = self.players.shape[2]
        return Block(self.players.reshape(-1, n), self.ranks.reshape(-1, n), np.ones(self.players[..., 0].size, int))


class PairsBySeed(NamedTuple):
    """Games of two players each in M kinds of seed clusters or of single rankings; U is the number of kinds."""

    players: int  # P
    pair: np.ndarray  # (M,) int: first P + second, ascending; first is the smaller index
    kind: np.ndarray  # (M,) int
    games: np.ndarray  # (M,) between the two in one seed of that kind, or in one ranking
    points: np.ndarray  # (M,) of first in these games
    number: np.ndarray  # (U,) how often each kind occurred
    effect: np.ndarray  # (U,) as in SeedScores: 1, or the number of rotations where it is unknown which share a seed

    def scores(self, i: np.ndarray, j: np.ndarray, group: np.ndarray, weight: np.ndarray) -> SeedScores:
        """Return the scores of i against j, which broadcast to (Q,), in groups (Q,).

        `weight` (Q,) is that of a game between the two.
        """
        i, j = np.broadcast_arrays(i, j)
        wanted = np.minimum(i, j) * self.players + np.maximum(i, j)
        first, last = (np.searchsorted(self.pair, wanted, side) for side in ("left", "right"))
        asked = np.repeat(np.arange(len(wanted)), last - first)
        at = np.arange(len(asked)) + (last - np.cumsum(last - first))[asked]
        points = np.where((i > j)[asked], self.games[at] - self.points[at], self.points[at])
        games, points = weight[asked] * self.games[at], weight[asked] * points
        return SeedScores(group[asked], self.kind[at], games, points, self.number, self.effect)


@dataclass(frozen=True, eq=False)
class Rankings:
    """Different rankings and their numbers, by number of players. They do not depend on the order of games.

    `clusters` are those of the rankings' games that share a seed, by numbers of rankings and of players. `seatings` are
    the tuples of players, in team order, that played.
    """

    blocks: tuple[Block, ...] = ()
    clusters: tuple[ClusterBlock, ...] = ()
    seatings: frozenset[tuple[int, ...]] = frozenset()

    def __bool__(self) -> bool:
        return bool(self.blocks)

    @classmethod
    def of(cls, lineups: Mapping[tuple[str, ...], LineupTotals], place: Mapping[str | None, int]) -> "Rankings":
        """Return the rankings of lineups; `place` has the index of each snapshot."""
        rows: dict[int, list[tuple[list[int], tuple[int, ...], int]]] = {}
        seatings: set[tuple[int, ...]] = set()
        shared: dict[tuple[int, int], list[tuple[list[list[int]], SeedCluster, int]]] = {}
        for snapshots, totals in lineups.items():
            players = [place[name] for name in snapshots]
            if len(set(players)) < 2:  # a snapshot against itself alone says nothing of strength
                continue
            seatings.add(tuple(players))
            for ranks, number in totals.rankings.items():
                if number:
                    rows.setdefault(len(players), []).append((players, ranks, number))
            for cluster, number in totals.seed_clusters.items():
                if number:
                    k = len(cluster)
                    shared.setdefault((k, len(players)), []).append(([players] * k, cluster, number))
        return cls._merged(
            [Block(*_sorted(*map(np.array, zip(*some, strict=True)))) for some in rows.values()],
            [ClusterBlock(*_sorted(*map(np.array, zip(*some, strict=True)))) for some in shared.values()],
            seatings,
        )

    @classmethod
    def of_events(cls, event: np.ndarray, player: np.ndarray, place: np.ndarray) -> "Rankings":
        """Return the rankings of events.

        Args:
            event: (M,) int, from 0 on without gaps.
            player: (M,) int index of the player in that row.
            place: (M,) float, smaller for better; equal places of an event are a tie.
        """
        order = np.lexsort((player, place, event))
        event, player, place = event[order], player[order], place[order]
        size = np.bincount(event)
        first = np.cumsum(size) - size
        position = np.arange(len(event)) - first[event]
        new = np.append(True, (place[1:] != place[:-1]) | (event[1:] != event[:-1]))[: len(event)]
        rank = position[np.maximum.accumulate(np.where(new, np.arange(len(event)), 0))] + 1
        blocks = []
        for n in np.unique(size).tolist():
            own = np.flatnonzero(size[event] == n)
            shape = (-1, n)
            blocks.append(Block(player[own].reshape(shape), rank[own].reshape(shape), np.ones(len(own) // n, int)))
        return cls._merged(blocks)

    def renumbered(self, now: np.ndarray) -> "Rankings":
        """Return the rankings with player i as player `now[i]`."""
        to = now.tolist()
        return Rankings._merged(
            [Block(*_sorted(now[each.players], each.ranks, each.number)) for each in self.blocks],
            [ClusterBlock(*_sorted(now[each.players], each.ranks, each.number)) for each in self.clusters],
            {tuple(to[i] for i in seating) for seating in self.seatings},
        )

    def plus(self, other: "Rankings") -> "Rankings":
        """Return these and other rankings of the same players."""
        if not (self and other):
            return self or other
        seatings = self.seatings | other.seatings
        return Rankings._merged([*self.blocks, *other.blocks], [*self.clusters, *other.clusters], seatings)

    def episodes(self, size: int) -> np.ndarray:
        """Return the number (P,) of games of each player."""
        found = np.zeros(size, int)
        for players, _, count in self.blocks:
            np.add.at(found, players, count[:, None])
        return found

    def tie_orders(self) -> np.ndarray:
        """Return the numbers of players that were tied with each other, ascending, as far as they occurred."""
        found = {int(m) for each in self.blocks for m in np.unique(tied(each.ranks))}
        return np.array(sorted(found - {1}), int)

    def pairs(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the pairs that met: first (E,), second (E,) with the larger index, and wins, draws, losses (E, 3)."""
        if not self.blocks:
            return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3), int)
        if size * size <= MAX_TABLE:
            table = np.zeros(3 * size * size)
            for key, many in self._outcomes(size):
                table += np.bincount(key, many, len(table))
            found = table.reshape(-1, 3).astype(np.int64)
            met = np.flatnonzero(found.any(1))
            return *np.divmod(met, max(size, 1)), found[met]
        keys, counts = [], []
        for key, many in self._outcomes(size):
            found, inverse = np.unique(key, return_inverse=True)
            keys.append(found)
            counts.append(np.bincount(inverse, many, len(found)).astype(np.int64))
        key, inverse = np.unique(np.concatenate(keys) // 3, return_inverse=True)
        found = np.zeros((len(key), 3), np.int64)
        np.add.at(found, (inverse, np.concatenate(keys) % 3), np.concatenate(counts))
        return *np.divmod(key, size), found

    def by_seed(self, size: int) -> PairsBySeed:
        """Return the games of all pairs of players by kinds of seed clusters, and by kinds of rankings outside them.

        Where no cluster says what shares a seed, the rotations of a lineup may all have: `effect` is their number.
        """
        clusters = [(*each, np.ones(len(each.number), int)) for each in self.clusters]
        outside = [(each.players[:, None], each.ranks[:, None], *each[2:], effect) for each, effect in self._outside()]
        found, first = [], 0
        for players, ranks, *_ in (kinds := clusters + outside):
            found += [np.stack([pair, kind + first, *rest]) for pair, kind, *rest in _games(players, ranks, size)]
            first += len(players)
        pair, kind, games, points = np.concatenate(found, 1) if found else np.zeros((4, 0))
        order = np.argsort(pair, kind="stable")
        number, effect = (np.concatenate([np.zeros(0, int), *(each[k] for each in kinds)]) for k in (2, 3))
        pair, kind = pair[order].astype(np.int64), kind[order].astype(np.int64)
        return PairsBySeed(size, pair, kind, games[order], points[order], number, effect)

    def _outside(self) -> Iterator[tuple[Block, np.ndarray]]:
        """Yield the rankings that belong to no seed cluster, and the numbers (R,) of rotations of their lineups."""
        inside = [each.rankings._replace(number=-np.repeat(each.number, each.ranks.shape[1])) for each in self.clusters]
        rotations = self._rotations()
        for players, ranks, number in _each_once([*self.blocks, *inside]):
            left = number > 0
            lineups = np.sort(players[left], 1).tolist()
            effect = np.array([rotations.get(tuple(lineup), 1) for lineup in lineups], int)
            yield Block(players[left], ranks[left], number[left]), effect

    def _rotations(self) -> dict[tuple[int, ...], int]:
        """Return how many rotations of the same order of players have played, by players in ascending order."""
        orders = Counter(min((*each[i:], *each[:i]) for i in range(len(each))) for each in self.seatings)
        found: dict[tuple[int, ...], int] = {}
        for order, number in orders.items():
            lineup = tuple(sorted(order))
            found[lineup] = max(found.get(lineup, 1), number)
        return found

    def _outcomes(self, size: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield pairs and their outcomes as numbers, 3 (first P + second) + 0, 1 or 2 for a win, draw or loss of the
        first, and how often each occurred.
        """
        for players, ranks, number in self.blocks:
            ahead, behind = np.triu_indices(players.shape[1], 1)
            for rows in chunks(len(players), len(ahead)):
                a, b = players[rows][:, ahead], players[rows][:, behind]
                drawn = ranks[rows][:, ahead] == ranks[rows][:, behind]
                outcome = np.where(drawn, 1, np.where(a < b, 0, 2))
                key = (np.minimum(a, b) * size + np.maximum(a, b)) * 3 + outcome
                many = np.broadcast_to(number[rows, None], a.shape)
                yield key[a != b], many[a != b]

    @classmethod
    def _merged(
        cls, blocks: Iterable[Block], clusters: Iterable[ClusterBlock] = (), seatings: Iterable[tuple[int, ...]] = ()
    ) -> "Rankings":
        """Return rankings with one block for each shape, in which each ranking and each cluster is there once."""
        return cls(
            tuple(Block(*each) for each in _each_once(blocks)),
            tuple(ClusterBlock(*each) for each in _each_once(map(_canonical, clusters))),
            frozenset(seatings),
        )


NO_RANKINGS = Rankings()


def tied(ranks: np.ndarray) -> np.ndarray:
    """Return the number (R, n) of players that share each player's rank, for ranks (R, n) that do not decrease."""
    position = np.arange(ranks.shape[1])
    first = np.where(ranks - 1 == position, position, ranks.shape[1])  # of each group of tied players
    following = np.minimum.accumulate(first[:, ::-1], 1)[:, ::-1]
    after = np.concatenate([following[:, 1:], np.full((len(ranks), 1), ranks.shape[1])], 1)
    return after - (ranks - 1)


def chunks(rows: int, width: int, most: int = 2_000_000) -> list[slice]:
    """Return slices of rows of that width, each with about `most` entries at most, so that memory stays bounded."""
    step = max(1, most // max(width, 1))
    return [slice(at, at + step) for at in range(0, rows, step)]


def pair_rows(
    rankings: Rankings, lineups: Mapping[tuple[str, ...], LineupTotals], place: Mapping[str | None, int]
) -> np.ndarray:
    """Return lineups as rows (rows, 17) of `payoff.sum_matches`: in each game every pair of teams counts as a game.

    All games count as played at home, since three and more teams have no two sides. Voids that a third team alone has
    caused are in a column of their own.
    """
    first, second, games = rankings.pairs(len(place))
    met = np.zeros((len(first), 17), np.int64)
    met[:, 0], met[:, 1], met[:, 2:5] = first, second, games
    voids = []
    for snapshots, totals in lineups.items():
        unclear = totals.voids - sum(totals.voids_by_team)
        for i, a in enumerate(snapshots):
            for j, b in enumerate(snapshots[:i]):
                ends = sorted(((place[a], totals.voids_by_team[i]), (place[b], totals.voids_by_team[j])))
                (one, own), (other, theirs) = ends
                if one != other:
                    caused = unclear + own + theirs
                    voids.append([one, other, *[0] * 11, caused, own, theirs, totals.voids - caused])
    return np.concatenate([met, np.array(voids, np.int64).reshape(-1, 17)])


def _games(
    players: np.ndarray, ranks: np.ndarray, size: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield pair, kind, games and points, each (M,) as in `PairsBySeed`, of kinds (C, k, n) of k rankings each."""
    ahead, behind = np.triu_indices(players.shape[2], 1)
    for rows in chunks(len(players), players.shape[1] * len(ahead)):
        a, b = players[rows][..., ahead], players[rows][..., behind]
        drawn = ranks[rows][..., ahead] == ranks[rows][..., behind]
        points = np.where(drawn, 0.5, a < b)  # of the player with the smaller index
        kind = np.broadcast_to(np.arange(len(players))[rows, None, None], a.shape)
        met = a != b
        pair = np.minimum(a, b)[met] * size + np.maximum(a, b)[met]
        key, place = np.unique(kind[met] * size**2 + pair, return_inverse=True)
        kind, pair = np.divmod(key, size**2)
        yield pair, kind, np.bincount(place), np.bincount(place, points[met])


def _sorted(players: np.ndarray, ranks: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rankings in canonical order, from best to worst along the last axis, and tied players by index."""
    order = np.lexsort((players, ranks))
    return np.take_along_axis(players, order, -1), np.take_along_axis(ranks, order, -1), count


def _canonical(block: ClusterBlock) -> ClusterBlock:
    """Return clusters with their rankings in ascending order: which seats the players had does not matter."""
    rows = np.concatenate([block.players, block.ranks], 2)
    order = np.lexsort(rows.transpose(2, 0, 1)[::-1])[:, :, None]
    players, ranks = (np.take_along_axis(each, order, 1) for each in block[:2])
    return ClusterBlock(players, ranks, block.number)


def _each_once(blocks: Iterable[Block | ClusterBlock]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield players, ranks and numbers of each shape that blocks have, with each entry once and ascending."""
    of_shape: dict[tuple[int, ...], list[Block | ClusterBlock]] = {}
    for block in blocks:
        of_shape.setdefault(block.players.shape[1:], []).append(block)
    for shape, some in sorted(of_shape.items()):
        rows = np.concatenate([np.concatenate([each.players, each.ranks], -1) for each in some])
        flat = rows.reshape(len(rows), -1)
        order = np.lexsort(flat.T[::-1])
        flat, number = flat[order], np.concatenate([each.number for each in some])[order]
        starts = np.flatnonzero(np.append(True, (flat[1:] != flat[:-1]).any(1)))
        kept = rows[order[starts]]
        yield kept[..., : shape[-1]], kept[..., shape[-1] :], np.add.reduceat(number, starts)


def lineups_of(matches: Iterable[RankedMatch]) -> dict[tuple[str, ...], LineupTotals]:
    """Return the sums of ranked matches of the same snapshots in the same teams."""
    found: dict[tuple[str, ...], LineupTotals] = {}
    for match in matches:
        found[match.snapshots] = LineupTotals.of(match).plus(found.get(match.snapshots))
    return found
