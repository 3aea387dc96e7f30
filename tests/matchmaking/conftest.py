from collections.abc import Callable

import numpy as np
import pytest

from matchmaking.ratings.davidson import davidson
from storage.records import ArenaKey, Match, PairCounts

SUMO = ArenaKey("sumo", "c0ffee", "c")


def make_match(
    a: str, b: str | None, home=(0, 0, 0), away=(0, 0, 0), pairs=(0, 0, 0, 0, 0), voids=0, blame=(0, 0), arena=SUMO
) -> Match:
    """Counts are A's: `home` while A played team 0, `away` while B did. `blame`: voids_a and voids_b."""
    totals = tuple(h + w for h, w in zip(home, away, strict=True))
    return Match(
        "test", arena, a, b, *totals, voids, *home, PairCounts(*pairs), seed=0, voids_a=blame[0], voids_b=blame[1]
    )


def play(a: str, b: str, gap: float, n: int, rng: np.random.Generator, nu=0.6, side=0.3, copied=0.0) -> Match:
    """Simulate n seed pairs at log odds `gap` for A; a share `copied` of second games shares its fate."""
    u, v = rng.random((2, n))
    v = np.where(rng.random(n) < copied, u, v)
    # One uniform number decides a game: loss, draw or win as it grows, so u = v gives the pair a common fate.
    first, second = (
        np.digitize(x, np.cumsum(np.exp(davidson(np.array(gap + s), np.log(nu)).log_likelihood)[::-1])[:2])
        for x, s in ((u, side), (v, -side))
    )
    home, away = (np.bincount(x, minlength=3)[::-1].tolist() for x in (first, second))
    return make_match(a, b, home, away, np.bincount(first + second, minlength=5).tolist())


@pytest.fixture
def match() -> Callable[..., Match]:
    return make_match


@pytest.fixture
def simulate() -> Callable[..., Match]:
    return play
