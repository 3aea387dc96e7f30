"""Tie terms of Plackett and Luce's model without a finite maximum-likelihood value, given the rankings alone.

As in `matchmaking.ratings.separation` there is no maximum where a direction exists in which no observed choice becomes
less likely and one becomes more likely. A direction changes strengths by u and log δ_k by λ_k, with λ_1 = 0. Choosing
T from A requires

    mean of u over T + λ_|T|  >=  mean of u over S + λ_|S|    for all groups S of A of the sizes that occur.

With λ = 0 these are Ford's conditions on pairs, which `separation` decides exactly. No λ_k can be negative: a tie of k
must not become less likely than its best member alone. Whoever was once ahead of another has u at least as large, also
where λ changes. So where a single best was chosen from among k players that were ahead of each other along chains, λ_k
is 0. Where this does not decide, a linear programme does, to which the violated conditions are added until there are
none. It is solved in floating-point numbers.
"""

import itertools

import numpy as np

from matchmaking import graph_algorithms
from matchmaking.ratings.rankings import Rankings, chunks, tied

ZERO = 1e-7
"""Largest change, of 1 possible, that counts as none."""
ROUNDS = 60
AIMS, FEWEST, PART = 10, 3, 0.01
"""Number of random aims, each with its opposite, along which directions are looked for; the least of many players; and
the part of an aim that stays for players whom earlier aims have parted."""


def tie_directions(
    rankings: Rankings, size: int, first: np.ndarray, second: np.ndarray, games: np.ndarray
) -> np.ndarray | None:
    """Return changes (D, P) of strengths along which some tie term has no bound; None if all have one.

    They are found along random aims: two strengths that change alike in all of them nearly always do so in every
    direction that the games leave open (in 598 of 600 random logs of two sides, verdicts are those of match logs).
    `first`, `second` and `games` are the rankings' pairs (`Rankings.pairs`).
    """
    orders = rankings.tie_orders().tolist()
    ahead, behind = games[:, 0] > 0, games[:, 2] > 0
    source, target = np.append(first[ahead], second[behind]), np.append(second[ahead], first[behind])
    chains = graph_algorithms.strong_components(size, source, target)
    if set(orders) <= _bounded(rankings, chains, orders):
        return None
    return _Programme(rankings, size, [1, *orders], source, target).directions(
        graph_algorithms.connected(size, first, second)
    )


def _bounded(rankings: Rankings, chains: np.ndarray, orders: list[int]) -> set[int]:
    """Return the orders k for which a single best was chosen among k players of equal u."""
    most = 0
    for players, ranks, _ in rankings.blocks:
        n, single = ranks.shape[1], tied(ranks) == 1
        for rows in chunks(len(players), n * n):
            own = chains[players[rows]]
            equals = ((own[:, :, None] == own[:, None, :]) & np.triu(np.ones((n, n), bool))).sum(2)
            most = max(most, int(np.where(single[rows], equals, 0).max(initial=0)))
    return {k for k in orders if k <= most}


