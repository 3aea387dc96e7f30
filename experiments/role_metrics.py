"""Numbers of roles in sumo: of one game from the positions of its robots, and their means over games with intervals.

Everything here is a pure function of arrays. A agents are in the arena's order; moments are `interval` seconds apart,
and a velocity is the displacement until the next moment divided by that, so that the sway of a walking robot counts
little. A gap is the distance between the surfaces of two robots' collision shapes.

| number | of an agent in one game |
|---|---|
| `near` | share of moments in which a part of an opponent is within `REACH` |
| `at legs` | share of moments in which the nearest such part is a leg |
| `legs of near` | the same as a share of the moments with a part within reach |
| `driving at legs` | share of the moments at legs in which it moves towards that robot faster than `DRIVE` |
| `towards KIND` | share of moments in which it moves towards the opponents of a kind faster than `DRIVE` |
| `closing on KIND` | mean speed of its own motion towards them, m/s |
| `centre` | mean distance from the centre of the ring, in units of the present radius |
| `outer fifth` | share of moments in which that distance is above `OUTER` |
| `mate` | mean distance from its team-mate, m |
| `still` | share of moments in which it is slower than `STILL` |
| `still alone` | share of moments in which it is and its team-mate is not |
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from matchmaking.ratings.scores import quantile, score_interval

REACH = 0.5  # m, about the length of a rover
DRIVE = 0.1  # m/s
STILL = 0.1  # m/s
OUTER = 0.8  # of the radius
TOUCH = 0.01  # m: contacts between two recorded control steps leave a gap of some millimetres
BODY, LIMB = 0, 1  # parts of a robot: what is fixed to its base, and what moves against it
TEAM_MATE, NOBODY = "team-mate", "nobody"
HOW = ("out", "fallen")


class Track(NamedTuple):
    """Positions in one game, S moments, A agents."""

    xy: np.ndarray  # (S, A, 2) m, of the bases
    radius: np.ndarray  # (S,) m, of the ring
    gaps: np.ndarray  # (S, A, A, 2) m, from agent i to BODY and LIMB of agent j; inf where there is none or it is far
    interval: float  # s between two moments
    team: np.ndarray  # (A,)
    kind: Sequence[str]  # of each agent


class End(NamedTuple):
    """A robot that lost the game for its team."""

    loser: int
    how: str  # of HOW
    by: int | None  # the agent that touched it last, see `ends`
    contact: float  # share of the last second in which that agent touched it
    inside: bool  # that agent was nearer to the centre than the loser at its last touch: it can have pushed outwards


class Game(NamedTuple):
    """One game, measured."""

    numbers: Mapping[str, np.ndarray]  # name -> (A,), nan where it has no meaning
    ends: Sequence[End]
    team: np.ndarray  # (A,)
    kind: Sequence[str]
    side: int  # the team of policy A
    start: int  # games with the same number began alike, with sides swapped


def ends(out: np.ndarray, fallen: np.ndarray, gaps: np.ndarray, xy: np.ndarray, team: np.ndarray) -> list[End]:
    """Return who lost, and by whom: the opponent that touched the loser last in the time before, within `TOUCH`.

    Of two that touched it in the same control step it is the one with the smaller gap. If no opponent did, it is a
    team-mate that did, and else nobody. This tells of contact, and not of who sought it; `End.inside` tells more.

    Args:
        out: (A,) bool: outside the ring when the game was decided.
        fallen: (A,) bool: fallen then. A robot that is both has gone out.
        gaps: (W, A, A) m, between any parts of two agents in the last second, the deciding control step last.
        xy: (W, A, 2) m, places in the same control steps; the ring's centre is the origin.
        team: (A,) the team of each agent.
    """
    found = []
    for loser in np.flatnonzero(out | fallen).tolist():
        touches, by, inside = gaps[:, loser] <= TOUCH, None, False  # (W, A)
        others = np.arange(len(team)) != loser
        for group in (team != team[loser], others & (team == team[loser])):
            if (when := np.flatnonzero(touches[:, group].any(axis=1))).size:
                by = int(np.where(group, gaps[when[-1], loser], np.inf).argmin())
                inside = bool(np.linalg.norm(xy[when[-1], by]) < np.linalg.norm(xy[when[-1], loser]))
                break
        contact = 0.0 if by is None else float(touches[:, by].mean())
        found.append(End(loser, HOW[0] if out[loser] else HOW[1], by, contact, inside))
    return found


def closing(xy: np.ndarray, interval: float) -> np.ndarray:
    """Return the speed in m/s of each agent's own motion towards each other one, (S - 1, A, A), from xy (S, A, 2)."""
    velocity = np.diff(xy, axis=0) / interval
    way = (xy[:, None] - xy[:, :, None])[:-1]  # (S - 1, from, to, 2)
    length = np.linalg.norm(way, axis=-1)
    along = (velocity[:, :, None] * way).sum(axis=-1)
    return np.divide(along, length, out=np.zeros_like(along), where=length > 0)


