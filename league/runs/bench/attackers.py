"""Exploitability of an entry's policies, bounded from below by attackers that start from nothing (`league exploit`)."""

import math
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

    Each seed is an attacker of its own, against each policy. Attacks that `partial` has are not made again, and it gets
    the others. Raises ManagerError if an attacker cannot learn, KeyboardInterrupt where Ctrl-C stopped one.
    """
    rows = []
    for name, seed, times in product(policies, seeds, TIMES):
        about = {"policy": name, "times": times, "asked": times * steps, "attacker_seed": seed}
        if (row := partial.find(**about)) is None:
            tell(f"attacker of {name}, seed {seed}, at least {times * steps:,} steps")
            chosen = attack(league.opened, name, Budget(None, times * steps, "0s"), "scratch", seed)
            attacker = train_attacker(league.opened, str(league.folder), chosen)
            if attacker is None:
                raise KeyboardInterrupt  # its manager took the signal, and ended its workers
            match = measure(bring_in(league.opened, attacker), games)
            row = partial.add({**row_of(match), **about, "attacker_steps": attacker.step})
        rows.append(row)
    return rows


def exploitability(task: Task, rows: Sequence[Row]) -> list[dict[str, Any]] | None:
    """Return, for each policy and length, the attackers' highest score; None without attacks.

    `over` is that score less one half, a lower bound of the exploitability, where sides are alike; where they are
    unlike, the game's value is not known, and it is null. A game that the policy alone made void is lost by it.
    """
    found: dict[tuple[str, int], dict[str, Any]] = {}
    for row in rows:
        wins, draws, losses = row["results"]
        wins += row["voids_by_b"]
        games = wins + draws + losses
        low, high = map(float, score_interval(wins, draws, losses, row["seed_pairs"]))
        score = (wins + draws / 2) / games if games else math.nan
        best = found.get((row["policy"], row["times"]))
        if games and (best is None or score > best["score"]):
            ends = {"score": round(score, DIGITS), "low": round(low, DIGITS), "high": round(high, DIGITS)}
            over = round(score - 0.5, DIGITS) if task.alike else None
            about = {key: row[key] for key in ("policy", "times", "attacker_steps", "attacker_seed")}
            found[row["policy"], row["times"]] = {**about, "games": games, **ends, "over": over}
    return list(found.values()) or None
