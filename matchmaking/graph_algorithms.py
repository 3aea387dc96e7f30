"""Graphs of N numbered nodes and E edges as arrays: components, and systems of difference constraints. NumPy alone.

A system of difference constraints asks for numbers x with x[target] - x[source] <= weight on every edge. It has a
solution exactly if no cycle of the graph has a negative sum of weights (Bellman 1958, Ford 1956).
"""

from typing import NamedTuple

import numpy as np


class Cycle(NamedTuple):
    """Proof that a system of difference constraints has no solution."""

    edges: np.ndarray  # (C,) int: edges of a cycle whose weights have a negative sum


def connected(size: int, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return for each node (N,) the smallest node of its connected component, ignoring directions of edges."""
    label = np.arange(size)
    while True:
        lower = label.copy()
        np.minimum.at(lower, source, label[target])
        np.minimum.at(lower, target, label[source])
        np.minimum.at(lower, label, lower.copy())  # a component that met a lower one moves as a whole
        lower = lower[lower]
        if (lower == label).all():
            return label
        label = lower


def strong_components(size: int, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the number (N,) of each node's strongly connected component: nodes that reach each other along edges.

    The component of the busiest node is found first, by reach forwards and backwards, because most match logs are one
    component and a few other nodes. Tarjan's algorithm (1972) finds the rest.
    """
    if not size:
        return np.zeros(0, int)
    busiest = int(np.bincount(np.concatenate([source, target]), minlength=size).argmax())
    core = reachable_from(size, source, target, busiest) & reachable_from(size, target, source, busiest)
    place = np.where(core, busiest, np.arange(size))
    ends = np.unique(place[source] * size + place[target])
    ends = ends[ends // size != ends % size]
    return _tarjan(size, ends // size, ends % size)[place]


def reachable_from(size: int, source: np.ndarray, target: np.ndarray, start: int) -> np.ndarray:
    """Return a mask (N,) bool of the nodes that are reached from `start` along edges, including itself."""
    order = np.argsort(source, kind="stable")
    target, bounds = target[order], np.searchsorted(source[order], np.arange(size + 1))
    reached, frontier = np.zeros(size, bool), np.array([start])
    reached[start] = True
    while len(frontier):
        lengths = bounds[frontier + 1] - bounds[frontier]
        first = np.repeat(bounds[frontier] - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
        found = np.unique(target[first + np.arange(len(first))])
        frontier = found[~reached[found]]
        reached[frontier] = True
    return reached


def _tarjan(size: int, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return strongly connected components (N,) of a graph with few edges, without recursion."""
    neighbours: list[list[int]] = [[] for _ in range(size)]
    for i, j in zip(source.tolist(), target.tolist(), strict=True):
        neighbours[i].append(j)
    order, low, label = [-1] * size, [0] * size, [-1] * size
    stack: list[int] = []
    count = components = 0
    for root in range(size):
        work = [(root, 0)] if order[root] < 0 else []
        while work:
            node, at = work.pop()
            if at == 0:
                order[node] = low[node] = count
                count += 1
                stack.append(node)
            else:
                low[node] = min(low[node], low[neighbours[node][at - 1]])
            while at < len(neighbours[node]):
                other = neighbours[node][at]
                at += 1
                if order[other] < 0:
                    work += [(node, at), (other, 0)]
                    break
                if label[other] < 0:
                    low[node] = min(low[node], order[other])
            else:
                if low[node] == order[node]:
                    while label[node] < 0:
                        label[stack.pop()] = components
                    components += 1
    return np.array(label)


def solve(size: int, source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray | Cycle:
    """Return an integer solution (N,) of a system of difference constraints, or a cycle that proves there is none.

    Bellman and Ford's algorithm, all edges at once. Integers are exact.

    Args:
        size: N.
        source: (E,) int.
        target: (E,) int.
        weight: (E,) int: x[target] - x[source] is at most this.
    """
    return _relax(size, source, target, weight, np.zeros(size, np.int64))


def largest_differences(
    size: int, source: np.ndarray, target: np.ndarray, weight: np.ndarray, solution: np.ndarray, start: int
) -> np.ndarray:
    """Return the largest x[i] - x[start] (N,) among all solutions of a system; HUGE where there is no bound.

    `solution` is any solution: with it all reduced weights are 0 or more.
    """
    reduced = weight + solution[source] - solution[target]
    far = np.full(size, HUGE, np.int64)
    far[start] = 0
    found = _relax(size, source, target, reduced, far)
    assert isinstance(found, np.ndarray)
    return np.where(found >= HUGE // 2, HUGE, found + solution - solution[start])


HUGE = 2**60


def _relax(size: int, source: np.ndarray, target: np.ndarray, weight: np.ndarray, x: np.ndarray) -> np.ndarray | Cycle:
    """Lower x until every constraint holds, or until the edges that lowered it last form a cycle."""
    if not len(source):
        return x
    order = np.argsort(target, kind="stable")
    source, weight = source[order], weight[order].astype(np.int64)
    ends, starts, lengths = np.unique(target[order], return_index=True, return_counts=True)
    numbers, parent, check = np.arange(len(source)), np.full(size, -1), 1
    for round_ in range(1, size + 2):
        reached = x[source] + weight
        least = np.minimum.reduceat(reached, starts)
        lower = least < x[ends]
        if not lower.any():
            return x
        edge = np.maximum.reduceat(np.where(reached == np.repeat(least, lengths), numbers, -1), starts)
        x = x.copy()
        x[ends[lower]], parent[ends[lower]] = least[lower], edge[lower]
        if round_ >= check:
            check = round_ + min(round_, 50)
            if (cycle := _cycle(parent, source)) is not None:
                return Cycle(order[cycle])
    cycle = _cycle(parent, source)
    assert cycle is not None  # after more rounds than nodes a cycle lowers itself without end
    return Cycle(order[cycle])


def _cycle(parent: np.ndarray, source: np.ndarray) -> np.ndarray | None:
    """Return the edges of a cycle among those that lowered each node last; None if there is none."""
    size = len(parent)
    before = np.append(np.where(parent < 0, size, source[parent]), size)
    ahead = before
    for _ in range(size.bit_length()):
        ahead = ahead[ahead]
    endless = np.flatnonzero(ahead < size)
    if not len(endless):
        return None
    node = int(ahead[endless[0]])
    edges, at = [int(parent[node])], int(before[node])
    while at != node:
        edges.append(int(parent[at]))
        at = int(before[at])
    return np.array(edges)