def numbers(track: Track) -> dict[str, np.ndarray]:
    """Return the numbers of one game, name -> (A,); nan where there is nothing to count. See the module's table."""
    enemy = track.team[:, None] != track.team
    mate = ~enemy & ~np.eye(len(track.team), dtype=bool)
    moments = len(track.xy)
    speeds = np.linalg.norm(np.diff(track.xy, axis=0), axis=-1) / track.interval  # (S - 1, A)
    towards = closing(track.xy, track.interval)

    gaps = np.where(enemy[..., None], track.gaps, np.inf).reshape(moments, len(enemy), -1)
    near, nearest = gaps.min(axis=-1) <= REACH, gaps.argmin(axis=-1)
    at_legs = near & (nearest % 2 == LIMB)
    to_nearest = np.take_along_axis(towards, nearest[:-1, :, None] // 2, axis=2)[..., 0]

    centre = np.linalg.norm(track.xy, axis=-1) / track.radius[:, None]
    still = speeds < STILL
    others_move = np.stack([~still[:, mates].any(axis=1) for mates in mate], axis=1)
    distance = np.linalg.norm(track.xy[:, :, None] - track.xy[:, None], axis=-1)
    found = {
        "near": _share(near), "at legs": _share(at_legs), "legs of near": _share(at_legs, near),
        "driving at legs": _share(to_nearest > DRIVE, at_legs[:-1]),
        "centre": _mean(centre), "outer fifth": _share(centre > OUTER),
        "mate": _mean_over(distance, mate), "still": _share(still), "still alone": _share(still & others_move),
    }  # fmt: skip
    for kind in dict.fromkeys(track.kind):
        those = enemy & (np.array(track.kind) == kind)
        found[f"towards {kind}"] = _mean_over(towards > DRIVE, those)
        found[f"closing on {kind}"] = _mean_over(towards, those)
    return found


def _share(happens: np.ndarray, of: np.ndarray | None = None) -> np.ndarray:
    """Return the share (A,) of moments in which something `happens` (S, A), of those in `of` (S, A)."""
    return _mean(happens, np.ones_like(happens, bool) if of is None else of)


def _mean(values: np.ndarray, where: np.ndarray | None = None) -> np.ndarray:
    """Return the mean (A,) of values (S, A) over the moments `where` (S, A); nan without any."""
    where = np.ones(values.shape, bool) if where is None else where
    count = where.sum(axis=0)
    return np.divide((values * where).sum(axis=0), count, out=np.full(count.shape, np.nan), where=count > 0)


def _mean_over(values: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the mean (A,) of values (S, A, A) over moments and those other agents in `pairs` (A, A)."""
    whole = np.broadcast_to(pairs, values.shape)
    return _mean(values.swapaxes(1, 2).reshape(-1, len(pairs)), whole.swapaxes(1, 2).reshape(-1, len(pairs)))


# Over games ----------------------------------------------------------------------------------------------------------


def mean_of_games(values: np.ndarray, starts: np.ndarray) -> dict[str, float | int | None]:
    """Return the mean of values (G,) of games with its 95 % interval; games without a value (nan) do not count.

    Each game counts once, however long it is. Games with the same start count as one cluster in the variance of the
    mean, n being the number of games (the usual sandwich estimate for clusters). Without two clusters there is no
    interval.
    """
    known = np.isfinite(values)
    values, starts = values[known], starts[known]
    if not len(values):
        return {"mean": None, "low": None, "high": None, "n": 0}
    mean, (_, cluster) = values.mean(), np.unique(starts, return_inverse=True)
    sums = np.bincount(cluster, values - mean)
    if (number := len(sums)) < 2:
        return {"mean": round(float(mean), 4), "low": None, "high": None, "n": len(values)}
    half = quantile(0.95) * np.sqrt(number / (number - 1) * (sums**2).sum()) / len(values)
    low, high = (round(float(end), 4) for end in (mean - half, mean + half))
    return {"mean": round(float(mean), 4), "low": low, "high": high, "n": len(values)}


def share_of_games(happened: np.ndarray, starts: np.ndarray) -> dict[str, float | int]:
    """Return in how many games something `happened` (G,) bool, and the share with its 95 % interval.

    The interval is that of scores (`matchmaking.ratings.scores`), with the two games of a start as a seed pair.
    """
    _, cluster, size = np.unique(starts, return_inverse=True, return_counts=True)
    both = np.bincount(cluster, happened)[size == 2]  # 0, 1 or 2 of the two games
    pairs = [(both == 0).sum(), 0, (both == 1).sum(), 0, (both == 2).sum()]
    count = int(happened.sum())
    low, high = score_interval(count, 0, len(happened) - count, pairs)
    share = count / len(happened) if len(happened) else 0.0
    return {"games": count, "share": round(share, 4), "low": round(float(low), 4), "high": round(float(high), 4)}


def table_of_ends(games: Sequence[Game], of_a: bool) -> dict[str, dict[str, dict[str, float | int]]]:
    """Return for each way in which robots of policy A (or of B) lost games, such as "anymal out", and for each that
    ended them - an opponent's kind, a team-mate, nobody - the share of all games.

    Of these games `inside` counts those in which that robot stood nearer to the centre, see `End`.
    """
    kinds = list(dict.fromkeys(kind for game in games for kind in game.kind))
    starts = np.array([game.start for game in games])
    happened = {
        (f"{kind} {how}", by): np.zeros((2, len(games)), bool)  # at all, and from inside
        for kind in kinds
        for how in HOW
        for by in (*kinds, TEAM_MATE, NOBODY)
    }
    for number, game in enumerate(games):
        for end in game.ends:
            if (game.team[end.loser] == game.side) == of_a:
                happened[f"{game.kind[end.loser]} {end.how}", ended_by(game, end)][:, number] |= [True, end.inside]
    table: dict[str, dict[str, dict[str, float | int]]] = {}
    for (lost, by), cell in happened.items():
        table.setdefault(lost, {})[by] = {**share_of_games(cell[0], starts), "inside": int(cell[1].sum())}
    return table


def ended_by(game: Game, end: End) -> str:
    """Return the kind of the opponent that ended a robot's game, else `TEAM_MATE` or `NOBODY`."""
    if end.by is None:
        return NOBODY
    return TEAM_MATE if game.team[end.by] == game.team[end.loser] else game.kind[end.by]


def numbers_of_side(games: Sequence[Game], of_a: bool) -> dict[str, dict[str, dict]]:
    """Return the mean of each number over games with its interval, for each kind of robot of policy A (or of B)."""
    starts = np.array([game.start for game in games])
    found: dict[str, dict[str, dict]] = {}
    for kind in dict.fromkeys(kind for game in games for kind in game.kind):
        own = [(np.array(g.kind) == kind) & ((g.team == g.side) == of_a) for g in games]
        found[kind] = {
            name: mean_of_games(np.array([g.numbers[name][k].mean() for g, k in zip(games, own, strict=True)]), starts)
            for name in games[0].numbers
        }
    return found
