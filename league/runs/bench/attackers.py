"""Exploitability of an entry's policies, bounded from below by attackers that start from nothing (`league exploit`)."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

from league.config.sections import Budget
from league.matches.exploitability import attack, bring_in, measure
from league.runs.attack_run import train_attacker
from league.runs.bench.games import BenchLeague, row_of
from league.runs.bench.metrics import DIGITS
from league.runs.bench.partial_rows import PartialRows, Row
from league.runs.bench.tasks import Task
from matchmaking.ratings.scores import score_interval

TIMES = (1, 3)
"""Lengths of the attack, in the steps that are asked for; the longer one goes on with the same attacker."""


def attacks(
    league: BenchLeague, policies: Sequence[str], steps: int, seeds: Sequence[int], games: int,
    partial: PartialRows, tell: Callable[[str], None] = lambda line: None,
) -> list[Row]:  # fmt: skip
    """Train attackers of the league's policies; return the rows of their games, the attacker as A.

    Each seed is an attacker of its own, against each policy. One of several plays twice: the first games choose the
    best, whose score in them is too high by the choice, and those played `again` are its score. Attacks that `partial`
    has are not made again, and it gets the others. Raises ManagerError if an attacker cannot learn, KeyboardInterrupt
    where Ctrl-C stopped one.
    """
    rows: list[Row] = []
    plays = (False, True) if len(seeds) > 1 else (False,)
    for name, seed, times in product(policies, seeds, TIMES):
        about = {"policy": name, "times": times, "asked": times * steps, "attacker_seed": seed}
        found = [partial.find(**about, again=again) for again in plays]
        if None in found:
            tell(f"attacker of {name}, seed {seed}, at least {times * steps:,} steps")
            chosen = attack(league.opened, name, Budget(None, times * steps, "0s"), "scratch", seed)
            attacker = train_attacker(league.opened, str(league.folder), chosen)
            if attacker is None:
                raise KeyboardInterrupt  # its manager took the signal, and ended its workers
            pair, about["attacker_steps"] = bring_in(league.opened, attacker), attacker.step
            found = [
                row or partial.add({**row_of(measure(pair, games, again)), **about, "again": again})
                for again, row in zip(plays, found, strict=True)
            ]
        rows += [row for row in found if row is not None]
    return rows


def exploitability(task: Task, rows: Sequence[Row]) -> list[dict[str, Any]] | None:
    """Return, for each policy and length, the score of the best attacker; None without attacks.

    The score is that of the games that it played again, where there are some: of one attacker there are none, nor are
    there of several in entries of earlier versions, whose highest score counts.

    `over` is that score less one half, a lower bound of the exploitability, where sides are alike; where they are
    unlike, the game's value is not known, and it is null. A game that the policy alone made void is lost by it.
    """
    best: dict[tuple[str, int], Row] = {}
    fresh = {_attacker(row): row for row in rows if row.get("again")}
    for row in rows:
        key = row["policy"], row["times"]
        if not row.get("again") and _games(row) and (key not in best or _score(row) > _score(best[key])):
            best[key] = row
    counted = [fresh.get(_attacker(row), row) for row in best.values()]
    return [_figure(task, row) for row in counted if _games(row)] or None


def _figure(task: Task, row: Row) -> dict[str, Any]:
    score = _score(row)
    low, high = map(float, score_interval(*_counts(row), row["seed_pairs"]))
    ends = {"score": round(score, DIGITS), "low": round(low, DIGITS), "high": round(high, DIGITS)}
    over = round(score - 0.5, DIGITS) if task.alike else None
    about = {key: row[key] for key in ("policy", "times", "attacker_steps", "attacker_seed")}
    return {**about, "games": _games(row), **ends, "over": over}


def _attacker(row: Row) -> tuple[str, int, int]:
    return row["policy"], row["times"], row["attacker_seed"]


def _counts(row: Row) -> tuple[int, int, int]:
    """Return wins, draws and losses of the attacker: a game that its victim alone made void is won."""
    wins, draws, losses = row["results"]
    return wins + row["voids_by_b"], draws, losses


def _games(row: Row) -> int:
    return sum(_counts(row))


def _score(row: Row) -> float:
    wins, draws, _ = _counts(row)
    return (wins + draws / 2) / _games(row)
