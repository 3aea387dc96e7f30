"""Metrics from the rows of an entry's games: pure functions of rows and references, so that anybody can repeat them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from league.runs.bench.games import match_of
from league.runs.bench.partial_rows import Row
from league.runs.bench.references import ReferenceSet
from league.runs.bench.tasks import Task
from matchmaking.metagame.alpharank import relative_population_performance
from matchmaking.ratings.fit import Ratings, fit
from matchmaking.ratings.likelihoods import priors
from matchmaking.ratings.payoff import Payoff, sum_matches
from matchmaking.ratings.scores import Score
from storage.errors import StorageError

PRIOR = 4.0
"""Virtual draws of every player with one of average strength, as in `league rate`."""
OWN_VOIDS = 0.01
"""Share of games that a policy may break by itself; above it an entry has no rank."""
DIGITS = 6
MIDDLE = "middle"


def team_of(task: Task, name: str) -> str | None:
    """Return the side of an entry's policy by its name, None where sides are alike."""
    return None if task.alike else name.partition(":")[2]


def rated(task: Task, rows: Sequence[Row], references: ReferenceSet) -> Ratings:
    """Return the fit of these rows and of the references' own games; the mean of a side's references is 1000 Elo."""
    payoff = _payoff(task, [*references.rows, *rows])
    known = [name for name in references.names if name in payoff.positions]
    sides = {each.name: each.team or "" for each in references.references}
    populations = {} if task.alike else {name: sides.get(name) or str(team_of(task, name)) for name in payoff.names}
    return fit(payoff, prior=priors.average(PRIOR), anchors=known, populations=populations)


def metrics(
    task: Task, policies: Sequence[str], rows: Sequence[Row], references: ReferenceSet
) -> dict[str, Any]:  # fmt: skip
    """Return the metrics that follow from rows, as JSON has them.

    Each policy has its rating from a fit of its own, so that it does not depend on the policies beside it.
    """
    own = {name: [row for row in rows if row["a"] == name and row["b"] in references.names] for name in policies}
    played = {frozenset((row["a"], row["b"])) for row in references.rows}  # some perhaps since the entry
    between = [row for row in rows if row["a"] in references.names and frozenset((row["a"], row["b"])) not in played]
    found = [_of_policy(task, name, own[name], between, references) for name in policies]
    return {
        "policies": found,
        "relative_population_performance": _relative(task, policies, own, references),
        "cross_play": _cross_play(task, policies, rows),
    }


def _of_policy(
    task: Task, name: str, rows: Sequence[Row], between: Sequence[Row], references: ReferenceSet
) -> dict[str, Any]:
    """Return a policy's metrics from its own rows and those of references that met beside it."""
    payoff = _payoff(task, rows)
    met = [row["b"] for row in rows]
    scores = {each: payoff.score(name, each) for each in dict.fromkeys(met)}
    worst = min(scores, key=lambda each: scores[each].score if scores[each].games else math.inf)
    games = sum(sum(row["results"]) + row["voids"] for row in rows)
    own = sum(row["voids_by_a"] for row in rows) / games
    ratings = rated(task, [*between, *rows], references)
    at = ratings.index(name)
    rating = {"elo": ratings.elo[at], "low": ratings.low[at], "high": ratings.high[at]}
    return {
        "name": name, "rating": {key: round(float(value), 2) for key, value in rating.items()},
        "score": _score(payoff.score(name, *scores)), "worst": {"against": worst, **_score(scores[worst])},
        "scores": [{"against": each, **_score(score)} for each, score in scores.items()],
        "voids": round(sum(row["voids"] for row in rows) / games, DIGITS), "own_voids": round(own, DIGITS),
        "ranked": own <= OWN_VOIDS,
    }  # fmt: skip


def seconds_to_75(
    task: Task, curve: Sequence[Mapping[str, Any]], rows: Sequence[Row], references: ReferenceSet
) -> float | None:
    """Return the training time after which a policy first scores 75 % against the references of the middle stage.

    `curve` has the `name` of each policy in the rows, and its `seconds`. None without a policy that does.
    """
    middle = [each.name for each in references.references if each.stage == MIDDLE]
    for each in sorted(curve, key=lambda each: each["seconds"]):
        own = [row for row in rows if row["a"] == each["name"] and row["b"] in middle]
        met = dict.fromkeys(row["b"] for row in own)  # not those that were added since
        if own and _payoff(task, own).score(each["name"], *met).score >= 0.75:
            return float(each["seconds"])
    return None


def _relative(
    task: Task, policies: Sequence[str], own: Mapping[str, Sequence[Row]], references: ReferenceSet
) -> dict[str, float] | None:
    """Return, by side, the value of the game between the entry's policies and the references; None for one policy.

    Balduzzi et al. 2019; one half means that both populations are equally good.
    """
    found = {}
    for team in task.teams:
        names = [name for name in policies if team_of(task, name) in (None, team)]
        met = [[row["b"] for row in own[name]] for name in names]
        others = [name for name in references.names if all(name in each for each in met)]
        if len(names) < 2 or not others:
            return None
        table = [[_payoff(task, own[name]).score(name, other).score for other in others] for name in names]
        if not np.isfinite(table).all():
            return None
        found[team] = round(float(relative_population_performance(np.array(table)).value), DIGITS)
    return found


def _cross_play(task: Task, policies: Sequence[str], rows: Sequence[Row]) -> dict[str, Any] | None:
    """Return scores between the policies of several seeds; None for one seed.

    Where sides are unlike, the scores are the first side's, and `off_diagonal_less_diagonal` is the mean against other
    seeds' policies less that against the policy of the same seed: near zero if seeds learn alike. Where they are
    alike, both means are one half for any policies, so `spread` has the mean distance from it instead.
    """
    games = [row for row in rows if row["b"] in policies]
    if not games:
        return None
    first = [name for name in policies if team_of(task, name) in (None, task.teams[0])]
    second = first if task.alike else [name for name in policies if name not in first]
    return cross_play(_payoff(task, games), first, second)


def cross_play(payoff: Payoff, first: Sequence[str], second: Sequence[str]) -> dict[str, Any]:
    """Return the scores of each policy in `first` against each in `second`, and what they say of seeds.

    Both name policies seed by seed. If they are the same, the result has `spread`, else `off_diagonal_less_diagonal`.
    """
    table = np.array([[0.5 if a == b else payoff.score(a, b).score for b in second] for a in first])
    off = ~np.eye(len(first), dtype=bool)
    found: dict[str, Any] = {"rows": list(first), "columns": list(second), "scores": np.round(table, DIGITS).tolist()}
    if list(first) == list(second):
        return {**found, "spread": round(float(np.abs(table[off] - 0.5).mean()), DIGITS)}
    return {**found, "off_diagonal_less_diagonal": round(float(table[off].mean() - table[~off].mean()), DIGITS)}


def _payoff(task: Task, rows: Sequence[Row]) -> Payoff:
    """Return the sums of rows. Raises StorageError for rows that contradict themselves."""
    try:
        return sum_matches([match_of(row, task) for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise StorageError(f"the rows of games are damaged: {error}") from None


def _score(score: Score) -> dict[str, Any]:
    """Return a score with its 95 % interval; null without games."""
    value = round(score.score, DIGITS) if score.games else None
    low, high = (round(float(end), DIGITS) for end in (score.low, score.high))
    return {"score": value, "low": low, "high": high, "games": score.games, "voids": score.voids}