class _Programme:
    """Linear programme over u (P) and λ (K), all at most 1 in size."""

    def __init__(self, rankings: Rankings, size: int, orders: list[int], source: np.ndarray, target: np.ndarray):
        self._rankings, self._size, self._orders = rankings, size, orders
        rows = np.arange(len(source))
        one = np.ones(len(source))
        self._entries = [(np.append(rows, rows), np.append(source, target), np.append(-one, one))]
        self._count = len(source)
        self._least: dict[int, float] = {}  # bounds of rows other than 0

    def directions(self, island: np.ndarray) -> np.ndarray | None:
        """Return changes u (D, P) with a positive sum of λ; None if there are none.

        The first has the largest sum. The others have half of it, and u as far as possible along random aims; further
        aims tear at players that changed alike, until none of them parts. No aim moves all players of an island (P,)
        together. Raises ArithmeticError where the programme cannot be solved.
        """
        P, K = self._size, len(self._orders) - 1
        first = self._solved(np.append(np.zeros(P), np.ones(K)))
        if (gain := first[P:].sum()) < ZERO:
            return None
        self._entries.append((np.full(K, self._count), np.arange(P, P + K), np.full(K, -1.0)))
        self._least = {self._count: -gain / 2}
        self._count += 1
        rng, found, groups = np.random.default_rng(0), [first[:P]], 0
        aims = min(AIMS, max(FEWEST, 300 // P))
        for number in itertools.count():
            alike = np.unique(np.round(found, 5), axis=1, return_inverse=True)[1].reshape(-1)
            if number > aims and groups == alike.max():
                break
            groups, aim = int(alike.max()), _within(rng.normal(size=P), island)
            if number >= aims:  # a part stays for all: where the aim is 0, opposite aims may end at unlike corners
                aim = _within(aim, alike) + PART * aim
            found += [self._solved(np.append(each, np.zeros(K)))[:P] for each in (aim, -aim)]
        return np.array(found)

    def _solved(self, aim: np.ndarray) -> np.ndarray:
        """Return u and λ (P + K) that are farthest along `aim`; conditions that are violated on the way are added."""
        from scipy import sparse  # takes a tenth of a second
        from scipy.optimize import linprog

        P, K = self._size, len(self._orders) - 1
        for _ in range(ROUNDS):
            most = np.zeros(self._count)
            most[list(self._least)] = list(self._least.values())
            row, column, value = (np.concatenate(part) for part in zip(*self._entries, strict=True))
            below = sparse.csr_array((value, (row, column)), (self._count, P + K)) if self._count else None
            bounds = [(-1.0, 1.0)] * P + [(0.0, 1.0)] * K
            found = linprog(-aim, below, most if self._count else None, bounds=bounds)
            if found.x is None:
                raise ArithmeticError(f"the linear programme of the tie terms was not solved: {found.message}")
            if not self._add_violated(found.x):
                return found.x
        raise ArithmeticError(f"the linear programme of the tie terms was not solved in {ROUNDS} rounds")

    def _add_violated(self, x: np.ndarray) -> bool:
        """Add the condition of every choice and size that x violates; return whether there was one."""
        before, log = self._count, np.append(0.0, x[self._size :])
        for players, ranks, _ in self._rankings.blocks:
            u, groups = x[players], tied(ranks)
            for i in range(ranks.shape[1] - 1):
                for m in np.unique(groups[ranks[:, i] - 1 == i, i]).tolist():
                    at = np.flatnonzero((ranks[:, i] - 1 == i) & (groups[:, i] == m))
                    own = u[at, i : i + m].mean(1) + log[self._orders.index(m)]
                    order = np.argsort(-u[at, i:], 1, kind="stable")
                    best = np.cumsum(np.take_along_axis(u[at, i:], order, 1), 1)
                    for place, k in enumerate(self._orders):
                        if k > best.shape[1]:
                            continue
                        worse = np.flatnonzero(best[:, k - 1] / k + log[place] > own + ZERO / 10)
                        chosen, group = players[at[worse], i : i + m], order[worse][:, :k]
                        others = np.take_along_axis(players[at[worse], i:], group, 1)
                        self._add(chosen, self._orders.index(m), others, place)
        return self._count > before

    def _add(self, chosen: np.ndarray, m: int, others: np.ndarray, k: int) -> None:
        """Add rows: the group `others` (rows, k) is no better than the one `chosen`; m and k are places of orders."""
        parts = [(others, 1 / max(others.shape[1], 1)), (chosen, -1 / max(chosen.shape[1], 1))]
        parts += [
            (np.full((len(chosen), 1), self._size + place - 1), sign) for place, sign in ((k, 1.0), (m, -1.0)) if place
        ]
        for columns, value in parts:
            row = np.repeat(np.arange(self._count, self._count + len(columns)), columns.shape[1])
            self._entries.append((row, columns.ravel(), np.full(columns.size, value)))
        self._count += len(chosen)


def _within(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return values (P,) less the mean of those of the same group (P,)."""
    among = np.unique(group, return_inverse=True)[1]
    return values - (np.bincount(among, values) / np.bincount(among))[among]
